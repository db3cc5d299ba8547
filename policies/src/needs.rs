//! What a policy declares: the statistics it reads, and changes to initialisation, loss and optimiser.
//!
//! The trainer and the backend act on these declarations without knowing the policy. What is not
//! declared is neither computed nor allocated.

use serde::{Deserialize, Serialize};

use crate::signals::{AuxColumn, Signal, SignalSet};

/// What a policy reads, and how it wants the model initialised and trained.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Needs {
    /// Per-row statistics.
    pub signals: SignalSet,
    /// Camera depth z₀ `[scene units]`, >= 0, below which a view counts less in the signals of screen
    /// and colour gradients: it is weighted by min(1, z/z₀)², z the depth of the row's mean. 0: all
    /// views count equally.
    ///
    /// Gaussians near a camera have large screen gradients but appear in few other views; growing them
    /// mostly produces floaters that explain one photograph (*Pixel-GS*, Zhang et al. 2024,
    /// section 3.3).
    pub full_depth: f32,
    /// How the errors of pixels add up to [`Signal::ErrorScore`].
    pub error_score: ErrorScore,
    /// Pixels to collect as candidates for new rows, if any.
    pub candidates: Option<CandidateRequest>,
    /// What is measured in [auxiliary views](crate::policy::DensityPolicy::observe), if any.
    pub aux: Option<AuxRequest>,
    /// Terms added to the training loss, unless the policy has
    /// [others](crate::policy::DensityPolicy::loss_terms) for a step.
    pub loss_terms: LossTerms,
    /// Noise on the means after each optimiser step, unless the policy has
    /// [another](crate::policy::DensityPolicy::noise) for a step.
    pub noise: Option<NoiseTerm>,
    /// A number per row that learns whether the row is worth its place, if any.
    pub mask: Option<MaskTerm>,
    /// Longest [cadence](crate::policy::DensityPolicy::cadence) of the run. Above 1, gradients are
    /// summed between optimiser steps, and the sums need memory.
    pub cadence: Cadence,
    /// Smallest [share of their sides](crate::policy::DensityPolicy::resolution) that training images are
    /// ever shrunk to, in (0, 1]; `None`: they are always whole, and no memory is set aside for smaller
    /// ones.
    pub least_resolution: Option<f64>,
    /// Learning rates that replace the trainer's defaults, but not what the user sets.
    pub rates: RateOverrides,
    /// Changes to the initial rows.
    pub start: StartRule,
    /// Whether plans hold edits that take more memory: rows rewritten in place
    /// ([`EditPlan::update`](crate::plan::EditPlan::update)), children that are turned, or whose scales
    /// change by axis ([`ScaleRule::Axes`](crate::plan::ScaleRule::Axes)).
    pub detailed_edits: bool,
}

impl Needs {
    /// Checks that images may be shrunk to this share of their sides at a step.
    ///
    /// # Errors
    /// When it is not a number, above 1 or below what was declared, with both.
    pub fn check_resolution(&self, share: f64) -> Result<(), String> {
        let least = self.least_resolution.unwrap_or(1.0);
        if (least..=1.0).contains(&share) {
            return Ok(());
        }
        Err(format!("the resolution is {share}; it must be from {least}, as declared, to 1"))
    }

    /// Checks that every number is finite and in its range.
    ///
    /// # Errors
    /// The first that is not, with its value.
    pub fn check(&self) -> Result<(), String> {
        finite("full_depth", self.full_depth.into(), 0.0)?;
        self.error_score.check()?;
        self.loss_terms.check()?;
        self.noise.map_or(Ok(()), |noise| noise.check())?;
        match &self.mask {
            Some(mask) => {
                mask.check()?;
                if self.cadence.all > 1 {
                    return Err("masks step with every view: cadence.all must be 1".to_owned());
                }
            }
            None if self.signals.contains(Signal::Mask) => {
                return Err("the signal Mask is declared, but no mask".to_owned());
            }
            None => {}
        }
        if let Some(aux) = &self.aux {
            finite("aux.map.error", aux.map.error.into(), 0.0)?;
            finite("aux.map.edge", aux.map.edge.into(), 0.0)?;
        }
        if let Some(least) = self.least_resolution.filter(|least| !(*least > 0.0 && *least <= 1.0))
        {
            return Err(format!("least_resolution is {least}; it must be above 0 and at most 1"));
        }
        finite("cadence.all", self.cadence.all.into(), 1.0)?;
        finite("cadence.sh_rest", self.cadence.sh_rest.into(), 1.0)?;
        self.rates.check()?;
        above_zero("start.scale", self.start.scale.into())?;
        match self.start.opacity {
            Some(opacity) if !(opacity > 0.0 && opacity < 1.0) => {
                Err(format!("start.opacity is {opacity}; it must be between 0 and 1"))
            }
            _ => Ok(()),
        }
    }
}

