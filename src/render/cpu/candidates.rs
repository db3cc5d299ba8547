//! Candidates for new rows: the surface points of the pixels with the largest error (*Gaussians on a
//! Diet*, arXiv 2604.20046, "compensation").
//!
//! For each chosen pixel, its tile's list is traversed once more, in scalar code, to find the Gaussian that represents
//! its surface. That takes a few thousand operations per step, while recording surfaces during rendering would
//! slow down every pixel.

use std::sync::atomic::AtomicU64;

use densify_policies::policy::DepthMode;
use glam::{Quat, Vec3};
use rayon::prelude::*;

use super::blocks::plane;
use super::parameters::Parameters;
use super::project::{Splat, ViewParams};
use super::rasterize::ALPHA_MAX;
use super::threads::Threads;
use super::tiles::Entry;
use crate::Shortcuts;
use crate::candidates::{RankedPixel, keep_worst};

/// Number of image rows ranked per task.
const LINES: usize = 2;
/// Number of lists merged per task.
const LISTS: usize = 8;

/// Writes the `count` worst pixels of an image to the head of `ranking`, in any order, and returns their number. Each
/// task keeps its own worst pixels; their lists are merged until one is left.
pub(super) fn rank(
    threads: &Threads,
    ranking: &mut Vec<RankedPixel>,
    [width, height]: [usize; 2],
    count: usize,
    error: impl Fn(usize, usize) -> Option<f32> + Send + Sync,
) -> usize {
    let pixels = width * height;
    if ranking.len() < pixels {
        ranking.resize(pixels, (0.0, 0));
    }
    let ranking = &mut ranking[..pixels];
    let mut per_task = LINES * width.max(1);
    let tasks = ranking.par_chunks_mut(per_task).enumerate();
    let mut kept = threads.collect("rank", tasks, |(task, ranking)| {
        let mut ranked = 0;
        for at in 0..ranking.len() {
            let (x, y) = (at % width, task * LINES + at / width);
            if let Some(error) = error(x, y).filter(|&error| error > 0.0) {
                ranking[ranked] = (error, (y * width + x) as u32);
                ranked += 1;
            }
        }
        keep_worst(&mut ranking[..ranked], count)
    });
    while kept.len() > 1 {
        let tasks = ranking.par_chunks_mut(LISTS * per_task).zip(kept.par_chunks(LISTS));
        kept = threads.collect("rank", tasks, |(ranking, kept)| {
            let mut ranked = 0;
            for (i, &kept) in kept.iter().enumerate() {
                ranking.copy_within(i * per_task..i * per_task + kept, ranked);
                ranked += kept;
            }
            keep_worst(&mut ranking[..ranked], count)
        });
        per_task *= LISTS;
    }
    kept.first().copied().unwrap_or(0)
}

/// The row that represents the surface at pixel centre `at`: depending on `mode`, the row with the largest blend
/// weight, or the row at which transmittance falls below ½.
pub(super) fn surface_row(
    splats: &[Splat],
    list: &[AtomicU64],
    at: [f32; 2],
    shortcuts: Shortcuts,
    mode: DepthMode,
) -> Option<usize> {
    let mut transmittance = 1.0_f32;
    let mut best = None;
    let mut max_weight = 0.0;
    for entry in list {
        let row = Entry::load(entry).row;
        let splat = &splats[row];
        let (dx, dy) = (at[0] - splat.mean[0], at[1] - splat.mean[1]);
        let u = splat.l1 * (dx - splat.shear * dy);
        let z = splat.l3 * dy;
        let alpha = (splat.log2_opacity - u * u - z * z).exp2().min(ALPHA_MAX);
        if alpha.is_nan() || alpha < shortcuts.alpha_min {
            continue;
        }
        let weight = alpha * transmittance;
        transmittance -= weight;
        match mode {
            DepthMode::MaxWeight if weight > max_weight => (max_weight, best) = (weight, Some(row)),
            DepthMode::Median if transmittance < 0.5 => return Some(row),
            _ => {}
        }
        if transmittance <= shortcuts.transmittance_min {
            break;
        }
    }
    best
}

/// The point on the ray through pixel centre `at` that is closest to the Gaussian of `row` in its
/// Mahalanobis metric, with its depth; `None` if the depth is not beyond the near plane.
pub(super) fn closest_approach(
    params: &Parameters,
    row: usize,
    view: &ViewParams,
    at: [f32; 2],
) -> Option<(Vec3, f32)> {
    let r = view.rotation.map(Vec3::from);
    let x = (at[0] - view.principal[0]) / view.focal[0];
    let y = (at[1] - view.principal[1]) / view.focal[1];
    // Camera z of this vector is 1, so that the ray's parameter is the depth.
    let ray = r[0] * x + r[1] * y + r[2];
    let centre = Vec3::from(view.centre);
    let mean = Vec3::from(params.get_n::<3>(row, plane::MEAN));
    let scale = Vec3::from(params.get_n::<3>(row, plane::LOG_SCALE).map(f32::exp));
    let [qw, qx, qy, qz] = params.get_n::<4>(row, plane::QUAT);
    let local_from_world = Quat::from_xyzw(qx, qy, qz, qw).normalize().inverse();
    let direction = local_from_world * ray / scale;
    let offset = local_from_world * (centre - mean) / scale;
    let depth = -direction.dot(offset) / direction.length_squared();
    (depth.is_finite() && depth > view.near).then(|| (centre + ray * depth, depth))
}

#[cfg(test)]
mod tests {
    use densify_policies::policy::{CandidateRequest, ErrorMode};

    use super::*;
    use crate::candidates::Candidates;

    /// Images that take one task, a few tasks, and several rounds of merging; many pixels have equal errors.
    #[test]
    fn merged_rankings_have_the_worst_pixels_of_one_complete_list() {
        let threads = Threads::new(Some(2)).expect("threads");
        let request = CandidateRequest {
            from: 0,
            until: 1,
            rows_per_candidate: 1,
            capacity: 1,
            error: ErrorMode::L1,
            depth: DepthMode::Median,
            min_alpha: 0.0,
            spaced: true,
        };
        for size in [[7, 1], [5, 6], [31, 150]] {
            let error = |x: usize, y: usize| {
                let hash = (x * 31 + y * 57) * 7919 % 97;
                (hash != 5).then_some(hash as f32 - 10.0)
            };
            for (count, spaced) in [(1, true), (3, false), (40, true), (9999, false)] {
                let [mut complete, mut merged] = [(); 2].map(|()| Candidates::new(Some(request)));
                let rank = |ranking: &mut Vec<_>, most| rank(&threads, ranking, size, most, error);
                let expected = complete.worst(size[0], size[1], count, spaced, error);
                assert!(!expected.is_empty());
                assert_eq!(merged.worst_by(size, count, spaced, rank, error), expected);
            }
        }
    }
}
