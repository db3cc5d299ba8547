//! Initialises Gaussians from points, never more than the budget.
//!
//! As in 3DGS (Kerbl et al. 2023, §4 and its code), Gaussians are isotropic with the root mean square distance to the 3
//! nearest neighbours as standard deviation, opacity 0.1, and colour in band 0. Everything is computed in f64 and
//! relative to the size of the scene, so that remote and tiny scenes lose no precision.

mod random;

use densify_policies::neighbours::Neighbours;
use densify_policies::policy::StartRule;
use glam::DVec3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use crate::schedule;
use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::{Gaussians, logit, rgb_to_dc, sh_coefficients};
use densify_data::dataset::PointCloud;
use densify_data::dataset::normalise::EXTENT;
pub use random::random_points;

/// Diameter D of a normalised scene `[scene units]`; the lengths below are relative to it.
const SCENE_DIAMETER: f64 = 2.0 * EXTENT;
/// Lower bound of the root mean square distance, because points closer than 1e-4·D count as one surface sample. (The
/// absolute bound of the original code would exceed the size of a scene of a few millimetres.)
const DISTANCE_FLOOR: f64 = 1e-4 * SCENE_DIAMETER;
/// Standard deviation of a Gaussian that is alone, and so has no neighbours `[scene units]`.
const SINGLE_POINT_SCALE: f64 = 0.01 * SCENE_DIAMETER;
/// Initial opacity.
const OPACITY: f64 = 0.1;
/// Colours stay half an 8-bit step away from 0 and 1, because the renderer clamps colours at 0, where black would have
/// no gradient.
const COLOUR_MARGIN: f64 = 1.0 / 510.0;

/// Numbers of points that were used and dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct InitReport {
    /// Number of points before initialisation.
    pub points: usize,
    /// Points dropped because another point has exactly the same position.
    pub duplicates: usize,
    /// Points dropped because they are not finite in f32.
    pub unusable: usize,
    /// Points dropped at random because they exceed the budget.
    pub over_budget: usize,
    /// Gaussians created from the remaining points.
    pub rows: usize,
}

/// Reason why Gaussians cannot be initialised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum InitError {
    /// The budget is 0.
    #[error("the budget is 0 Gaussians; it must be at least 1")]
    NoBudget,
    /// The spherical-harmonic degree is not supported.
    #[error("spherical-harmonic degree {0} is not one of 0 to 3")]
    Degree(u8),
    /// No point has a finite position.
    #[error("the scene has no usable initial points")]
    NoPoints,
    /// More points than the neighbour search supports.
    #[error("{0} points are too many for the neighbour search; use fewer")]
    TooManyPoints(usize),
}

/// Creates one Gaussian per point, in normalised coordinates. If there are more points than `budget`, the seed
/// determines a random subset. Gaussians close in space are mostly close in order, too.
///
/// # Errors
/// When there is no usable point, and when the budget or the degree is invalid.
pub fn initialise(
    points: &PointCloud,
    budget: usize,
    sh_degree: u8,
    seed: u64,
) -> Result<(Gaussians, InitReport), InitError> {
    if budget == 0 {
        return Err(InitError::NoBudget);
    }
    if sh_degree > densify_core::gaussians::MAX_SH_DEGREE {
        return Err(InitError::Degree(sh_degree));
    }
    let mut report = InitReport { points: points.len(), ..InitReport::default() };
    let mut chosen = finite(points);
    report.unusable = points.len() - chosen.len();
    let usable = chosen.len();
    drop_duplicates(&mut chosen, &points.positions);
    report.duplicates = usable - chosen.len();
    if chosen.is_empty() {
        return Err(InitError::NoPoints);
    }
    if chosen.len() > budget {
        report.over_budget = chosen.len() - budget;
        schedule::sample(&mut chosen, budget, &mut ChaCha8Rng::seed_from_u64(seed));
    }
    chosen.sort_unstable_by_key(|&i| {
        (densify_core::curve::morton_code(points.positions[i].to_array()), i)
    });
    report.rows = chosen.len();

    let positions: Vec<[f64; 3]> = chosen.iter().map(|&i| points.positions[i].to_array()).collect();
    let log_scales = log_scales(&positions)?;
    let rows = chosen.len();
    let stride = 3 * sh_coefficients(sh_degree);
    let mut sh = vec![0.0; rows * stride];
    for (row, &i) in sh.chunks_exact_mut(stride).zip(&chosen) {
        let rgb = points.colours[i]
            .map(|v| (f64::from(v) / 255.0).clamp(COLOUR_MARGIN, 1.0 - COLOUR_MARGIN));
        row[..3].copy_from_slice(&rgb.map(|v| rgb_to_dc(v as f32)));
    }
    let gaussians = Gaussians {
        sh_degree,
        origin: [0.0; 3],
        antialiasing: Antialiasing::None,
        means: positions.iter().map(|p| p.map(|v| v as f32)).collect(),
        log_scales: log_scales.into_iter().map(|log| [log; 3]).collect(),
        quats: vec![[1.0, 0.0, 0.0, 0.0]; rows],
        opacity_logits: vec![(OPACITY / (1.0 - OPACITY)).ln() as f32; rows],
        sh,
    };
    Ok((gaussians, report))
}

/// Number of Gaussians that [`initialise`] creates from these points without a budget.
pub fn usable_points(points: &PointCloud) -> usize {
    let mut chosen = finite(points);
    drop_duplicates(&mut chosen, &points.positions);
    chosen.len()
}

fn finite(points: &PointCloud) -> Vec<usize> {
    (0..points.len()).filter(|&i| points.positions[i].as_vec3().is_finite()).collect()
}

/// Applies the initial opacity and scale that a policy requests.
pub fn apply_start_rule(model: &mut Gaussians, rule: &StartRule) {
    if let Some(opacity) = rule.opacity {
        model.opacity_logits.fill(logit(opacity));
    }
    let ln_scale = rule.scale.ln();
    for log_scale in model.log_scales.as_flattened_mut() {
        *log_scale += ln_scale;
    }
}

/// Keeps the first of several points with the same position.
fn drop_duplicates(chosen: &mut Vec<usize>, positions: &[DVec3]) {
    // Adding 0 turns −0 into 0, so that equal positions have equal bits.
    let key = |i: usize| positions[i].to_array().map(|v| (v + 0.0).to_bits());
    let mut order = chosen.clone();
    order.par_sort_unstable_by_key(|&i| (key(i), i));
    order.dedup_by_key(|i| key(*i));
    order.par_sort_unstable();
    *chosen = order;
}

/// Logarithms of the root mean square distances to the (up to) three nearest neighbours. The points are distinct.
fn log_scales(positions: &[[f64; 3]]) -> Result<Vec<f32>, InitError> {
    if u32::try_from(positions.len()).is_err() {
        return Err(InitError::TooManyPoints(positions.len()));
    }
    if positions.len() == 1 {
        return Ok(vec![SINGLE_POINT_SCALE.ln() as f32]);
    }
    let neighbours = Neighbours::new(positions);
    let scale = |point: usize| {
        let square = neighbours.mean_square_distance(point);
        (0.5 * square.max(DISTANCE_FLOOR * DISTANCE_FLOOR).ln()) as f32
    };
    Ok((0..positions.len()).into_par_iter().map(scale).collect())
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests;
