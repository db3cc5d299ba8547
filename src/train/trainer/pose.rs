//! Cameras of the training views, with their poses refined if the run refines them.

use super::Trainer;
use densify_core::camera::Camera;
use densify_data::views::ViewSource;
use densify_render::StepOutput;

impl<V: ViewSource> Trainer<V> {
    /// The current camera of a training view.
    pub fn camera(&self, view: usize) -> Camera {
        let given = self.views.camera(view);
        self.state.poses.as_ref().map_or(*given, |poses| poses.camera(view, given))
    }

    /// Takes a step of the view's pose, if poses are refined.
    pub(super) fn move_pose(&mut self, step: u32, view: usize, output: &StepOutput, progress: f64) {
        let Some((poses, gradient)) = self.state.poses.as_mut().zip(output.pose) else { return };
        poses.step(view, self.views.camera(view), &gradient, progress);
        if (step as usize).is_multiple_of(self.views.count()) {
            poses.fix_gauge(|view| self.views.camera(view));
        }
    }
}
