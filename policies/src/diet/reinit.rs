//! Re-initialisation: the whole model is replaced by surface points seen in the training views.

use super::Diet;
use crate::plan::EditPlan;
use crate::policy::SceneInfo;
use crate::quota::rows_of_share;
use crate::surface::{points_per_view, replace_model};

impl Diet {
    /// Whether the model is replaced at `step`.
    pub(super) fn is_reinit(&self, step: u32) -> bool {
        step > 0 && step == self.params.reinit_at
    }

    /// How many surface points of a view to measure, if the model is ever replaced.
    pub(super) fn surface_points(&self, scene: &SceneInfo) -> u32 {
        if self.params.reinit_at == 0 {
            return 0;
        }
        points_per_view(rows_of_share(self.params.reinit_share, scene.budget), scene.train_views)
    }

    /// Prunes all rows and appends the surface points instead. Without any point the model is kept.
    pub(super) fn reinit(&mut self, extent: f32, plan: &mut EditPlan) {
        let surface = std::mem::take(&mut self.surface);
        let most = rows_of_share(self.params.reinit_share, plan.budget());
        replace_model(&surface, most, self.params.newborn_opacity as f32, extent, plan);
    }
}
