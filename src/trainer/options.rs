//! Options of a run that the trainer acts on.

use serde::{Deserialize, Serialize};

use crate::schedule::{Background, RateOptions};

/// Options of a run, beside its scene and its policy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainOptions {
    /// Length of the run in steps, >= 1; schedules scale with it.
    pub iterations: u32,
    /// Seed of all random draws.
    pub seed: u64,
    /// Highest spherical-harmonic degree trained, <= the model's.
    pub sh_degree: u8,
    /// Colour behind the Gaussians.
    pub background: Background,
    /// Learning rates.
    pub rates: RateOptions,
    /// Iterations per optimiser step of the spherical-harmonic coefficients of bands 1–3, >= 1; `None`
    /// leaves the choice to the policy.
    pub sh_every: Option<u32>,
    /// Number of views to prefetch from the [`ViewSource`](crate::views::ViewSource).
    pub prefetch: usize,
    /// What happens to rows with non-finite values.
    pub on_nan: OnNan,
    /// Computations that are left out to save time.
    pub savings: Savings,
}

/// Computations that the trainer leaves out to save time; none by default. Those of the backend are its
/// [`Shortcuts`](crate::backend::Shortcuts).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Savings {
    /// The SSIM term is part of the loss once in this many steps, with its weight multiplied by the same
    /// number, so that the mean gradient is unchanged; >= 1.
    pub ssim_every: u32,
    /// Share of the run trained on downsampled images ([`schedule::divisor`]), in `[0, 1)`.
    ///
    /// [`schedule::divisor`]: crate::schedule::divisor
    pub coarse_until: f64,
    /// Share of the budget that policies may use, in `(0, 1]`.
    pub budget_share: f64,
}

impl Savings {
    /// Nothing is left out.
    pub const NONE: Self = Self { ssim_every: 1, coarse_until: 0.0, budget_share: 1.0 };

    /// The rows of a budget that may be used, at least 1.
    #[must_use]
    pub fn rows(self, budget: usize) -> usize {
        ((budget as f64 * self.budget_share) as usize).max(1).min(budget)
    }

    /// Factor on the SSIM term at a step. The last step always has the term, so that a run ends with a
    /// complete loss.
    #[must_use]
    pub fn ssim_weight(self, step: u32, iterations: u32) -> f32 {
        let every = self.ssim_every.max(1);
        if step.is_multiple_of(every) || step == iterations { every as f32 } else { 0.0 }
    }
}

impl Default for Savings {
    fn default() -> Self {
        Self::NONE
    }
}

/// Choices that a run makes by itself, from measurements of its scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct AutoChoices {
    /// The number of rows, up to the budget (`--budget auto`).
    pub rows: bool,
    /// Which training views the policy's scores are measured in: near-duplicates are left out.
    pub scored_views: bool,
}

/// What happens to rows with a parameter or a moment that is NaN or infinite.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum OnNan {
    /// Stop the run, with a checkpoint
    Stop,
    /// Remove them; stop only if they are more than 0.1 % at once
    #[default]
    Prune,
}
