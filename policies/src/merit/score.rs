//! What asks for births, and what holds up against deaths.

use super::{Importance, Merit};
use crate::adc::mean_over_views;
use crate::policy::{PolicyResult, Signal, Snapshot};

impl Merit {
    /// The need of each row, >= 0. Shape: `[rows]`.
    pub(super) fn need(&self, now: &Snapshot<'_>) -> PolicyResult<Vec<f32>> {
        let params = &self.params;
        let views = now.signal(Signal::VisibleCount)?;
        let mut need = mean_over_views(now.signal(params.gradient.signal())?, views);
        if params.colour_weight > 0.0 {
            let colour = mean_over_views(now.signal(Signal::ColourGradient)?, views);
            for (need, colour) in need.iter_mut().zip(colour) {
                *need += params.colour_weight as f32 * colour;
            }
        }
        if params.error_share > 0.0 {
            let share = params.error_share as f32;
            let error = mean_over_views(now.signal(Signal::ErrorScore)?, views);
            for (need, error) in need.iter_mut().zip(error) {
                *need = need.powf(1.0 - share) * error.powf(share);
            }
        }
        Ok(need)
    }

    /// How much each row would be missed, >= 0. Shape: `[rows]`.
    pub(super) fn importance(&self, now: &Snapshot<'_>) -> PolicyResult<Vec<f32>> {
        let signal = now.signal(self.params.importance.signal())?;
        Ok(match self.params.importance {
            Importance::Max => signal.to_vec(),
            Importance::Mean => {
                let mean = mean_over_views(signal, now.signal(Signal::VisibleCount)?);
                mean.into_iter().map(|root| root * root).collect()
            }
        })
    }
}
