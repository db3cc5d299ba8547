//! Renders training views for a decision of the policy.

use densify_policies::policy::AuxView;

use super::policy_calls::call_policy;
use super::{TrainError, Trainer};
use crate::backend::AuxInput;
use crate::views::ViewSource;

impl<V: ViewSource> Trainer<V> {
    /// Renders the auxiliary views for the policy's event after `step`, one by one.
    pub(super) fn show_aux_views(&mut self, step: u32) -> Result<(), TrainError> {
        let (rows, budget) = (self.backend.rows(), self.row_limit());
        let count = call_policy(|| self.policy.aux_views(step, rows, budget));
        let count = count.map_err(|e| self.policy_error(step, e))? as usize;
        let Some(request) = self.needs.aux.clone().filter(|_| count > 0) else {
            return Ok(());
        };
        let (options, degree) = (self.options, self.sh_degree(step));
        for view in self.draw_scored(count, step) {
            let image = self.image(step, view)?;
            let measured = self.backend.observe(&AuxInput {
                step,
                view,
                seed: options.seed,
                camera: self.views.camera(view),
                target: &image,
                background: options.background.at(options.seed, step),
                sh_degree: degree,
                request: &request,
            });
            let measured = measured.map_err(|e| self.backend_error(step, e))?;
            self.extra_forwards += 1;
            let (loss, columns, points) = (measured.loss, &measured.columns, &measured.points);
            let view = AuxView { step, rows, loss, columns, points };
            let seen = call_policy(|| self.policy.observe(&view)).and_then(|done| done);
            seen.map_err(|source| self.policy_error(step, source))?;
        }
        Ok(())
    }
}
