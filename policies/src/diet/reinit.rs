//! Re-initialisation: the whole model is replaced by surface points seen in the training views.

use super::Diet;
use crate::plan::EditPlan;
use crate::policy::SceneInfo;
use crate::quota::share_of_budget;
use crate::surface::{points_per_view, replace_model};

impl Diet {
    /// True if the model is replaced at `step`.
    pub(super) fn is_reinit(&self, step: u32) -> bool {
        step > 0 && step == self.params.reinit_at
    }

    /// Number of surface points to measure per view; 0 if the model is never replaced.
    pub(super) fn surface_points(&self, scene: &SceneInfo) -> u32 {
        if self.params.reinit_at == 0 {
            return 0;
        }
        points_per_view(share_of_budget(self.params.reinit_share, scene.budget), scene.train_views)
    }

    /// Replaces all rows by the surface points. Without any point the model is kept.
    pub(super) fn reinit(&mut self, extent: f32, plan: &mut EditPlan) {
        let surface = std::mem::take(&mut self.surface);
        let max_rows = share_of_budget(self.params.reinit_share, plan.budget());
        replace_model(&surface, max_rows, self.params.newborn_opacity as f32, extent, plan);
    }
}
