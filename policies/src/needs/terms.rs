//! Additions to a training step: terms of the loss, noise on the means, masks.

use serde::{Deserialize, Serialize};

use super::{above_zero, at_least};

/// The pixel term ρ of the image loss 0.8·ρ + 0.2·(1 − SSIM), a mean over pixels and channels of their differences e. It
/// decides the gradient; losses are reported with L1, as other trainers report them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PixelLoss {
    /// |e| (Kerbl et al. 2023, section 5.1).
    #[default]
    L1,
    /// Huber's function (1964): e²/(2δ) up to δ = 0.1, |e| − δ/2 beyond. The gradient of |e| is as large for a pixel that
    /// is almost right as for a wrong one, and keeps moving Gaussians that fit well. Gradients of positions on screen are
    /// smaller with it, so policies with published thresholds for these use L1.
    Huber,
}

impl PixelLoss {
    /// Number of training views from which [`Huber`](Self::Huber) is the better choice.
    const ENOUGH_VIEWS: u32 = 40;

    /// The better term for a scene with this many training views, by measurement (docs/studies/short-runs.tsv): with
    /// few, Huber's function fits them more closely, and other views less.
    pub fn for_views(train_views: u32) -> Self {
        if train_views < Self::ENOUGH_VIEWS { Self::L1 } else { Self::Huber }
    }

    /// The difference δ from which the gradient no longer grows; 0 for L1.
    pub fn bound(self) -> f32 {
        match self {
            Self::L1 => 0.0,
            Self::Huber => 0.1,
        }
    }
}

/// A policy's parameter `pixel_loss`: the pixel term of the image loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PixelLossChoice {
    /// [`PixelLoss::for_views`].
    #[default]
    Auto,
    /// [`PixelLoss::L1`].
    L1,
    /// [`PixelLoss::Huber`].
    Huber,
}

impl PixelLossChoice {
    /// What runs used that were saved before the parameter existed.
    pub const BEFORE: (&'static str, &'static str) = ("pixel_loss", "l1");

    /// The pixel term in a scene with this many training views.
    pub fn term(self, train_views: u32) -> PixelLoss {
        match self {
            Self::Auto => PixelLoss::for_views(train_views),
            Self::L1 => PixelLoss::L1,
            Self::Huber => PixelLoss::Huber,
        }
    }

    /// The choice that gives the same term whatever the number of training views.
    #[must_use]
    pub fn decided(self, train_views: u32) -> Self {
        match self.term(train_views) {
            PixelLoss::L1 => Self::L1,
            PixelLoss::Huber => Self::Huber,
        }
    }
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
    /// True if no term is added.
    pub fn is_none(&self) -> bool {
        !(self.opacity > 0.0 || self.scale > 0.0)
    }

    /// Checks that both coefficients are finite and at least 0.
    ///
    /// # Errors
    /// The first coefficient that is not, with its value.
    pub fn check(&self) -> Result<(), String> {
        at_least("loss_terms.opacity", self.opacity.into(), 0.0)?;
        at_least("loss_terms.scale", self.scale.into(), 0.0)
    }
}

/// Noise on the means after each optimiser step (*3D Gaussian Splatting as Markov Chain Monte Carlo*,
/// Kheradmand et al. 2024, section 3.2): Δμ = Σ·ξ · σ(−`sharpness`·(o − `opacity`)) · `strength` · λ,
/// with Σ the row's covariance, ξ ~ N(0, I), o its opacity, σ the logistic function and λ the learning rate of the
/// means at that step `[scene units]`. λ excludes the factor by which the trainer increases rates in short runs, which
/// serves only to move parameters further along their gradients.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NoiseTerm {
    /// Strength of the noise `[1 / scene units²]`, >= 0.
    pub strength: f32,
    /// Steepness of the fall of the noise with opacity, >= 0.
    pub sharpness: f32,
    /// Opacity at which the noise is halved.
    pub opacity: f32,
}

impl NoiseTerm {
    /// The factor on the noise at this opacity, in (0, 1).
    pub fn share(&self, opacity: f32) -> f32 {
        1.0 / (1.0 + (self.sharpness * (opacity - self.opacity)).exp())
    }

    /// Checks that all numbers are finite and at least 0.
    ///
    /// # Errors
    /// The first number that is not, with its value.
    pub fn check(&self) -> Result<(), String> {
        at_least("noise.strength", self.strength.into(), 0.0)?;
        at_least("noise.sharpness", self.sharpness.into(), 0.0)?;
        at_least("noise.opacity", self.opacity.into(), 0.0)
    }
}

/// A learned mask m per row (*Compact 3D Gaussian Representation*, Lee et al. 2024, section 3.1). A row is
/// rendered with its opacity and scales multiplied by 1\[σ(m) > `threshold`\], whose derivative in m is taken
/// to be that of σ(m), and `weight` · mean σ(m) is added to the loss. A row whose mask falls to the threshold
/// stays transparent, also in saved models, until the policy prunes it.
///
/// m is updated by Adam at every view. A new row inherits its parent's mask.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MaskTerm {
    /// Initial m.
    pub start: f32,
    /// Learning rate of m, > 0.
    pub rate: f32,
    /// Coefficient of the mean of σ(m) over rows, >= 0.
    pub weight: f32,
    /// Largest σ(m) at which a row is transparent, in (0, 1).
    pub threshold: f32,
}

impl MaskTerm {
    pub(super) fn check(&self) -> Result<(), String> {
        above_zero("mask.rate", self.rate.into())?;
        at_least("mask.weight", self.weight.into(), 0.0)?;
        if !(self.threshold > 0.0 && self.threshold < 1.0) {
            let threshold = self.threshold;
            return Err(format!("mask.threshold is {threshold}; it must be above 0 and below 1"));
        }
        // Beyond this range σ(m) rounds to 0 or 1 and has no derivative.
        if !(-20.0..=20.0).contains(&self.start) {
            return Err(format!("mask.start is {}; it must be from -20 to 20", self.start));
        }
        Ok(())
    }
}