fn finite(name: &str, value: f64, least: f64) -> Result<(), String> {
    if value.is_finite() && value >= least {
        return Ok(());
    }
    Err(format!("{name} is {value}; it must be finite and at least {least}"))
}

fn above_zero(name: &str, value: f64) -> Result<(), String> {
    if value.is_finite() && value > 0.0 {
        return Ok(());
    }
    Err(format!("{name} is {value}; it must be positive"))
}

/// How the errors of pixels add up to [`Signal::ErrorScore`]. A view adds
///
/// (Σ w·M(p) / (Σ w)^`footprint`)^`view_power`, with M(p) = e(p)^`power` · (1 + `edge` · g(p) / ḡ),
///
/// both sums over the pixels p that the row is blended into, w its blend weight α·T there and e the pixel's
/// part of the training loss, as in [`Signal::WeightedError`]. g is the 8-neighbour Laplacian of the
/// photograph's 8-bit luma, clipped to 0..255, and ḡ its mean over the view (in a view without edges all
/// weigh the same).
///
/// The default is Σ w·e. A power above 1 looks at the worst pixels, a footprint of 1 at the mean error
/// whatever the row's size, and a view power below 1 at rows that many views complain of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ErrorScore {
    /// Power of a pixel's error, in (0, 16].
    pub power: f32,
    /// Weight of edges, >= 0; 0: none, at no cost.
    pub edge: f32,
    /// Power of the sum of blend weights that divides, in `[0, 1]`.
    pub footprint: f32,
    /// Power of a view's score, in (0, 1].
    pub view_power: f32,
}

impl Default for ErrorScore {
    fn default() -> Self {
        Self { power: 1.0, edge: 0.0, footprint: 0.0, view_power: 1.0 }
    }
}

impl ErrorScore {
    /// Whether M is the error itself, but for edges.
    #[must_use]
    pub fn is_plain_map(&self) -> bool {
        self.power.total_cmp(&1.0).is_eq()
    }

    /// The score of one view, from Σ w·M and Σ w; 0 where the row has no error.
    #[must_use]
    pub fn of_view(&self, error: f32, weight: f32) -> f32 {
        if !(error > 0.0 && weight > 0.0) {
            return 0.0;
        }
        let by_size =
            if self.footprint > 0.0 { error / weight.powf(self.footprint) } else { error };
        if self.view_power < 1.0 { by_size.powf(self.view_power) } else { by_size }
    }

    fn check(&self) -> Result<(), String> {
        finite("error_score.edge", self.edge.into(), 0.0)?;
        for (name, value, lowest, most) in [
            ("power", self.power, f32::MIN_POSITIVE, 16.0),
            ("footprint", self.footprint, 0.0, 1.0),
            ("view_power", self.view_power, f32::MIN_POSITIVE, 1.0),
        ] {
            if !(lowest..=most).contains(&value) {
                let above = if lowest > 0.0 { "above 0" } else { "at least 0" };
                return Err(format!(
                    "error_score.{name} is {value}; it must be {above}, at most {most}"
                ));
            }
        }
        Ok(())
    }
}

/// Which pixels of the training views to collect as candidates for new rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CandidateRequest {
    /// Start of the window (exclusive) `[step]`.
    pub from: u32,
    /// End of the window (exclusive) `[step]`.
    pub until: u32,
    /// Each step collects one candidate per this many rows, >= 1.
    pub rows_per_candidate: u32,
    /// Most candidates held at a time; later ones are dropped.
    pub capacity: usize,
    /// The error that ranks pixels.
    pub error: ErrorMode,
    /// How the surface point on the pixel's ray is chosen.
    pub depth: DepthMode,
    /// Least accumulated alpha of a pixel, in `[0, 1]`: a transparent pixel has no depth.
    pub min_alpha: f32,
    /// Non-maximum suppression: only pixels with the largest error of their 3×3 neighbours count.
    pub spaced: bool,
}

