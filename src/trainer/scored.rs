//! Which training views are rendered where a policy scores rows, or looks at auxiliary views.
//!
//! A view that another one all but repeats, as the next frame of a film does, tells a score nothing
//! new and costs as much. Such views are left out of scores, and of nothing else: all are trained on,
//! and all that are held out are measured.

use crate::camera::Camera;
use crate::schedule;
use crate::views::ViewSource;

/// Centres nearer than this are as good as one `[fraction of the scene's extent]`.
const NEAR: f64 = 0.01;
/// And orientations: the cosine of one degree.
const ALIKE: f64 = 0.999_847_7;
/// And focal lengths and centres of the image `[fraction of its width]`.
const SAME_LENS: f64 = 0.01;

/// The views that are rendered for scores.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Scored(Vec<usize>);

impl Scored {
    /// All of so many views.
    pub(super) fn all(count: usize) -> Self {
        Self((0..count).collect())
    }

    /// Of views that are nearly the same the first one each.
    pub(super) fn distinct<V: ViewSource>(views: &V, extent: f32) -> Self {
        let near = NEAR * f64::from(extent);
        let mut chosen: Vec<usize> = Vec::new();
        for view in 0..views.count() {
            let camera = views.camera(view);
            if !chosen.iter().any(|&other| are_alike(camera, views.camera(other), near)) {
                chosen.push(view);
            }
        }
        Self(chosen)
    }

    /// Number of the views.
    pub(super) fn count(&self) -> usize {
        self.0.len()
    }

    /// So many of the views, or all of them if there are fewer, drawn from (seed, step).
    pub(super) fn draw(&self, count: usize, seed: u64, step: u32) -> Vec<usize> {
        let drawn = schedule::fresh_views(self.0.len(), count, seed, step);
        drawn.into_iter().map(|place| self.0[place]).collect()
    }
}

/// Whether two cameras see nearly the same: the same lens, nearly the same place and orientation.
fn are_alike(a: &Camera, b: &Camera, near: f64) -> bool {
    let lengths = |camera: &Camera| [camera.fx, camera.fy, camera.cx, camera.cy];
    let apart = lengths(a).into_iter().zip(lengths(b)).map(|(a, b)| (a - b).abs());
    let is_same_lens = (a.width, a.height) == (b.width, b.height)
        && apart.fold(0.0, f64::max) <= SAME_LENS * f64::from(a.width);
    // trace(AᵀB) = 1 + 2 cos of the angle between them.
    let turn = (a.rotation.transpose() * b.rotation).to_cols_array();
    let cosine = (turn[0] + turn[4] + turn[8] - 1.0) / 2.0;
    a.centre().distance(b.centre()) <= near && cosine >= ALIKE && is_same_lens
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
        let translation = -(rotation * DVec3::new(x, 0.0, 0.0));
        Camera { width: 64, height: 48, fx, fy: 50.0, cx: 32.0, cy: 24.0, rotation, translation }
    }

    #[test]
    fn of_views_that_are_nearly_the_same_the_first_is_taken() {
        // Extent 10: a centre within 0.1, and one degree, of an earlier view that is taken.
        let views = Cameras(vec![
            camera(0.0, 0.0, 50.0),
            camera(0.09, 0.9, 50.0),
            camera(0.15, 0.0, 50.0),
            camera(0.0, 1.1, 50.0),
            camera(0.0, 0.0, 60.0),
            camera(0.16, 0.1, 50.0),
        ]);
        let scored = Scored::distinct(&views, 10.0);
        assert_eq!((&scored.0[..], views.count() - scored.count()), (&[0, 2, 3, 4][..], 2));
        let mut drawn = scored.draw(100, 7, 3);
        drawn.sort_unstable();
        assert_eq!(drawn, [0, 2, 3, 4]);
        // Nothing is drawn differently where nothing is left out.
        let all = Scored::all(6);
        assert_eq!(all.draw(3, 7, 3), schedule::fresh_views(6, 3, 7, 3));
        assert_eq!(Scored::distinct(&views, 1e-3), all);
    }
}
