//! Measures how much a quantised format changes a model, by reading the file back. This finds changes whatever their
//! cause: a limited range, a step that is too coarse, a codebook that an outlier spoils.

use std::fmt;

use super::spatial_order::middles_and_spreads;
use densify_core::gaussians::{Gaussians, sigmoid};
use densify_core::numbers::gaussians;
use densify_core::sh;

/// The quantities of a Gaussian, and the limits above which changes count. Rounding stays below these limits: half a
/// step of SPZ's scales, the coarsest quantity, is 3 %.
const QUANTITIES: [(&str, &str, f64); 4] = [
    ("positions", "by more than half the Gaussian's size", 0.5),
    ("scales", "by more than 10 %", 0.1),
    ("opacities", "by more than 10 %", 0.1),
    ("colours", "by more than 10 % of white", 0.1),
];
/// Smallest changed share of the visible area, estimated by [`weight`], that is noted.
const NOTED: f64 = 0.01;
/// Smallest changed share of the visible area that makes a format unfit for the model.
const UNFIT: f64 = 0.25;
/// Directions in which colours are compared; a band has at most seven coefficients.
const DIRECTIONS: usize = 8;

/// The changes to a model in a file.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Changes {
    /// Number of Gaussians with a changed quantity, and their share of the visible area, by [`QUANTITIES`].
    by_quantity: [(usize, f64); 4],
    /// Share of the visible area that is changed in any quantity, 0..=1.
    share: f64,
}

impl Changes {
    /// Compares the model with `saved`, which was read back from its file and holds the model's rows in `order`.
    pub(super) fn measure(model: &Gaussians, order: &[usize], saved: &Gaussians) -> Self {
        let mut changes = Self::default();
        if saved.len() < model.len() {
            // The missing Gaussians were not finite when read back.
            (changes.by_quantity[0], changes.share) = ((model.len() - saved.len(), 1.0), 1.0);
            return changes;
        }
        let (axes, bases) = (middles_and_spreads(model), bases(model.sh_degree));
        let mut total = f64::MIN_POSITIVE;
        for (index, &row) in order.iter().enumerate() {
            let weight = weight(model, row, &axes);
            total += weight;
            let mut is_changed = false;
            let row_changes = row_changes(model, row, saved, index, &bases);
            for (at, (change, (.., limit))) in row_changes.into_iter().zip(QUANTITIES).enumerate() {
                // The change is NaN if both values are infinite.
                if change > limit || change.is_nan() {
                    is_changed = true;
                    changes.by_quantity[at].0 += 1;
                    changes.by_quantity[at].1 += weight;
                }
            }
            changes.share += if is_changed { weight } else { 0.0 };
        }
        changes.share /= total;
        changes.by_quantity.iter_mut().for_each(|(_, share)| *share /= total);
        changes
    }

    /// True if so much changes that another format should be chosen.
    pub fn is_unfit(&self) -> bool {
        self.share >= UNFIT
    }

    /// True if so much changes that the user should be told.
    pub fn is_noted(&self) -> bool {
        self.share >= NOTED
    }
}

impl fmt::Display for Changes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parts = self.by_quantity.iter().zip(QUANTITIES);
        let parts = parts.filter(|((_, share), _)| *share >= NOTED / 4.0);
        let words: Vec<String> = parts
            .map(|((rows, share), (name, limit, _))| {
                let (rows, percent) = (gaussians(*rows), 100.0 * share);
                format!("the {name} of {rows} ({percent:.1} % of the visible area) change {limit}")
            })
            .collect();
        f.write_str(&words.join(", "))
    }
}

/// The changes of a Gaussian, by [`QUANTITIES`].
fn row_changes(
    model: &Gaussians,
    row: usize,
    saved: &Gaussians,
    index: usize,
    bases: &[[f32; 16]],
) -> [f64; 4] {
    let [old, new] = [&model.log_scales[row], &saved.log_scales[index]].map(|logs| logs.map(size));
    // The thinnest axis of a flat Gaussian is visible only edge-on, so changes are relative to the middle axis.
    let middle = sorted(old)[1];
    let shift = (0..3).map(|axis| {
        let [a, b] = [&model.means[row], &saved.means[index]].map(|mean| f64::from(mean[axis]));
        (a - b).powi(2)
    });
    let scale = (0..3).map(|axis| (new[axis] - old[axis]).abs() / old[axis].max(middle));
    let [was, is] = [model.opacity_logits[row], saved.opacity_logits[index]]
        .map(|logit| f64::from(sigmoid(logit)));
    let colour = bases.iter().map(|basis| {
        let [a, b] = [model.sh_of(row), saved.sh_of(index)].map(|sh| colour(sh, basis));
        (0..3).map(|channel| f64::from(a[channel] - b[channel]).powi(2)).sum::<f64>()
    });
    [
        shift.sum::<f64>().sqrt() / middle,
        scale.fold(0.0, f64::max),
        (is - was).abs() / was,
        (colour.sum::<f64>() / (3 * bases.len()) as f64).sqrt(),
    ]
}

/// An estimate of the share of an image that a Gaussian covers, times its opacity. Its distance from the cameras is
/// estimated from its distance to the model's middle and the model's spread.
fn weight(model: &Gaussians, row: usize, axes: &[(f64, f64); 3]) -> f64 {
    let [_, middle, largest] = sorted(model.log_scales[row].map(size));
    let squares = model.means[row]
        .iter()
        .zip(axes)
        .map(|(&mean, (middle, spread))| (f64::from(mean) - middle).powi(2) + spread.powi(2));
    let covered = (middle * largest / squares.sum::<f64>()).min(1.0);
    covered * f64::from(sigmoid(model.opacity_logits[row]))
}

/// Standard deviation, from its logarithm.
fn size(log: f32) -> f64 {
    f64::from(log).exp()
}

fn sorted(mut sizes: [f64; 3]) -> [f64; 3] {
    sizes.sort_by(f64::total_cmp);
    sizes
}

/// The values of the spherical harmonics in directions on a spiral.
fn bases(sh_degree: u8) -> Vec<[f32; 16]> {
    let basis = |point: usize| {
        let z = 1.0 - (2 * point + 1) as f32 / DIRECTIONS as f32;
        let (sin, cos) = (2.399_963 * point as f32).sin_cos();
        let flat = (1.0 - z * z).sqrt();
        let mut y = [sh::C0; 16];
        sh::basis(sh_degree, [cos * flat, sin * flat, z], &mut y);
        y
    };
    (0..if sh_degree == 0 { 1 } else { DIRECTIONS }).map(basis).collect()
}

/// The colour of a Gaussian in a direction, given the values of the spherical harmonics there.
fn colour(sh: &[f32], basis: &[f32; 16]) -> [f32; 3] {
    let mut sum = [0.5f32; 3];
    for (coefficients, y) in sh.as_chunks::<3>().0.iter().zip(basis) {
        (0..3).for_each(|channel| sum[channel] += y * coefficients[channel]);
    }
    sum.map(|value| value.max(0.0))
}
