//! The declarations of a policy: the statistics it reads, and changes to initialisation, loss and optimiser.
//!
//! The trainer and the backend act on these declarations without knowing the policy. Only declared statistics are
//! computed and allocated.

mod pixels;
mod rates;
mod terms;

use serde::{Deserialize, Serialize};

use crate::signals::{Signal, SignalSet};
pub use pixels::{
    AuxRequest, CandidateRequest, DepthMode, ErrorMap, ErrorMode, ErrorScore, PixelMap,
};
pub use rates::{Cadence, Fade, Rate, RateOverrides};
pub use terms::{LossTerms, MaskTerm, NoiseTerm, PixelLoss, PixelLossChoice};

/// The inputs of a policy, and its changes to initialisation and training.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Needs {
    /// Statistics of each row that the policy reads.
    pub signals: SignalSet,
    /// Camera depth z₀ `[scene units]`, >= 0, below which a view counts less in the signals of screen
    /// and colour gradients: it is weighted by min(1, z/z₀)², where z is the depth of the row's mean. 0: all
    /// views count equally.
    ///
    /// Gaussians near a camera have large screen gradients but appear in few other views; growing them
    /// mostly produces floaters that fit a single photograph (*Pixel-GS*, Zhang et al. 2024, section 3.3).
    pub full_depth: f32,
    /// The rule by which pixel errors are summed into [`Signal::ErrorScore`].
    pub error_score: ErrorScore,
    /// Pixels to collect as candidates for new rows, if any.
    pub candidates: Option<CandidateRequest>,
    /// Measurements in [auxiliary views](crate::policy::DensityPolicy::observe), if any.
    pub aux: Option<AuxRequest>,
    /// The pixel term of the image loss. With [`PixelLoss::Huber`], the learning rates of short runs are
    /// also larger.
    pub pixel_loss: PixelLoss,
    /// Terms added to the training loss; the policy may [vary](crate::policy::DensityPolicy::loss_terms) them
    /// by step.
    pub loss_terms: LossTerms,
    /// Noise on the means after each optimiser step; the policy may
    /// [vary](crate::policy::DensityPolicy::noise) it by step.
    pub noise: Option<NoiseTerm>,
    /// A learned mask per row, if any.
    pub mask: Option<MaskTerm>,
    /// Longest [cadence](crate::policy::DensityPolicy::cadence) of the run. If above 1, gradients are
    /// summed between optimiser steps, and the sums need memory.
    pub cadence: Cadence,
    /// Smallest [factor](crate::policy::DensityPolicy::resolution) on the sides of training images in the run,
    /// in (0, 1]. `None`: images are always full-size, and no memory is reserved for smaller ones.
    pub least_resolution: Option<f64>,
    /// Learning rates that replace the trainer's defaults, but not the user's settings.
    pub rates: RateOverrides,
    /// Changes to the initial rows.
    pub start: StartRule,
    /// True if plans may hold edits that take more memory than others: rows rewritten in place
    /// ([`EditPlan::update`](crate::plan::EditPlan::update)), and children that are rotated or whose scales
    /// are set or change separately for each axis ([`ScaleRule::Axes`](crate::plan::ScaleRule::Axes)).
    pub detailed_edits: bool,
    /// Memory that the policy itself takes at an event, beyond the values that every policy derives from its signals:
    /// the copies that a policy written in Python works on `[bytes per row]`.
    pub scratch_bytes: usize,
    /// True if the policy copies candidates and the points of auxiliary views, as policies written in Python do.
    pub copies_points: bool,
}

impl Needs {
    /// Checks that this factor on the sides of images is within the declared range.
    ///
    /// # Errors
    /// When it is NaN, above 1 or below the declared minimum; the message has the factor and the minimum.
    pub fn check_resolution(&self, factor: f64) -> Result<(), String> {
        let minimum = self.least_resolution.unwrap_or(1.0);
        if (minimum..=1.0).contains(&factor) {
            return Ok(());
        }
        Err(format!("the resolution is {factor}; it must be from {minimum} (as declared) to 1"))
    }

    /// Checks that every number is finite and in its range.
    ///
    /// # Errors
    /// The first number that is not, with its value.
    pub fn check(&self) -> Result<(), String> {
        at_least("full_depth", self.full_depth.into(), 0.0)?;
        self.error_score.check()?;
        self.loss_terms.check()?;
        self.noise.map_or(Ok(()), |noise| noise.check())?;
        match &self.mask {
            Some(mask) => {
                mask.check()?;
                if self.cadence.all > 1 {
                    return Err("masks are updated at every view: cadence.all must be 1".to_owned());
                }
            }
            None if self.signals.contains(Signal::Mask) => {
                return Err("the signal Mask is declared, but `mask` is not set".to_owned());
            }
            None => {}
        }
        if let Some(aux) = &self.aux {
            at_least("aux.map.error", aux.map.error.into(), 0.0)?;
            at_least("aux.map.edge", aux.map.edge.into(), 0.0)?;
            for (name, value) in
                [("aux.margin", aux.margin), ("aux.map.threshold", aux.map.threshold)]
            {
                if !(0.0..1.0).contains(&value) {
                    return Err(format!("{name} is {value}; it must be at least 0 and below 1"));
                }
            }
        }
        if let Some(least) = self.least_resolution.filter(|least| !(*least > 0.0 && *least <= 1.0))
        {
            return Err(format!("least_resolution is {least}; it must be above 0 and at most 1"));
        }
        at_least("cadence.all", self.cadence.all.into(), 1.0)?;
        at_least("cadence.sh_rest", self.cadence.sh_rest.into(), 1.0)?;
        self.rates.check()?;
        above_zero("start.scale", self.start.scale.into())?;
        match self.start.opacity {
            Some(opacity) if !(opacity > 0.0 && opacity < 1.0) => {
                Err(format!("start.opacity is {opacity}; it must be above 0 and below 1"))
            }
            _ => Ok(()),
        }
    }
}

fn at_least(name: &str, value: f64, minimum: f64) -> Result<(), String> {
    if value.is_finite() && value >= minimum {
        return Ok(());
    }
    Err(format!("{name} is {value}; it must be finite and at least {minimum}"))
}

fn above_zero(name: &str, value: f64) -> Result<(), String> {
    if value.is_finite() && value > 0.0 {
        return Ok(());
    }
    Err(format!("{name} is {value}; it must be finite and positive"))
}

/// Changes to the initial rows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StartRule {
    /// Opacity of all rows, in (0, 1); `None`: the trainer's default.
    pub opacity: Option<f32>,
    /// Factor on all standard deviations, > 0.
    pub scale: f32,
}

impl Default for StartRule {
    fn default() -> Self {
        Self { opacity: None, scale: 1.0 }
    }
}

#[cfg(test)]
mod tests;
