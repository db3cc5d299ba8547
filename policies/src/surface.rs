//! Replacing a model by surface points seen in the training views, and sizes for restarted rows.
//!
//! These are the "depth reinitialization" and the restart after sampling of *Mini-Splatting* (Fang and Wang 2024),
//! as in the published code of Mini-Splatting and of diet.

use crate::neighbours::Neighbours;
use crate::plan::{EditPlan, Reset, Seed};
use crate::policy::Candidate;

/// Smallest size of a row, as a fraction of the scene extent, as for the points of the initial model: closer points
/// count as the same surface point.
const MIN_SIZE: f64 = 2e-4;
/// Size of a row without neighbours, as a fraction of the scene extent.
const LONE_SIZE: f64 = 0.02;

/// The standard deviations of round rows at these positions: the root mean square distance to the three nearest
/// neighbours `[scene units]`, in a scene of this `extent`. Shape: `[positions]`.
pub fn sizes(positions: &[[f64; 3]], extent: f32) -> Vec<f32> {
    let extent = f64::from(extent);
    if positions.len() == 1 {
        return vec![(LONE_SIZE * extent) as f32];
    }
    let neighbours = Neighbours::new(positions);
    let size = |index| neighbours.mean_square_distance(index).sqrt().max(MIN_SIZE * extent);
    (0..positions.len()).map(|index| size(index) as f32).collect()
}

/// Replaces all rows by rows of this opacity at the valid surface points, at most `max_rows`. If no point is valid,
/// the model is kept.
pub fn replace_model(
    points: &[Candidate],
    max_rows: usize,
    opacity: f32,
    extent: f32,
    plan: &mut EditPlan,
) {
    // The size is a placeholder until the neighbours are known.
    let seed = |c: &Candidate| Seed::round(c.position, c.colour, 1.0, opacity);
    let valid = points.iter().map(seed).filter(|seed| seed.bad_field().is_none());
    let mut seeds: Vec<Seed> = valid.take(max_rows).collect();
    if seeds.is_empty() {
        return;
    }
    let positions: Vec<_> = seeds.iter().map(|seed| seed.position.map(f64::from)).collect();
    for (seed, size) in seeds.iter_mut().zip(sizes(&positions, extent)) {
        seed.scales = [size; 3];
    }
    plan.cause("reinit");
    plan.prune_all(0..plan.rows() as u32);
    for seed in seeds {
        // A refusal is counted by the plan.
        let _ = plan.append(seed);
    }
    plan.reset(Reset::Signals);
    plan.reset(Reset::Candidates);
}

/// Number of surface points per view for a total of `total` over all `views`, at least one.
pub fn points_per_view(total: usize, views: u32) -> u32 {
    let per_view = (total / views.max(1) as usize).max(1);
    u32::try_from(per_view).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_distances_to_neighbours() {
        // On a line, the first point has neighbours at 1, 3 and 6: √(46/3).
        let line = [[0.0; 3], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0], [6.0, 0.0, 0.0]];
        let of_line = sizes(&line, 1.0);
        assert!((of_line[0] - (46.0_f32 / 3.0).sqrt()).abs() < 1e-6, "{of_line:?}");
        // Coinciding points get 2e-4 of the extent, a single point 0.02 of it.
        assert_eq!(sizes(&[[1.0; 3]; 3], 10.0), [2e-3; 3]);
        assert_eq!(sizes(&[[1.0; 3]], 10.0), [0.2]);
        assert!(sizes(&[], 10.0).is_empty());
    }

    #[test]
    fn points_are_shared_among_the_views() {
        assert_eq!([points_per_view(100, 8), points_per_view(3, 8)], [12, 1]);
        assert_eq!(points_per_view(5, 0), 5);
    }
}
