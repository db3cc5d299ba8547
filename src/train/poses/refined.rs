//! Steps of the poses.

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::adam::{Adam, FADE, REACH};
use densify_core::camera::Camera;
use densify_core::pose::PoseGradient;
use densify_core::similarity::Similarity;

/// Share of the run after which poses are refined: earlier gradients are about what the model still lacks.
const FROM: f64 = 0.25;

/// The errors of poses that refinement should be able to correct.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExpectedErrors {
    /// Rotations `[radians]`.
    pub rotation: f64,
    /// Camera centres `[fraction of the scene's extent]`.
    pub centre: f64,
}

impl Default for ExpectedErrors {
    /// What phones and quick reconstructions have.
    fn default() -> Self {
        Self { rotation: 0.5_f64.to_radians(), centre: 0.003 }
    }
}

/// The poses of all training views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Poses {
    /// Step sizes at the start: of translations `[scene units]` and of rotations `[radians]`.
    rates: [f64; 2],
    views: Vec<ViewPose>,
}

/// A motion from a given camera to another: of camera_from_world, and a factor on the focal lengths.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Motion {
    /// A quaternion (x, y, z, w).
    rotation: [f64; 4],
    /// `[scene units]`.
    translation: [f64; 3],
    /// > 0.
    zoom: f64,
}

impl Motion {
    const NONE: Self = Self { rotation: [0.0, 0.0, 0.0, 1.0], translation: [0.0; 3], zoom: 1.0 };

    fn between(given: &Camera, to: &Camera) -> Self {
        let turn = to.rotation * given.rotation.transpose();
        let quat = DQuat::from_mat3(&turn).normalize();
        let translation = to.translation - DMat3::from_quat(quat) * given.translation;
        let zoom = to.fx / given.fx;
        Self { rotation: quat.to_array(), translation: translation.to_array(), zoom }
    }

    fn apply(&self, given: &Camera) -> Camera {
        let turn = DMat3::from_quat(DQuat::from_array(self.rotation));
        Camera {
            rotation: turn * given.rotation,
            translation: turn * given.translation + DVec3::from(self.translation),
            fx: given.fx * self.zoom,
            fy: given.fy * self.zoom,
            ..*given
        }
    }

    fn is_valid(&self) -> bool {
        let Self { rotation, translation, zoom } = self;
        let is_finite = rotation.iter().chain(translation).chain([zoom]).all(|x| x.is_finite());
        is_finite && DQuat::from_array(*rotation).is_normalized() && *zoom > 0.0
    }
}

/// The refined pose of a view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewPose {
    /// From the given camera to that at the start of the run.
    start: Motion,
    /// From the given camera to the current one.
    now: Motion,
    adam: Adam,
}

impl Poses {
    /// The poses of a run of this many iterations, which start with the cameras `start`.
    pub fn new(
        given: &[Camera],
        start: &[Camera],
        iterations: u32,
        extent: f32,
        errors: ExpectedErrors,
    ) -> Self {
        let visits = (1.0 - FROM) * f64::from(iterations) / given.len().max(1) as f64;
        let rate = |error: f64| 2.0 * error / (REACH * visits.max(1.0));
        let rates = [rate(errors.centre * f64::from(extent)), rate(errors.rotation)];
        let view = |(given, start): (&Camera, &Camera)| {
            let start = if start == given { Motion::NONE } else { Motion::between(given, start) };
            ViewPose { start, now: start, adam: Adam::default() }
        };
        Self { rates, views: given.iter().zip(start).map(view).collect() }
    }

    /// Memory on the host `[bytes]`.
    pub fn bytes(views: usize) -> u64 {
        (views * size_of::<ViewPose>()) as u64
    }

    /// Number of views.
    pub fn count(&self) -> usize {
        self.views.len()
    }

    /// The refined camera of a view whose camera is `given`.
    pub fn camera(&self, view: usize, given: &Camera) -> Camera {
        self.views[view].now.apply(given)
    }

    /// Takes an Adam step for a view; `progress` is the elapsed fraction of the run. Non-finite gradients are ignored.
    pub fn step(&mut self, view: usize, given: &Camera, gradient: &PoseGradient, progress: f64) {
        if progress < FROM {
            return;
        }
        let fade = FADE.powf(((progress - FROM) / (1.0 - FROM)).min(1.0));
        let rates = self.rates.map(|rate| rate * fade);
        let pose = &mut self.views[view];
        if let Some(by) = pose.adam.step(gradient, rates) {
            pose.now = Motion::between(given, &pose.now.apply(given).moved(&by));
        }
    }

