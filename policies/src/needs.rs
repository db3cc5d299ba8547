//! What a policy declares: everything that others do for it.
//!
//! A declaration is data. The trainer and the backend fulfil it without knowing whose it is; what is
//! not declared is neither computed nor allocated.

use serde::{Deserialize, Serialize};

use crate::policy::{Candidate, CandidateRequest, PolicyError, SignalSet};

/// What a policy reads, and how it wants the model to be started and trained.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Needs {
    /// Per-row statistics.
    pub signals: SignalSet,
    /// Camera depth z₀ from which on a view counts in full in the signals of gradients on screen and
    /// by colour `[scene units]`, >= 0: it counts min(1, z/z₀)² times where the row's mean is at depth
    /// z. 0: all views count in full.
    ///
    /// What is near a camera moves far on its image, but few other views show it; such rows are
    /// mostly fog that explains one photograph (*Pixel-GS*, Zhang et al. 2024, section 3.3).
    pub full_depth: f32,
    /// Per-pixel candidates for new rows, if any.
    pub candidates: Option<CandidateRequest>,
    /// Training views, drawn at random without replacement, that are rendered anew for each event
    /// that [wants them](crate::policy::DensityPolicy::wants_fresh): all of them if there are fewer.
    /// Goes with [`Signal::FreshWeightMax`](crate::policy::Signal::FreshWeightMax); 0 without it.
    pub fresh_views: u32,
    /// What [auxiliary views](crate::policy::DensityPolicy::observe) show, if any are wanted.
    pub aux: Option<AuxRequest>,
    /// Terms of the training loss beside the image's.
    pub loss_terms: LossTerms,
    /// Noise on the means after each optimiser step.
    pub noise: Option<NoiseTerm>,
    /// Longest [cadence](crate::policy::DensityPolicy::cadence) of the run: beyond 1, gradients are
    /// summed between steps, and the sums need memory.
    pub cadence: Cadence,
    /// Step sizes that replace the trainer's defaults, but not what the user sets.
    pub rates: RateOverrides,
    /// How the initial rows differ from the trainer's.
    pub start: StartRule,
}

impl Needs {
    /// Checks every number that a backend would have to take on trust.
    ///
    /// # Errors
    /// What is out of range, with its value.
    pub fn check(&self) -> Result<(), String> {
        let finite = |what: &str, value: f64, least: f64| {
            if value.is_finite() && value >= least {
                return Ok(());
            }
            Err(format!("{what} is {value}; it must be finite and at least {least}"))
        };
        let above_zero = |what: &str, value: Option<f64>| match value {
            Some(v) if !(v.is_finite() && v > 0.0) => {
                Err(format!("{what} is {v}; it must be positive"))
            }
            _ => Ok(()),
        };
        finite("full_depth", self.full_depth.into(), 0.0)?;
        finite("loss_terms.opacity", self.loss_terms.opacity.into(), 0.0)?;
        finite("loss_terms.scale", self.loss_terms.scale.into(), 0.0)?;
        if let Some(noise) = self.noise {
            finite("noise.strength", noise.strength.into(), 0.0)?;
            finite("noise.sharpness", noise.sharpness.into(), 0.0)?;
            finite("noise.opacity", noise.opacity.into(), 0.0)?;
        }
        if let Some(aux) = &self.aux {
            finite("aux.map.error", aux.map.error.into(), 0.0)?;
            finite("aux.map.edge", aux.map.edge.into(), 0.0)?;
        }
        finite("cadence.all", self.cadence.all.into(), 1.0)?;
        finite("cadence.sh_rest", self.cadence.sh_rest.into(), 1.0)?;
        above_zero("rates.mean_start", self.rates.mean_start)?;
        above_zero("rates.mean_end", self.rates.mean_end)?;
        above_zero("rates.sh_rest", self.rates.sh_rest.map(f64::from))?;
        above_zero("start.scale", Some(self.start.scale.into()))?;
        match self.start.opacity {
            Some(opacity) if !(opacity > 0.0 && opacity < 1.0) => {
                Err(format!("start.opacity is {opacity}; it must be between 0 and 1"))
            }
            _ => Ok(()),
        }
    }
}

/// Terms added to the image's loss, as coefficients; 0 switches one off, at no cost.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct LossTerms {
    /// Coefficient of the mean over rows of the opacity, >= 0.
    pub opacity: f32,
    /// Coefficient of the mean over rows and axes of the standard deviation
    /// `[1 / scene units]`, >= 0.
    pub scale: f32,
}

impl LossTerms {
    /// Whether no term is wanted.
    #[must_use]
    pub fn is_none(&self) -> bool {
        !(self.opacity > 0.0 || self.scale > 0.0)
    }
}

