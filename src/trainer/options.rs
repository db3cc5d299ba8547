//! How a run goes.

use crate::schedule::{Background, RateOptions};

/// How a run goes, beside its scene and its policy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainOptions {
    /// Length of the run in steps, >= 1; schedules scale with it.
    pub iterations: u32,
    /// Seed of everything that is drawn.
    pub seed: u64,
    /// Highest spherical-harmonic degree trained, <= the model's.
    pub sh_degree: u8,
    /// What lies behind the Gaussians.
    pub background: Background,
    /// Step sizes.
    pub rates: RateOptions,
    /// Iterations per optimiser step of the spherical-harmonic coefficients of bands 1–3, if not the
    /// policy's choice; >= 1.
    pub sh_every: Option<u32>,
    /// How many views ahead are announced to the [`ViewSource`](crate::views::ViewSource).
    pub prefetch: usize,
    /// What becomes of rows that hold a number that is not finite.
    pub on_nan: OnNan,
    /// Where less is computed than could be.
    pub savings: Savings,
}

/// Where a run computes less than it could, beside its backend
/// ([`Shortcuts`](crate::backend::Shortcuts)). The default is nowhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Savings {
    /// The loss has its SSIM term in every so many-th step, with as many times its weight, so that
    /// the gradient is the same in the mean; >= 1.
    pub ssim_every: u32,
    /// Share of the run that is trained on shrunk images ([`schedule::divisor`]), in `[0, 1)`.
    ///
    /// [`schedule::divisor`]: crate::schedule::divisor
    pub coarse_until: f64,
    /// Share of the budget up to which policies may let rows grow, in `(0, 1]`.
    pub budget_share: f64,
}

impl Savings {
    /// None.
    pub const NONE: Self = Self { ssim_every: 1, coarse_until: 0.0, budget_share: 1.0 };

    /// What of a budget may be used, at least 1 of any.
    #[must_use]
    pub fn rows(self, budget: usize) -> usize {
        ((budget as f64 * self.budget_share) as usize).max(1).min(budget)
    }

    /// Factor of the SSIM term in a step of a run of so many iterations. The last step has it, so
    /// that a run ends with a measurement.
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

/// What a run is to find out by itself about its scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Required {
    /// The number of rows, up to the budget.
    pub rows: bool,
    /// Which training views say something that others do not, where rows are scored.
    pub scored_views: bool,
}

/// What becomes of rows with a parameter or a moment that is NaN or infinite.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OnNan {
    /// They are removed; only many of them at once end the run.
    #[default]
    Prune,
    /// They end the run.
    Stop,
}
