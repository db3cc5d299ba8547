//! `--poses`: whether to refine the poses of the training views, and the cameras to start from.

use super::inputs::Evidence;
use super::sources::PoseSource;
use super::trial::halved;
use crate::failure::notes;
use crate::spec::RunSpec;
use densify_core::camera::Camera;
use densify_core::numbers::grouped;
use densify_core::spelling::Spelling;
use densify_data::dataset::{Dataset, View};
use densify_data::track_colours::MIN_TRACKS;
use densify_data::track_poses::{Adjusted, adjust};
use densify_train::poses::{ExpectedErrors, PoseChoice, Poses};

/// The poses of a run.
#[derive(Debug, Clone)]
pub(crate) struct RefinedPoses {
    /// True if poses are refined.
    pub(crate) is_on: bool,
    pub(crate) source: PoseSource,
    /// Cameras adjusted by the tracks, if these determine them. Shape: `[training views]`, or empty.
    adjusted: Vec<Camera>,
}

impl RefinedPoses {
    /// An earlier decision; the current poses are in the checkpoint.
    pub(super) fn known(is_on: bool, source: PoseSource) -> Self {
        Self { is_on, source, adjusted: Vec::new() }
    }

    /// Decides by the option, or with `auto` by the tracks of the reconstruction.
    pub(super) fn decide(spec: &RunSpec, evidence: &Evidence, views: &[View]) -> Self {
        let choice = spec.schedule.poses;
        if choice == PoseChoice::Fixed {
            return Self::known(false, PoseSource::Given);
        }
        let given: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        let found = adjust(&evidence.tracks, &given, spec.schedule.refine_focal);
        let (adjusted, errors) = match found {
            Some(Adjusted { cameras, errors }) => (cameras, Some(errors)),
            None => (Vec::new(), None),
        };
        let asked = choice == PoseChoice::Refine;
        let is_on = asked || errors.is_some_and(|errors| errors.are_off());
        let is_known = errors.is_some_and(|errors| errors.is_significant());
        let source = errors.map_or(PoseSource::Undecided, PoseSource::Tracks);
        Self { is_on, source, adjusted: if is_on && is_known { adjusted } else { Vec::new() } }
    }

    /// Halves the images, and drops the adjusted cameras of all views but those that `keeps` names by their numbers.
    pub(super) fn halve_and_keep(&mut self, keeps: impl Fn(usize) -> bool) {
        let numbered = self.adjusted.iter().enumerate();
        self.adjusted =
            numbered.filter(|(view, _)| keeps(*view)).map(|(_, camera)| halved(camera)).collect();
        // In pixels.
        if let PoseSource::Tracks(errors) = &mut self.source {
            errors.uncertainty *= 0.5;
        }
    }

    /// The poses that the run starts with, if poses are refined.
    pub(crate) fn initial(&self, spec: &RunSpec, dataset: &Dataset, extent: f32) -> Option<Poses> {
        if !self.is_on {
            return None;
        }
        let given: Vec<Camera> = dataset.train.iter().map(|view| view.camera).collect();
        let start = if self.adjusted.is_empty() { &given } else { &self.adjusted };
        let errors = match self.source {
            PoseSource::Tracks(errors) => {
                // What tracks leave undecided, as an angle; seen from one extent away, as a shift too.
                let focal = given.iter().map(|camera| camera.fx).sum::<f64>() / given.len() as f64;
                let angle = errors.uncertainty / focal;
                ExpectedErrors { rotation: angle, centre: angle }
            }
            PoseSource::Given | PoseSource::Undecided => ExpectedErrors::default(),
        };
        Some(Poses::new(&given, start, spec.schedule.iterations.0, extent, errors))
    }

    /// A line for the user with the choice and the evidence for it.
    pub(super) fn line(&self, spec: &RunSpec, spelling: Spelling) -> Option<String> {
        let auto = if spec.schedule.poses == PoseChoice::Auto { " (auto)" } else { "" };
        let word = if self.is_on { "refined" } else { "fixed" };
        match self.source {
            PoseSource::Given => None,
            PoseSource::Tracks(errors) => Some(format!(
                "poses    {word}{auto}: judged by {} points, the poses of {} views are off by {:.2} ± {:.2} px (rms); \
                 points lie {:.2} px from where photographs show them (median){}",
                grouped(errors.tracks),
                grouped(errors.views),
                errors.motion,
                errors.uncertainty,
                errors.before,
                if !self.adjusted.is_empty() {
                    format!(", {:.2} px after an adjustment", errors.after)
                } else {
                    String::new()
                },
            )),
            PoseSource::Undecided if self.is_on => Some(format!(
                "poses    {word}: fewer than {MIN_TRACKS} points of a reconstruction are known in enough views, so only \
                 the photographs tell"
            )),
            PoseSource::Undecided => Some(format!(
                "poses    {word}{auto}: undecided, because fewer than {MIN_TRACKS} points of a reconstruction are known \
                 in enough views; {}",
                notes::refine_poses(spelling)
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    #[test]
    fn adjusted_cameras_stay_with_their_views() {
        let camera = |fx: f64| Camera {
            width: 8,
            height: 6,
            fx,
            fy: fx,
            cx: 4.0,
            cy: 3.0,
            rotation: DMat3::IDENTITY,
            translation: glam::DVec3::ZERO,
        };
        let mut poses = RefinedPoses::known(true, PoseSource::Undecided);
        poses.adjusted = [10.0, 12.0, 14.0, 16.0].map(camera).to_vec();
        poses.halve_and_keep(|view| view != 1);
        let left: Vec<_> = poses.adjusted.iter().map(|camera| (camera.width, camera.fx)).collect();
        assert_eq!(left, [(4, 5.0), (4, 7.0), (4, 8.0)]);
    }
}