/// Noise on the means after each optimiser step (*3D Gaussian Splatting as Markov Chain Monte Carlo*,
/// Kheradmand et al. 2024, section 3.2): Δμ = Σ·ξ · σ(−`sharpness`·(o − `opacity`)) · `strength` · λ,
/// with Σ the row's covariance, ξ ~ N(0, I), o its opacity, σ the logistic function and λ the step
/// size of the means at that step `[scene units]`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NoiseTerm {
    /// Factor of the noise `[1 / scene units²]`, >= 0.
    pub strength: f32,
    /// How steeply noise falls with opacity, >= 0.
    pub sharpness: f32,
    /// Opacity at which half of the noise is left.
    pub opacity: f32,
}

impl NoiseTerm {
    /// The share of the noise that is left at this opacity, in (0, 1).
    #[must_use]
    pub fn share(&self, opacity: f32) -> f32 {
        1.0 / (1.0 + (self.sharpness * (opacity - self.opacity)).exp())
    }
}

/// How often the optimiser steps. In between gradients are summed over the views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cadence {
    /// One optimiser step every so many iterations, for all parameters; >= 1.
    pub all: u32,
    /// The same for the spherical-harmonic coefficients of bands 1–3, which never step more often
    /// than the others; >= 1.
    pub sh_rest: u32,
}

impl Default for Cadence {
    fn default() -> Self {
        Self { all: 1, sh_rest: 1 }
    }
}

impl Cadence {
    /// Whether all parameters but the spherical-harmonic coefficients of bands 1–3 step after
    /// iteration `step`, and whether these do: at multiples of their intervals.
    #[must_use]
    pub fn steps_at(self, step: u32) -> [bool; 2] {
        let all = self.all.max(1);
        [step.is_multiple_of(all), step.is_multiple_of(self.sh_rest.max(all))]
    }

    /// Whether a backend that was made for `longest` keeps all that this cadence needs: sums of all
    /// gradients or of those of bands 1–3, and a count of steps for these.
    #[must_use]
    pub fn is_within(self, longest: Self) -> bool {
        let is_sound = self.all > 0 && self.sh_rest > 0;
        let all = self.all == 1 || longest.all > 1;
        let apart = self.sh_rest <= self.all || longest.sh_rest > 1;
        is_sound && all && apart
    }
}

/// Step sizes that a policy is published with; `None` leaves the trainer's.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct RateOverrides {
    /// Means, at the start of the run `[fraction of the extent per step]`, > 0.
    pub mean_start: Option<f64>,
    /// Means, at the end of the run `[fraction of the extent per step]`, > 0.
    pub mean_end: Option<f64>,
    /// Spherical-harmonic coefficients of bands 1–3, > 0.
    pub sh_rest: Option<f32>,
}

/// How the initial rows differ from the trainer's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StartRule {
    /// Opacity of all rows, in (0, 1), if not the trainer's.
    pub opacity: Option<f32>,
    /// Factor of all standard deviations, > 0.
    pub scale: f32,
}

impl Default for StartRule {
    fn default() -> Self {
        Self { opacity: None, scale: 1.0 }
    }
}

/// What is measured in an auxiliary view: a training view that is rendered, as the model is now, for
/// an event of the policy.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AuxRequest {
    /// The pixel map M that [`AuxColumn::MapSum`] sums.
    pub map: PixelMap,
    /// Per-row columns.
    pub columns: Vec<AuxColumn>,
    /// Most surface points per view: pixels drawn without replacement in proportion to their
    /// accumulated alpha. A pixel stands for the point where its ray passes closest to the Gaussian
    /// with the largest blend weight ([`DepthMode::MaxWeight`](crate::policy::DepthMode::MaxWeight)).
    pub points: u32,
}

/// M(p) = `error`·n(e) + `edge`·n(g), with n(·) the map brought to 0..1 by its least and its largest
/// value in the view (0 where they are equal), e(p) the mean over channels of |I − G|, and g(p) the
/// 8-neighbour Laplacian of the 8-bit luma of the ground truth, clipped to 0..255, its border
/// repeated. Where the image is masked, e and g count by the mask.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PixelMap {
    /// Weight of the error, >= 0.
    pub error: f32,
    /// Weight of the edges, >= 0.
    pub edge: f32,
}

/// A per-row column of one auxiliary view. The sums run over the pixels that the row was blended
/// into; all are 0 for rows that are not on screen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum AuxColumn {
    /// Sum of the pixel map, not weighted by alpha, >= 0.
    MapSum,
    /// Number of pixels, >= 0.
    PixelCount,
    /// Sum of the blend weights α·T, >= 0.
    WeightSum,
    /// Sum of the distances from the pixel's centre to the projected mean `[px]`, >= 0.
    DistanceSum,
    /// Camera z of the mean `[scene units]`.
    Depth,
    /// Radius on screen, three standard deviations along the longer axis, rounded up `[px]`.
    Radius,
}