    /// Removes the similarity that best explains all motions since the start together. `given` returns the given camera
    /// of a view.
    pub fn fix_gauge<'a>(&mut self, given: impl Fn(usize) -> &'a Camera) {
        let views = self.views.iter().enumerate();
        let pairs: Vec<[Camera; 2]> = views
            .map(|(view, pose)| [pose.start, pose.now].map(|m| m.apply(given(view))))
            .collect();
        let back = Similarity::between_cameras(&pairs).inverse();
        for (view, (pose, [_, now])) in self.views.iter_mut().zip(&pairs).enumerate() {
            pose.now = Motion::between(given(view), &back.camera(now));
        }
    }

    /// Root mean square of the motions from the given cameras: of rotations `[radians]`, and of centres
    /// `[scene units]`.
    pub fn rms<'a>(&self, given: impl Fn(usize) -> &'a Camera) -> [f64; 2] {
        let mut sums = [0.0; 2];
        for (view, pose) in self.views.iter().enumerate() {
            let given = given(view);
            let moved = pose.now.apply(given).centre().distance_squared(given.centre());
            let turned = DQuat::from_array(pose.now.rotation).to_scaled_axis().length_squared();
            for (sum, x) in sums.iter_mut().zip([turned, moved]) {
                *sum += x;
            }
        }
        sums.map(|sum| (sum / self.views.len().max(1) as f64).sqrt())
    }

    /// Checks that these saved poses are finite, and match `other` in the number of views.
    ///
    /// # Errors
    /// A description of the mismatch.
    pub fn check_matches(&self, other: &Self) -> Result<(), String> {
        let (found, expected) = (self.views.len(), other.views.len());
        if found != expected {
            return Err(format!("its poses are of {found} views; this run has {expected}"));
        }
        let is_valid =
            |view: &ViewPose| view.start.is_valid() && view.now.is_valid() && view.adam.is_finite();
        if self.rates.iter().all(|x| x.is_finite()) && self.views.iter().all(is_valid) {
            Ok(())
        } else {
            Err("its poses are not finite, or not rigid motions".to_owned())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use densify_core::pose::Twist;

    fn cameras() -> Vec<Camera> {
        let camera = |i: usize| {
            let turn = DMat3::from_rotation_y(0.7 * i as f64);
            let centre = turn.transpose() * DVec3::new(0.1 * i as f64, 0.3, -2.0);
            Camera::centred((40, 30), (30.0, 30.0), turn, centre)
        };
        (0..6).map(camera).collect()
    }

    fn poses(given: &[Camera], start: &[Camera]) -> Poses {
        Poses::new(given, start, 600, 1.1, ExpectedErrors::default())
    }

    /// The largest distance between a refined centre and the true one.
    fn off(poses: &Poses, given: &[Camera], truth: &[Camera]) -> f64 {
        let apart =
            |view: usize| poses.camera(view, &given[view]).centre().distance(truth[view].centre());
        (0..given.len()).map(apart).fold(0.0, f64::max)
    }

    #[test]
    fn steps_lead_to_where_the_gradient_vanishes() {
        let (truth, off_by) = (cameras(), [0.002, -0.001, 0.001, 0.003, 0.002, -0.004, 0.0]);
        let sign = |view: usize| if view.is_multiple_of(2) { 1.0 } else { -1.0 };
        let given: Vec<Camera> = (0..truth.len())
            .map(|view| truth[view].moved(&Twist::from_array(off_by.map(|x| sign(view) * x))))
            .collect();
        let mut poses = poses(&given, &given);
        let before = off(&poses, &given, &truth);
        for step in 0..600 {
            let view = step % given.len();
            let now = poses.camera(view, &given[view]);
            // To first order, the twist from the true camera to this one.
            let turn = now.rotation * truth[view].rotation.transpose();
            let rotation = DQuat::from_mat3(&turn).to_scaled_axis();
            let translation = now.translation - turn * truth[view].translation;
            let gradient = PoseGradient { translation, rotation, log_focal: 0.0 };
            poses.step(view, &given[view], &gradient, step as f64 / 600.0);
        }
        assert!(off(&poses, &given, &truth) < 0.1 * before, "{before}");
        let unchanged = poses.clone();
        let nan = PoseGradient { log_focal: f64::NAN, ..PoseGradient::default() };
        poses.step(0, &given[0], &nan, 0.5);
        assert_eq!(poses, unchanged);
    }

    #[test]
    fn poses_start_where_they_are_told_and_rest_at_first() {
        let given = cameras();
        let twist =
            Twist { rotation: DVec3::new(0.0, 0.01, 0.0), log_focal: 0.02, ..Twist::default() };
        let start: Vec<Camera> = given.iter().map(|camera| camera.moved(&twist)).collect();
        let mut poses = poses(&given, &start);
        let gradient = PoseGradient { rotation: DVec3::ONE, ..PoseGradient::default() };
        poses.step(1, &given[1], &gradient, 0.1);
        for (view, start) in start.iter().enumerate() {
            let camera = poses.camera(view, &given[view]);
            assert!(
                (camera.fx - start.fx).abs() < 1e-12
                    && camera.centre().distance(start.centre()) < 1e-12
            );
        }
        let fixed = Poses::new(&given, &given, 600, 1.1, ExpectedErrors::default());
        assert_eq!(fixed.camera(2, &given[2]), given[2], "bit for bit");
    }

    #[test]
    fn a_motion_that_all_views_share_is_removed() {
        let given = cameras();
        let mut poses = poses(&given, &given);
        let shared = Similarity {
            rotation: DMat3::from_rotation_z(0.02),
            translation: DVec3::new(0.01, 0.0, -0.02),
            scale: 1.01,
        };
        for (pose, given) in poses.views.iter_mut().zip(&given) {
            pose.now = Motion::between(given, &shared.camera(given));
        }
        poses.fix_gauge(|view| &given[view]);
        assert!(off(&poses, &given, &given) < 1e-9);
    }

    #[test]
    fn poses_of_another_run_are_refused_and_saved_ones_read_back() {
        let given = cameras();
        let poses = poses(&given, &given);
        let text = serde_json::to_string(&poses).unwrap();
        let mut read: Poses = serde_json::from_str(&text).unwrap();
        assert_eq!(read, poses);
        assert_eq!(read.check_matches(&poses), Ok(()));
        let fewer = Poses::new(&given[1..], &given[1..], 600, 1.1, ExpectedErrors::default());
        assert!(read.check_matches(&fewer).unwrap_err().contains("6 views"));
        read.views[0].now.rotation = [0.0; 4];
        assert!(read.check_matches(&poses).unwrap_err().contains("rigid"));
    }
}
