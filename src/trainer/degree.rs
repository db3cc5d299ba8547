//! The degree of colour in use at a step: as the schedule has it, or earned.
//!
//! Where nothing is known of a scene's colours before training, each degree is on trial for a time.
//! Its coefficients begin at zero, and the probes are not trained on meanwhile, so that these
//! coefficients have never seen them: what the probes gain by the new band is what it has learned of
//! the scene, and not of the photographs that it was fitted to. (That the loss falls while a band is
//! new says nothing: at this stage it falls anyway.) The first degree that does not pay is taken back,
//! and no higher one is tried.

use serde::{Deserialize, Serialize};

use super::probe::mean;
use super::{TrainError, Trainer};
use crate::schedule::{self, scaled};
use crate::views::ViewSource;

/// What a band must bring to be kept `[dB]`: 0.5 % of the root mean square error.
const PAYS: f64 = 0.0435;
/// Steps between two raises in a run of 30,000 (Kerbl et al. 2023), and at least so many epochs: a
/// coefficient must have seen the scene from all sides.
const TRIAL: u32 = 1_000;
const EPOCHS: u32 = 2;

/// A degree that is earned.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Earned {
    /// The degree in use.
    pub degree: u8,
    /// Whether it is on trial.
    pub on_trial: bool,
    /// Whether it stays.
    pub settled: bool,
    /// The trials so far.
    pub trials: Vec<Trial>,
}

/// What came of the trial of a degree.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trial {
    /// Iteration at its end.
    pub step: u32,
    /// The degree.
    pub degree: u8,
    /// What the probes gain by its band, in the mean `[dB]`; `None` where there are too few views to
    /// spare any.
    pub gain: Option<f64>,
    /// Whether the degree was kept.
    pub kept: bool,
}

impl Earned {
    /// The view of a step: not one of `probes` during a trial, but the next in the epoch's order that
    /// is none.
    pub(super) fn view(&self, order: &[usize], place: usize, probes: &[usize]) -> usize {
        let after = order.iter().skip(place).chain(order).copied();
        let mut free = after.filter(|view| !self.on_trial || !probes.contains(view));
        free.next().unwrap_or(order[place])
    }
}

impl<V: ViewSource> Trainer<V> {
    /// The degree at which a step's view is rendered.
    #[must_use]
    pub fn sh_degree(&self, step: u32) -> u8 {
        let options = &self.options;
        match &self.earned {
            Some(earned) => earned.degree.min(options.sh_degree),
            None => schedule::sh_degree(step, options.iterations, options.sh_degree),
        }
    }

    /// Ends a trial and begins the next one, where `step` is due for it.
    pub(super) fn earn(&mut self, step: u32) -> Result<(), TrainError> {
        let highest = self.options.sh_degree;
        let epochs = EPOCHS.saturating_mul(u32::try_from(self.views.count()).unwrap_or(u32::MAX));
        let every = scaled(TRIAL, self.options.iterations).max(epochs);
        let Some(mut earned) = self.earned.take_if(|earned| !earned.settled) else {
            return Ok(());
        };
        if step.is_multiple_of(every) {
            if earned.on_trial {
                let degree = earned.degree;
                let gain = self.gain_of(step, degree)?;
                let kept = gain.is_none_or(|gain| gain > PAYS);
                tracing::info!(step, degree, gain, kept, "degree of colour");
                earned.trials.push(Trial { step, degree, gain, kept });
                earned.on_trial = false;
                earned.degree -= u8::from(!kept);
                earned.settled = !kept;
            }
            earned.settled |= earned.degree >= highest;
            if !earned.settled {
                earned.degree += 1;
                earned.on_trial = true;
            }
        }
        self.earned = Some(earned);
        Ok(())
    }

    /// What the probes gain by the band of a degree.
    fn gain_of(&mut self, step: u32, degree: u8) -> Result<Option<f64>, TrainError> {
        if self.probes.is_empty() {
            return Ok(None);
        }
        let with = self.probe(step, degree)?;
        let without = self.probe(step, degree - 1)?;
        let gains: Vec<f64> = with.iter().zip(&without).map(|(a, b)| a - b).collect();
        Ok(Some(mean(&gains)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probes_are_passed_over_during_a_trial_only() {
        let order = [3, 1, 4, 0, 2];
        let mut earned = Earned::default();
        let views =
            |earned: &Earned| [0, 1, 2, 3, 4].map(|place| earned.view(&order, place, &[1, 2]));
        assert_eq!(views(&earned), order);
        earned.on_trial = true;
        assert_eq!(views(&earned), [3, 4, 4, 0, 3]);
        assert_eq!(earned.view(&order, 1, &[0, 1, 2, 3, 4]), 1, "there is no other");
    }
}
