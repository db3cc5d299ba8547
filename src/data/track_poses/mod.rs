//! Adjusts poses before training by the tracks of the reconstruction, and tells how far they were off.
//!
//! A track is a point and the directions in which photographs show it. Poses and points are adjusted in turn until the
//! points are seen in these directions (bundle adjustment by resection and intersection, each a Gauss-Newton step with
//! Huber weights). Poses from a reconstruction are already where this leads; poses with errors of their own move, by a
//! distance in the picture that is measured in pixels. The world is not moved: at the end cameras and points are where they
//! were on average, so that test views and first Gaussians stay in place.

mod state;

use serde::{Deserialize, Serialize};

use crate::dataset::Tracks;
use crate::track_colours::MIN_TRACKS;
use densify_core::camera::Camera;
pub use state::bytes;
use state::{MEDIAN_TO_DEVIATION, Seen, State};

/// Rounds of adjusting only poses, or only points, to find what explains the tracks better.
const FIRST_ROUNDS: usize = 3;
/// Rounds of adjusting poses and points.
const ROUNDS: usize = 150;
/// A round that moves no view by more than this ends the adjustment `[px]`, root mean square.
const SETTLED: f64 = 2e-4;
/// Smallest robust standard deviation of residuals `[px]`, so that exact tracks have one.
const LEAST_DEVIATION: f64 = 0.02;
/// Smallest motion in the picture for which refinement pays `[px]`; a sixth of a pixel costs 2 dB.
const MIN_MOTION: f64 = 0.15;
/// A motion counts if it is larger than this many of its standard errors.
const SIGNIFICANT: f64 = 3.0;

/// How far poses were off, judged by the tracks. Lengths are pixels of the training images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseErrors {
    /// Number of tracks.
    pub tracks: usize,
    /// Number of views whose poses the tracks determine.
    pub views: usize,
    /// Median distance between where a point is seen and where the given pose projects it.
    pub before: f64,
    /// The same with adjusted poses and points.
    pub after: f64,
    /// Root mean square over the views of how far the adjustment moves points in the picture.
    pub motion: f64,
    /// Its standard error: how far noise of the tracks alone moves them.
    pub uncertainty: f64,
}

impl PoseErrors {
    /// True if the poses should be refined.
    pub fn are_off(&self) -> bool {
        self.motion >= MIN_MOTION && self.is_significant()
    }

    /// True if noise of the tracks does not explain the motion.
    pub fn is_significant(&self) -> bool {
        self.motion > SIGNIFICANT * self.uncertainty
    }
}

/// Adjusted cameras, and how far they have moved.
#[derive(Debug, Clone, PartialEq)]
pub struct Adjusted {
    /// The cameras of the training views; those of views with too few points are as given.
    pub cameras: Vec<Camera>,
    /// The evidence.
    pub errors: PoseErrors,
}

/// Adjusts the given cameras of the training views, and the focal lengths of each lens if `with_focal`; `None` if too
/// few tracks say where photographs show their points.
pub fn adjust(tracks: &Tracks, given: &[Camera], with_focal: bool) -> Option<Adjusted> {
    let seen = Seen::new(tracks, given);
    if seen.tracks() < MIN_TRACKS {
        return None;
    }
    let start = State::new(&seen, tracks, given);
    let before = start.deviation() / MEDIAN_TO_DEVIATION;
    // Either the points or the poses may be what is right, so what explains the tracks better is held fixed at first.
    let (mut by_poses, mut by_points) = (start.clone(), start);
    for _ in 0..FIRST_ROUNDS {
        by_poses.step_poses(by_poses.deviation().max(LEAST_DEVIATION), with_focal);
        by_points.step_points(by_points.deviation().max(LEAST_DEVIATION));
    }
    let mut state = if by_poses.deviation() < by_points.deviation() { by_poses } else { by_points };
    for _ in 0..ROUNDS {
        let deviation = state.deviation().max(LEAST_DEVIATION);
        let moved = state.step_poses(deviation, with_focal);
        state.step_points(deviation);
        if moved < SETTLED {
            break;
        }
    }
    state.restore_world(given, &tracks.positions);
    let errors = state.errors(given, before);
    (errors.views > 0).then_some(Adjusted { cameras: state.cameras, errors })
}

#[cfg(test)]
mod tests;
