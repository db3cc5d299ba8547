//! The parameters of `diet`, explained in its manual page.

use std::ops::Bound::{Excluded, Included, Unbounded};

use serde::{Deserialize, Serialize};

use crate::parameters::in_range;
use crate::policy::{DepthMode, ErrorMode, PixelLossChoice, PolicyResult};

/// Parameters of [`Diet`](super::Diet).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct DietParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub tau: f64,
    pub mixed_gradient: bool,
    pub colour_weight: f64,
    pub full_depth: f64,
    pub growth: Growth,
    pub rho: f64,
    pub small: f64,
    pub split: Split,
    pub split_factor: f64,
    pub split_share: f64,
    pub child_opacity: f64,
    pub shift: Shift,
    pub kappa: f64,
    pub clone_opacity: CloneOpacity,
    pub min_opacity: f64,
    pub max_scale: f64,
    pub max_scale_from: u32,
    pub importance: Importance,
    pub fresh_views: u32,
    pub protect: u32,
    pub prune_every: u32,
    pub compensate_from: u32,
    pub compensate_until: u32,
    pub insert_every: u32,
    pub rho_c: f64,
    pub rows_per_candidate: u32,
    pub error: ErrorMode,
    pub depth: DepthMode,
    pub nms: bool,
    pub min_alpha: f64,
    pub newborn_size: NewbornSize,
    pub size_pixels: f64,
    pub newborn_opacity: f64,
    pub reinit_at: u32,
    pub reinit_share: f64,
    pub pixel_loss: PixelLossChoice,
}

/// The limit on the number of candidates that grow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Growth {
    /// As many as there are free rows in the budget, plus this event's share of `rho` · budget, for which other
    /// rows are evicted.
    Turnover,
    /// As many as there are free rows in the budget, plus one for each row that can be evicted.
    All,
}

/// The split of a large row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Split {
    /// Two children sampled from the parent, smaller by `split_factor`.
    Random,
    /// Two halves along its longest axis.
    LongAxis,
}

/// The offset of a clone from its parent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Shift {
    /// Against the gradient with respect to the mean, by at most `kappa` standard deviations.
    Descent,
    /// As in the paper: the sum of that gradient over the views.
    Paper,
    /// Like the published code: the average of that gradient over the views, divided by their number.
    Code,
    /// No offset.
    None,
}

/// The opacity of a clone and its parent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CloneOpacity {
    /// Parent and clone each keep the parent's opacity; together they are more opaque.
    Unchanged,
    /// Together they are as opaque as the parent was.
    Conserve,
}

/// The views in which the importance of a row is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Importance {
    /// Largest blend weight in the training renders of the previous and the current epoch.
    Epochs,
    /// Largest blend weight in fresh renders of `fresh_views` random training views.
    Fresh,
}

/// The size of an inserted row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NewbornSize {
    /// `size_pixels` pixels at the row's depth.
    Pixel,
    /// As in the published code: the square of the geometric mean, over all rows, of each row's largest scale.
    Code,
}

impl Default for DietParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 10_000,
            grow_every: 100,
            tau: 3e-4,
            mixed_gradient: true,
            colour_weight: 30.0,
            // Best of 0, 0.37, 0.7, 0.8, 1 and 2: a value of 2 costs 0.9 dB of PSNR on room256, and 1 suppresses
            // growth in scenes captured from all around.
            full_depth: 0.8,
            growth: Growth::Turnover,
            rho: 0.25,
            small: 0.01,
            // Compared with `Random`, the PSNR changes by +0.2, +0.5, +0.6, +0.3, +1.3 and -0.1 dB in six pairs of
            // runs on four scenes; the SSIM is better in each.
            split: Split::LongAxis,
            split_factor: 1.6,
            split_share: 0.45,
            child_opacity: 0.6,
            shift: Shift::Descent,
            kappa: 0.1,
            clone_opacity: CloneOpacity::Unchanged,
            min_opacity: 0.005,
            max_scale: 0.0,
            max_scale_from: 3000,
            importance: Importance::Epochs,
            fresh_views: 100,
            protect: 100,
            prune_every: 50,
            compensate_from: 10_000,
            compensate_until: 15_000,
            insert_every: 500,
            rho_c: 0.1,
            rows_per_candidate: 3000,
            error: ErrorMode::L1Dssim,
            depth: DepthMode::MaxWeight,
            nms: true,
            min_alpha: 0.5,
            newborn_size: NewbornSize::Pixel,
            size_pixels: 2.0,
            newborn_opacity: 0.1,
            reinit_at: 0,
            reinit_share: 0.8,
            pixel_loss: PixelLossChoice::Auto,
        }
    }
}

impl DietParams {
    /// Checks ranges.
    pub(super) fn check(&self) -> PolicyResult {
        in_range("tau", self.tau, 0.0..)?;
        in_range("colour_weight", self.colour_weight, 0.0..)?;
        in_range("full_depth", self.full_depth, 0.0..)?;
        in_range("rho", self.rho, 0.0..)?;
        in_range("small", self.small, 0.0..)?;
        in_range("split_factor", self.split_factor, 1.0..=100.0)?;
        in_range("split_share", self.split_share, (Excluded(0.0), Excluded(1.0)))?;
        in_range("child_opacity", self.child_opacity, (Excluded(0.0), Included(1.0)))?;
        in_range("kappa", self.kappa, 0.0..)?;
        in_range("min_opacity", self.min_opacity, 0.0..=1.0)?;
        in_range("max_scale", self.max_scale, 0.0..)?;
        in_range("fresh_views", f64::from(self.fresh_views), 1.0..)?;
        // `Signal::Age` saturates at 65,535.
        in_range("protect", f64::from(self.protect), 0.0..=65_535.0)?;
        in_range("rho_c", self.rho_c, 0.0..)?;
        in_range("rows_per_candidate", f64::from(self.rows_per_candidate), 1.0..)?;
        in_range("min_alpha", self.min_alpha, 0.0..=1.0)?;
        in_range("size_pixels", self.size_pixels, (Excluded(0.0), Unbounded))?;
        in_range("newborn_opacity", self.newborn_opacity, (Excluded(0.0), Excluded(1.0)))?;
        in_range("reinit_share", self.reinit_share, (Excluded(0.0), Included(1.0)))?;
        Ok(())
    }
}