/// The error of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ErrorMode {
    /// ‖dL/dC‖₂ of the rendered colour, as in the Diet code. It responds to blurred structure and
    /// not to a constant colour offset.
    #[serde(rename = "grad")]
    Gradient,
    /// Mean over channels of |I − G|.
    L1,
    /// 0.8 · L1 + 0.2 · (1 − SSIM), per pixel.
    L1Dssim,
}

/// How the surface point of a pixel is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DepthMode {
    /// The ray's closest point, in Mahalanobis distance, to the Gaussian with the largest blend
    /// weight (Mini-Splatting).
    MaxWeight,
    /// The same for the Gaussian at which transmittance first falls below one half.
    Median,
}

/// Coefficients of terms added to the image loss; 0 switches a term off, at no cost.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct LossTerms {
    /// Coefficient of the mean opacity over rows, >= 0.
    pub opacity: f32,
    /// Coefficient of the mean standard deviation over rows and axes `[1 / scene units]`, >= 0.
    pub scale: f32,
}

impl LossTerms {
    /// Whether no term is added.
    #[must_use]
    pub fn is_none(&self) -> bool {
        !(self.opacity > 0.0 || self.scale > 0.0)
    }

    /// Checks that both are finite and at least 0.
    ///
    /// # Errors
    /// The first that is not, with its value.
    pub fn check(&self) -> Result<(), String> {
        finite("loss_terms.opacity", self.opacity.into(), 0.0)?;
        finite("loss_terms.scale", self.scale.into(), 0.0)
    }
}

/// Noise on the means after each optimiser step (*3D Gaussian Splatting as Markov Chain Monte Carlo*,
/// Kheradmand et al. 2024, section 3.2): Δμ = Σ·ξ · σ(−`sharpness`·(o − `opacity`)) · `strength` · λ,
/// with Σ the row's covariance, ξ ~ N(0, I), o its opacity, σ the logistic function and λ the step
/// size of the means at that step `[scene units]`, without the factor by which short runs lengthen steps:
/// that is for what has a gradient to follow.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NoiseTerm {
    /// Strength of the noise `[1 / scene units²]`, >= 0.
    pub strength: f32,
    /// How steeply noise falls with opacity, >= 0.
    pub sharpness: f32,
    /// Opacity at which the noise is halved.
    pub opacity: f32,
}

impl NoiseTerm {
    /// The factor of the noise at this opacity, in (0, 1).
    #[must_use]
    pub fn share(&self, opacity: f32) -> f32 {
        1.0 / (1.0 + (self.sharpness * (opacity - self.opacity)).exp())
    }

    /// Checks that all numbers are finite and at least 0.
    ///
    /// # Errors
    /// The first that is not, with its value.
    pub fn check(&self) -> Result<(), String> {
        finite("noise.strength", self.strength.into(), 0.0)?;
        finite("noise.sharpness", self.sharpness.into(), 0.0)?;
        finite("noise.opacity", self.opacity.into(), 0.0)
    }
}

/// A trained mask per row (*Compact 3D Gaussian Representation*, Lee et al. 2024, section 3.1). A row
/// renders with its opacity and its scales times 1\[σ(m) > `threshold`\], whose derivative by m is taken to
/// be that of σ(m), and `weight` · mean σ(m) is added to the loss. A row whose mask falls to the threshold
/// becomes transparent for good, also in what is saved; that the policy prunes it is for the policy to do.
///
/// m steps by Adam with every view. A newborn row has its parent's mask.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MaskTerm {
    /// m at first.
    pub start: f32,
    /// Step size of m, > 0.
    pub rate: f32,
    /// Coefficient of the mean of σ(m) over rows, >= 0.
    pub weight: f32,
    /// In (0, 1).
    pub threshold: f32,
}

impl MaskTerm {
    fn check(&self) -> Result<(), String> {
        above_zero("mask.rate", self.rate.into())?;
        finite("mask.weight", self.weight.into(), 0.0)?;
        if !(self.threshold > 0.0 && self.threshold < 1.0) {
            let threshold = self.threshold;
            return Err(format!("mask.threshold is {threshold}; it must be between 0 and 1"));
        }
        // Beyond it σ(m) is 0 or 1 and has no derivative.
        if !(-20.0..=20.0).contains(&self.start) {
            return Err(format!("mask.start is {}; it must be from -20 to 20", self.start));
        }
        Ok(())
    }
}

