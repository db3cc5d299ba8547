//! Chooses the training views that a policy's scores are measured in, without near-duplicates.
//!
//! A view that nearly repeats another, such as the next frame of a film, adds nothing to a score but
//! costs as much. Such views are left out of scores only: all are trained on, and all test views are
//! measured.

use crate::camera::Camera;
use crate::schedule;
use crate::views::ViewSource;

/// Largest distance of the cameras of near-duplicates `[fraction of the scene extent]`.
const MAX_DISTANCE: f64 = 0.01;
/// Smallest cosine of the angle between them: that of one degree.
const MIN_COSINE: f64 = 0.999_847_7;
/// Largest difference of focal lengths and principal points `[fraction of the image's width]`.
const MAX_LENS_DIFFERENCE: f64 = 0.01;

/// The training views that scores are measured in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ScoringViews(Vec<usize>);

impl ScoringViews {
    /// All of `count` views.
    pub(super) fn all(count: usize) -> Self {
        Self((0..count).collect())
    }

    /// The first view of each group of near-duplicates.
    pub(super) fn distinct<V: ViewSource>(views: &V, extent: f32) -> Self {
        let near = MAX_DISTANCE * f64::from(extent);
        let mut chosen: Vec<usize> = Vec::new();
        for view in 0..views.count() {
            let camera = views.camera(view);
            if !chosen.iter().any(|&other| are_near_duplicates(camera, views.camera(other), near)) {
                chosen.push(view);
            }
        }
        Self(chosen)
    }

    /// Number of views.
    pub(super) fn count(&self) -> usize {
        self.0.len()
    }

    /// `count` of the views, or all of them if there are fewer, drawn from (seed, step).
    pub(super) fn draw(&self, count: usize, seed: u64, step: u32) -> Vec<usize> {
        let drawn = schedule::fresh_views(self.0.len(), count, seed, step);
        drawn.into_iter().map(|place| self.0[place]).collect()
    }
}

/// Whether two cameras have the same lens and nearly the same place and orientation.
fn are_near_duplicates(a: &Camera, b: &Camera, near: f64) -> bool {
    let lengths = |camera: &Camera| [camera.fx, camera.fy, camera.cx, camera.cy];
    let apart = lengths(a).into_iter().zip(lengths(b)).map(|(a, b)| (a - b).abs());
    let is_same_lens = (a.width, a.height) == (b.width, b.height)
        && apart.fold(0.0, f64::max) <= MAX_LENS_DIFFERENCE * f64::from(a.width);
    // trace(AᵀB) = 1 + 2 cos of the angle between them.
    let turn = (a.rotation.transpose() * b.rotation).to_cols_array();
    let cosine = (turn[0] + turn[4] + turn[8] - 1.0) / 2.0;
    a.centre().distance(b.centre()) <= near && cosine >= MIN_COSINE && is_same_lens
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::dataset::images::SharedImage;
    use crate::views::ViewError;

    struct Cameras(Vec<Camera>);

    impl ViewSource for Cameras {
        fn count(&self) -> usize {
            self.0.len()
        }
        fn name(&self, _view: usize) -> &str {
            ""
        }
        fn camera(&self, view: usize) -> &Camera {
            &self.0[view]
        }
        fn image(&self, _view: usize) -> Result<SharedImage, ViewError> {
            Err("no pixels are needed".into())
        }
        fn prefetch(&self, _upcoming: &[usize]) {}
    }

    fn camera(x: f64, degrees: f64, fx: f64) -> Camera {
        let rotation = DMat3::from_rotation_y(degrees.to_radians());
        Camera::centred((64, 48), (fx, 50.0), rotation, DVec3::new(x, 0.0, 0.0))
    }

    #[test]
    fn the_first_of_near_duplicates_is_kept() {
        // Extent 10: within 0.1 and one degree of an earlier view that is kept.
        let views = Cameras(vec![
            camera(0.0, 0.0, 50.0),
            camera(0.09, 0.9, 50.0),
            camera(0.15, 0.0, 50.0),
            camera(0.0, 1.1, 50.0),
            camera(0.0, 0.0, 60.0),
            camera(0.16, 0.1, 50.0),
        ]);
        let scored = ScoringViews::distinct(&views, 10.0);
        assert_eq!((&scored.0[..], views.count() - scored.count()), (&[0, 2, 3, 4][..], 2));
        let mut drawn = scored.draw(100, 7, 3);
        drawn.sort_unstable();
        assert_eq!(drawn, [0, 2, 3, 4]);
        // Where nothing is left out, the draw is that of the schedule.
        let all = ScoringViews::all(6);
        assert_eq!(all.draw(3, 7, 3), schedule::fresh_views(6, 3, 7, 3));
        assert_eq!(ScoringViews::distinct(&views, 1e-3), all);
    }
}
