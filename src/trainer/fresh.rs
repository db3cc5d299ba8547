//! Fresh signals: training views that are rendered for a decision of the policy.

use densify_policies::policy::{Needs, Signal};

use super::{TrainError, Trainer};
use crate::schedule;
use crate::views::ViewSource;

impl<V: ViewSource> Trainer<V> {
    /// Measures the views that the policy wants for its event after `step`. Returns what it may
    /// read there: without fresh signals where it wants no view.
    pub(super) fn measure_fresh(&mut self, step: u32) -> Result<Needs, TrainError> {
        let mut needs = self.needs.clone();
        let (rows, budget) = (self.backend.rows(), self.backend.budget());
        if !needs.signals.contains(Signal::FreshWeightMax)
            || needs.fresh_views == 0
            || !self.policy.wants_fresh(step, rows, budget)
        {
            needs.signals = needs.signals.without(Signal::FreshWeightMax);
            return Ok(needs);
        }
        let options = &self.options;
        let degree = schedule::sh_degree(step, options.iterations, options.sh_degree);
        let wanted = needs.fresh_views as usize;
        for view in schedule::fresh_views(self.views.count(), wanted, options.seed, step) {
            let measured = self.backend.measure_weights(self.views.camera(view), degree);
            measured.map_err(|e| self.stopped(step, e))?;
            self.extra_forwards += 1;
        }
        Ok(needs)
    }
}