/// How often the optimiser steps; in between, gradients are summed over the views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cadence {
    /// Iterations per optimiser step, for all parameters; >= 1.
    pub all: u32,
    /// The same for the spherical-harmonic coefficients of bands 1–3, which step at most as often as
    /// the others; >= 1.
    pub sh_rest: u32,
}

impl Default for Cadence {
    fn default() -> Self {
        Self { all: 1, sh_rest: 1 }
    }
}

impl Cadence {
    /// Whether the optimiser steps after iteration `step`: first for all parameters but the
    /// spherical-harmonic coefficients of bands 1–3, then for these.
    #[must_use]
    pub fn steps_at(self, step: u32) -> [bool; 2] {
        let all = self.all.max(1);
        [step.is_multiple_of(all), step.is_multiple_of(self.sh_rest.max(all))]
    }

    /// Whether a backend made for `longest` has the gradient sums and step counts that this cadence
    /// needs.
    #[must_use]
    pub fn is_within(self, longest: Self) -> bool {
        let is_sound = self.all > 0 && self.sh_rest > 0;
        let all = self.all == 1 || longest.all > 1;
        let apart = self.sh_rest <= self.all || longest.sh_rest > 1;
        is_sound && all && apart
    }
}

/// Learning rates that a policy is published with; `None` leaves the trainer's.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct RateOverrides {
    /// Means `[fraction of the extent per step]`.
    pub mean: Option<Rate>,
    /// Log-scales.
    pub log_scale: Option<Rate>,
    /// Quaternions.
    pub quat: Option<Rate>,
    /// Opacity logits.
    pub opacity: Option<Rate>,
    /// Spherical-harmonic coefficients of band 0.
    pub sh_dc: Option<Rate>,
    /// Spherical-harmonic coefficients of bands 1–3.
    pub sh_rest: Option<Rate>,
    /// A late fade of the rates of opacities and of all spherical-harmonic coefficients.
    pub fade: Option<Fade>,
}

/// A learning rate, which falls (or rises) log-linearly over the run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// At the start of the run, > 0.
    pub start: f64,
    /// At its end, > 0.
    pub end: f64,
}

/// A factor on learning rates that falls log-linearly from 1 to `to` in the last part of a run, so that
/// the model does not memorise single photographs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Fade {
    /// The share of the run after which it begins, in `[0, 1)`.
    pub from: f64,
    /// The factor at the end of the run, in (0, 1].
    pub to: f64,
}

impl Rate {
    /// The same from start to end.
    #[must_use]
    pub const fn constant(rate: f64) -> Self {
        Self { start: rate, end: rate }
    }
}

impl RateOverrides {
    fn check(&self) -> Result<(), String> {
        for (name, rate) in [
            ("mean", self.mean),
            ("log_scale", self.log_scale),
            ("quat", self.quat),
            ("opacity", self.opacity),
            ("sh_dc", self.sh_dc),
            ("sh_rest", self.sh_rest),
        ] {
            let Some(rate) = rate else { continue };
            above_zero(&format!("rates.{name}.start"), rate.start)?;
            above_zero(&format!("rates.{name}.end"), rate.end)?;
        }
        match self.fade {
            Some(Fade { from, .. }) if !(0.0..1.0).contains(&from) => {
                Err(format!("rates.fade.from is {from}; it must be at least 0 and below 1"))
            }
            Some(Fade { to, .. }) if !(to > 0.0 && to <= 1.0) => {
                Err(format!("rates.fade.to is {to}; it must be above 0 and at most 1"))
            }
            _ => Ok(()),
        }
    }
}

/// Changes to the initial rows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StartRule {
    /// Opacity of all rows, in (0, 1); `None` leaves the trainer's.
    pub opacity: Option<f32>,
    /// Factor on all standard deviations, > 0.
    pub scale: f32,
}

impl Default for StartRule {
    fn default() -> Self {
        Self { opacity: None, scale: 1.0 }
    }
}

/// What is measured in an auxiliary view: a training view rendered for one event of the policy.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AuxRequest {
    /// The pixel map M that [`AuxColumn::MapSum`] sums.
    pub map: PixelMap,
    /// Per-row statistics.
    pub columns: Vec<AuxColumn>,
    /// Most surface points per view: pixels drawn without replacement in proportion to their
    /// accumulated alpha, with the point that [`DepthMode::MaxWeight`] chooses.
    pub points: u32,
}