impl AuxColumn {
    /// All columns, in declaration order.
    pub const ALL: [Self; 6] = [
        Self::MapSum,
        Self::PixelCount,
        Self::WeightSum,
        Self::DistanceSum,
        Self::Depth,
        Self::Radius,
    ];
}

/// One auxiliary view, as the policy sees it.
#[derive(Debug, Clone, Copy)]
pub struct AuxView<'a> {
    /// Iteration just finished, 1-based.
    pub step: u32,
    /// Rows of the model.
    pub rows: usize,
    /// 0.8·L1 + 0.2·(1 − SSIM) of this view.
    pub loss: f32,
    /// The columns that were asked for. Shape of each: `[rows]`.
    pub columns: &'a [(AuxColumn, Vec<f32>)],
    /// Surface points, in the order in which their pixels were drawn. Their error is the alpha of
    /// the pixel.
    pub points: &'a [Candidate],
}

impl<'a> AuxView<'a> {
    /// The values of `column`. Shape: `[rows]`.
    ///
    /// # Errors
    /// [`PolicyError::UndeclaredColumn`] when the policy's [`AuxRequest`] did not list it.
    pub fn column(&self, column: AuxColumn) -> Result<&'a [f32], PolicyError> {
        let found = self.columns.iter().find(|(name, _)| *name == column);
        found.map(|(_, values)| &values[..]).ok_or(PolicyError::UndeclaredColumn { column })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_a_backend_would_trust_are_checked() {
        assert_eq!(Needs::default().check(), Ok(()));
        let noise = NoiseTerm { strength: 1.0, sharpness: 100.0, opacity: 0.005 };
        let wrong = [
            Needs { loss_terms: LossTerms { opacity: -1.0, scale: 0.0 }, ..Needs::default() },
            Needs { loss_terms: LossTerms { opacity: 0.0, scale: f32::NAN }, ..Needs::default() },
            Needs {
                noise: Some(NoiseTerm { strength: f32::INFINITY, ..noise }),
                ..Needs::default()
            },
            Needs { cadence: Cadence { all: 0, sh_rest: 1 }, ..Needs::default() },
            Needs { cadence: Cadence { all: 1, sh_rest: 0 }, ..Needs::default() },
            Needs {
                rates: RateOverrides { mean_end: Some(0.0), ..RateOverrides::default() },
                ..Needs::default()
            },
            Needs { start: StartRule { opacity: Some(1.0), scale: 1.0 }, ..Needs::default() },
            Needs { start: StartRule { opacity: None, scale: 0.0 }, ..Needs::default() },
            Needs {
                aux: Some(AuxRequest {
                    map: PixelMap { error: -1.0, edge: 0.0 },
                    ..AuxRequest::default()
                }),
                ..Needs::default()
            },
        ];
        for needs in wrong {
            assert!(needs.check().is_err(), "{needs:?}");
        }
    }

    #[test]
    fn the_cadence_counts_multiples() {
        let due = |cadence: Cadence, class: usize| -> Vec<u32> {
            (1..=12).filter(|&step| cadence.steps_at(step)[class]).collect()
        };
        assert_eq!(due(Cadence::default(), 0).len(), 12);
        let sh = Cadence { all: 1, sh_rest: 4 };
        assert_eq!((due(sh, 0).len(), due(sh, 1)), (12, vec![4, 8, 12]));
        // Bands 1–3 are never ahead of the others.
        let all = Cadence { all: 5, sh_rest: 1 };
        assert_eq!((due(all, 0), due(all, 1)), (vec![5, 10], vec![5, 10]));
        assert!(sh.is_within(sh) && !sh.is_within(Cadence::default()));
        assert!(!sh.is_within(all) && !all.is_within(sh));
        assert!(Cadence::default().is_within(all) && all.is_within(Cadence { all: 2, sh_rest: 1 }));
        assert!(Cadence { all: 4, sh_rest: 3 }.is_within(all));
        assert!(!Cadence { all: 0, sh_rest: 1 }.is_within(all));
    }

    #[test]
    fn noise_is_halved_at_its_opacity() {
        let noise = NoiseTerm { strength: 1.0, sharpness: 100.0, opacity: 0.005 };
        assert!((noise.share(0.005) - 0.5).abs() < 1e-6);
        // σ(−100·(0.1 − 0.005)) = σ(−9.5).
        assert!((noise.share(0.1) / 7.484_62e-5 - 1.0).abs() < 1e-4);
    }
}
