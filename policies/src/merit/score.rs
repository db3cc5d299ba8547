//! What a row's gradients say of its need for children.

use super::Merit;
use crate::adc::{add_colour_gradient, mean_over_views};
use crate::policy::{PolicyResult, Signal, Snapshot};

impl Merit {
    /// The gradient g of every row, >= 0. Shape: `[rows]`.
    pub(super) fn gradient(&self, now: &Snapshot<'_>) -> PolicyResult<Vec<f32>> {
        let views = now.signal(Signal::VisibleCount)?;
        let screen = now.signal(self.params.gradient.signal())?;
        let mut gradient = mean_over_views(screen, views);
        if self.params.colour_weight > 0.0 {
            add_colour_gradient(&mut gradient, now, self.params.colour_weight as f32)?;
        }
        Ok(gradient)
    }
}