/// The pixel map M(p) = `error`·n(e) + `edge`·n(g).
///
/// n scales a map to 0..1 by its minimum and maximum in the view (0 where they are equal), e(p) is the
/// mean over channels of |I − G|, and g(p) the 8-neighbour Laplacian of the 8-bit luma of the ground
/// truth, clipped to 0..255, with repeated borders. The image's mask multiplies e and g.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PixelMap {
    /// Weight of the error, >= 0.
    pub error: f32,
    /// Weight of the edges, >= 0.
    pub edge: f32,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_out_of_range_are_refused() {
        assert_eq!(Needs::default().check(), Ok(()));
        let noise = NoiseTerm { strength: 1.0, sharpness: 100.0, opacity: 0.005 };
        let mask = MaskTerm { start: 1.0, rate: 0.01, weight: 5e-4, threshold: 0.01 };
        assert_eq!(Needs { mask: Some(mask), ..Needs::default() }.check(), Ok(()));
        let score = |error_score| Needs { error_score, ..Needs::default() };
        let fade =
            |from, to| RateOverrides { fade: Some(Fade { from, to }), ..RateOverrides::default() };
        let wrong = [
            Needs { loss_terms: LossTerms { opacity: -1.0, scale: 0.0 }, ..Needs::default() },
            Needs { loss_terms: LossTerms { opacity: 0.0, scale: f32::NAN }, ..Needs::default() },
            Needs {
                noise: Some(NoiseTerm { strength: f32::INFINITY, ..noise }),
                ..Needs::default()
            },
            Needs { signals: SignalSet::from([Signal::Mask]), ..Needs::default() },
            Needs { mask: Some(MaskTerm { start: f32::NAN, ..mask }), ..Needs::default() },
            Needs { mask: Some(MaskTerm { rate: 0.0, ..mask }), ..Needs::default() },
            Needs { mask: Some(MaskTerm { weight: -1.0, ..mask }), ..Needs::default() },
            Needs { mask: Some(MaskTerm { threshold: 1.0, ..mask }), ..Needs::default() },
            Needs { mask: Some(mask), cadence: Cadence { all: 2, sh_rest: 1 }, ..Needs::default() },
            Needs { cadence: Cadence { all: 0, sh_rest: 1 }, ..Needs::default() },
            Needs { cadence: Cadence { all: 1, sh_rest: 0 }, ..Needs::default() },
            Needs {
                rates: RateOverrides {
                    quat: Some(Rate { start: 1.0, end: 0.0 }),
                    ..RateOverrides::default()
                },
                ..Needs::default()
            },
            Needs { rates: fade(1.0, 0.5), ..Needs::default() },
            score(ErrorScore { power: 0.0, ..ErrorScore::default() }),
            score(ErrorScore { edge: f32::NAN, ..ErrorScore::default() }),
            score(ErrorScore { footprint: 1.5, ..ErrorScore::default() }),
            score(ErrorScore { view_power: 0.0, ..ErrorScore::default() }),
            Needs { least_resolution: Some(0.0), ..Needs::default() },
            Needs { least_resolution: Some(1.5), ..Needs::default() },
            Needs { least_resolution: Some(f64::NAN), ..Needs::default() },
            Needs { rates: fade(0.5, 0.0), ..Needs::default() },
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
    fn a_view_scores_by_error_size_and_power() {
        let score = ErrorScore { footprint: 0.5, view_power: 0.5, ..ErrorScore::default() };
        // 8 / √4 = 4, and its root.
        assert!((score.of_view(8.0, 4.0) - 2.0).abs() < 1e-6);
        assert!((ErrorScore::default().of_view(8.0, 4.0) - 8.0).abs() < 1e-6);
        let none = [(0.0, 4.0), (8.0, 0.0), (f32::NAN, 4.0)];
        assert!(none.iter().all(|&(error, weight)| score.of_view(error, weight).to_bits() == 0));
    }

    #[test]
    fn images_are_shrunk_as_far_as_declared() {
        let needs = Needs { least_resolution: Some(0.3), ..Needs::default() };
        assert!([0.3, 0.5, 1.0].iter().all(|&share| needs.check_resolution(share).is_ok()));
        let wrong = [0.29, 1.01, f64::NAN, -0.5];
        assert!(wrong.iter().all(|&share| needs.check_resolution(share).is_err()));
        let whole = Needs::default();
        assert!(whole.check_resolution(1.0).is_ok() && whole.check_resolution(0.99).is_err());
    }

    #[test]
    fn the_optimiser_steps_at_multiples_of_the_cadence() {
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
