//! Training views that are rendered for a decision of the policy: fresh signals, and auxiliary
//! views.

use densify_policies::policy::{AuxView, Needs, Signal};

use super::guard::asked;
use super::{TrainError, Trainer};
use crate::backend::AuxInput;
use crate::views::ViewSource;

impl<V: ViewSource> Trainer<V> {
    /// Measures the views that the policy wants for its event after `step`. Returns what it may
    /// read there: without fresh signals where it wants no view.
    pub(super) fn measure_fresh(&mut self, step: u32) -> Result<Needs, TrainError> {
        let mut needs = self.needs.clone();
        let (rows, budget) = (self.backend.rows(), self.limit());
        let could = needs.signals.contains(Signal::FreshWeightMax) && needs.fresh_views > 0;
        let wants = || could && self.policy.wants_fresh(step, rows, budget);
        if !asked(wants).map_err(|e| self.refused(step, e))? {
            needs.signals = needs.signals.without(Signal::FreshWeightMax);
            return Ok(needs);
        }
        let degree = self.sh_degree(step);
        let wanted = needs.fresh_views as usize;
        for view in self.scored.draw(wanted, self.options.seed, step) {
            let measured = self.backend.measure_weights(self.views.camera(view), degree);
            measured.map_err(|e| self.stopped(step, e))?;
            self.extra_forwards += 1;
        }
        Ok(needs)
    }

    /// Shows the policy the auxiliary views that it wants for its event after `step`, one by one.
    pub(super) fn show_views(&mut self, step: u32) -> Result<(), TrainError> {
        let (rows, budget) = (self.backend.rows(), self.limit());
        let wanted = asked(|| self.policy.aux_views(step, rows, budget));
        let wanted = wanted.map_err(|e| self.refused(step, e))? as usize;
        let Some(request) = self.needs.aux.clone().filter(|_| wanted > 0) else {
            return Ok(());
        };
        let (options, degree) = (self.options, self.sh_degree(step));
        for view in self.scored.draw(wanted, options.seed, step) {
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
            let measured = measured.map_err(|e| self.stopped(step, e))?;
            self.extra_forwards += 1;
            let (loss, columns, points) = (measured.loss, &measured.columns, &measured.points);
            let view = AuxView { step, rows, loss, columns, points };
            let seen = asked(|| self.policy.observe(&view)).and_then(|done| done);
            seen.map_err(|source| self.refused(step, source))?;
        }
        Ok(())
    }
}
