//! The policy interface: what a policy declares, what it sees, and what it may do.
//!
//! A density-control policy decides where Gaussians are born and die. It declares the statistics
//! it needs ([`Needs`]); the backend accumulates only these. At the steps for which it
//! [`is_due`](DensityPolicy::is_due) it reads a [`Snapshot`] and writes its wishes into an
//! [`EditPlan`]. It touches no parameter and no device, so that every policy runs unchanged on
//! every backend and can be tested without a renderer.

use std::ops::Range;

use serde::{Deserialize, Serialize};

pub use crate::error::PolicyError;
pub use crate::needs::{
    AuxColumn, AuxRequest, AuxView, Cadence, LossTerms, Needs, NoiseTerm, PixelMap, RateOverrides,
    StartRule,
};
use crate::plan::EditPlan;
use crate::rng::PolicyRng;

/// A density-control policy.
pub trait DensityPolicy: Send {
    /// What this policy reads, and how it wants the model to be started and trained. Only this is
    /// computed and allocated; reading anything else is a [`PolicyError::Undeclared`].
    fn needs(&self, scene: &SceneInfo) -> Needs;

    /// Whether this policy edits after the optimiser step of iteration `step` (1-based).
    fn is_due(&self, step: u32) -> bool;

    /// Whether the plan of iteration `step`, at which the policy is due, may read the signals of
    /// [fresh views](Needs::fresh_views), for a model of `rows` rows and this budget. Where not, no
    /// view is rendered, and reading them is a [`PolicyError::Undeclared`]. Means nothing to a
    /// policy without such needs.
    fn wants_fresh(&self, step: u32, rows: usize, budget: usize) -> bool {
        let _ = (step, rows, budget);
        true
    }

    /// How often the optimiser steps at iteration `step`; no longer than
    /// [declared](Needs::cadence). Gradients not yet used when it changes are used at the next step.
    fn cadence(&self, step: u32) -> Cadence {
        let _ = step;
        Cadence::default()
    }

    /// How many training views, drawn at random without replacement, are to be rendered and
    /// [observed](Self::observe) before the plan of `step`, at which the policy is due; all of them
    /// if there are fewer. 0 for a policy that declares no [`Needs::aux`].
    fn aux_views(&self, step: u32, rows: usize, budget: usize) -> u32 {
        let _ = (step, rows, budget);
        0
    }

    /// Takes note of one auxiliary view, before the plan of the same step. The views come one after
    /// another, and each is gone when the next one comes.
    ///
    /// # Errors
    /// As for [`plan`](Self::plan).
    fn observe(&mut self, view: &AuxView<'_>) -> Result<(), PolicyError> {
        let _ = view;
        Ok(())
    }

    /// Writes this event's edits into `plan`. Pure in its arguments and the policy's own state:
    /// no device, no I/O, no other source of randomness than `rng`.
    ///
    /// # Errors
    /// [`PolicyError`] stops the run with the policy's name and the step; the plan is dropped.
    fn plan(
        &mut self,
        now: &Snapshot<'_>,
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError>;

    /// Everything the future decisions of this policy depend on, beside its parameters.
    fn save(&self) -> PolicyState;

    /// Takes back what [`save`](Self::save) returned.
    ///
    /// # Errors
    /// [`PolicyError::State`] when `state` is not this policy's.
    fn restore(&mut self, state: PolicyState) -> Result<(), PolicyError>;
}

/// A policy's private state as JSON; `null` for a policy that has none.
pub type PolicyState = serde_json::Value;

/// What is known of the scene and the run before the first step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneInfo {
    /// Size of the scene E = 1.1 · max distance of a training camera to their mean
    /// `[scene units]`, > 0. Size thresholds are fractions of it.
    pub extent: f32,
    /// Number of training views, >= 1; also the length of an epoch in steps.
    pub train_views: u32,
    /// Most rows the model may ever have.
    pub budget: usize,
    /// Rows after initialisation, <= `budget`.
    pub initial_rows: usize,
    /// Length of the run in steps.
    pub iterations: u32,
    /// Whether images are composited on white (the original then resets opacity at step 500).
    pub white_background: bool,
}

/// A per-row statistic that a policy may ask for. One `f32` per row each.
///
/// Sums run over the views in which the row was visible since the last
/// [`Reset::Signals`](crate::plan::Reset::Signals), or since the row was born.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Signal {
    /// Number of views that blended the row or could have: its projection is on screen. >= 0.
    VisibleCount,
    /// Sum over views of ‖dL/d(mean in NDC)‖₂, >= 0. NDC gradient = pixel gradient · (W/2, H/2). This
    /// sum, and the next two, weigh near views less where [`Needs::full_depth`] says so.
    ScreenGradient,
    /// Sum over views of ‖Σ over pixels |dL/d(mean in NDC)|‖₂ (absolute per axis, AbsGS), >= 0.
    ScreenGradientAbs,
    /// Sum over views of ‖dL/dc‖₂, c the row's view-dependent colour as blended, >= 0. The
    /// gradient is taken before the mask of the colour's clamp at 0: a row clamped to black has one.
    ColourGradient,
    /// x of the sum over views of dL/d(mean) `[1 / scene units]`.
    MeanGradientX,
    /// y of the sum over views of dL/d(mean) `[1 / scene units]`.
    MeanGradientY,
    /// z of the sum over views of dL/d(mean) `[1 / scene units]`.
    MeanGradientZ,
    /// Sum over views of ‖dL/d(mean)‖₂ `[1 / scene units]`, >= 0.
    MeanGradientNorm,
    /// Largest blend weight α·T over all pixels of the previous and the current epoch, in `[0, 1]`.
    WeightMax,
    /// Largest blend weight α·T over all pixels of freshly rendered training views, in `[0, 1]`. They
    /// are chosen at random for this event, [`Needs::fresh_views`] of them, and rendered as the
    /// model is now. 0 for a row that none of them shows.
    FreshWeightMax,
    /// Sum of the blend weights α·T over all pixels, >= 0.
    WeightSum,
    /// Number of pixels the row was blended into, >= 0.
    PixelCount,
    /// Opacity now, in (0, 1).
    Opacity,
    /// Largest of the three standard deviations now `[scene units]`, > 0.
    ScaleMax,
    /// Product of the three standard deviations now `[scene units³]`, >= 0.
    ScaleProduct,
    /// Optimiser steps since the row was born or rewritten, saturating at 65,535.
    Age,
}

impl Signal {
    /// All signals, in declaration order; `Signal::ALL[s as usize] == s`.
    pub const ALL: [Self; 16] = [
        Self::VisibleCount,
        Self::ScreenGradient,
        Self::ScreenGradientAbs,
        Self::ColourGradient,
        Self::MeanGradientX,
        Self::MeanGradientY,
        Self::MeanGradientZ,
        Self::MeanGradientNorm,
        Self::WeightMax,
        Self::FreshWeightMax,
        Self::WeightSum,
        Self::PixelCount,
        Self::Opacity,
        Self::ScaleMax,
        Self::ScaleProduct,
        Self::Age,
    ];
}

/// A set of [`Signal`]s.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SignalSet(u32);

impl SignalSet {
    /// The set of exactly these signals.
    #[must_use]
    pub fn of(signals: &[Signal]) -> Self {
        Self(signals.iter().fold(0, |bits, &s| bits | 1 << s as u32))
    }

    /// This set and `signal`.
    #[must_use]
    pub fn with(self, signal: Signal) -> Self {
        Self(self.0 | 1 << signal as u32)
    }

    /// This set but for `signal`.
    #[must_use]
    pub fn without(self, signal: Signal) -> Self {
        Self(self.0 & !(1 << signal as u32))
    }

    /// Whether `signal` is in the set.
    #[must_use]
    pub fn contains(self, signal: Signal) -> bool {
        self.0 & (1 << signal as u32) != 0
    }

    /// How many signals are in this set.
    #[must_use]
    pub fn count(self) -> usize {
        self.0.count_ones() as usize
    }

    /// The signals in this set, in declaration order.
    pub fn iter(self) -> impl Iterator<Item = Signal> {
        Signal::ALL.into_iter().filter(move |&s| self.contains(s))
    }
}

/// Which pixels of the training views to collect as places for new rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CandidateRequest {
    /// Collected after `from` < step < `until` (both in steps).
    pub from: u32,
    /// End of the window (exclusive).
    pub until: u32,
    /// One candidate per view and step for each so many rows, >= 1.
    pub rows_per_candidate: u32,
    /// Most candidates held at a time; later ones are dropped when it is reached.
    pub capacity: usize,
    /// What makes a pixel a bad one.
    pub error: ErrorMode,
    /// Where on the pixel's ray the surface is.
    pub depth: DepthMode,
    /// Least accumulated alpha of a pixel, in [0, 1]: where nothing was hit there is no depth.
    pub min_alpha: f32,
    /// Whether only local maxima of 3×3 pixels count, so that neighbours are not all taken.
    pub spaced: bool,
}

/// How wrong a pixel is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ErrorMode {
    /// ‖dL/dC‖₂ of the rendered colour, as the Diet code does (a structure detector).
    #[serde(rename = "grad")]
    Gradient,
    /// Mean over channels of |I − G|.
    L1,
    /// 0.8 · L1 + 0.2 · (1 − SSIM), per pixel.
    L1Dssim,
}

/// Which depth stands for a pixel's surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DepthMode {
    /// The ray's point of closest approach, in its Mahalanobis metric, to the Gaussian with the
    /// largest blend weight (Mini-Splatting).
    MaxWeight,
    /// The same point of the Gaussian at which transmittance first falls below one half.
    Median,
}

/// A pixel that is badly explained, with its surface point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Surface point `[scene units]`.
    pub position: [f32; 3],
    /// Ground-truth colour, sRGB-encoded in `[0, 1]`.
    pub colour: [f32; 3],
    /// Width of one pixel at that depth, z / f `[scene units]`, > 0.
    pub pixel_size: f32,
    /// Error of the pixel in the requested mode, > 0.
    pub error: f32,
}

/// Signals of one moment, as the backend hands them to the host.
#[derive(Debug, Clone, Default)]
pub struct Signals {
    rows: usize,
    present: SignalSet,
    /// The columns, one after another in declaration order. Shape: `[present, rows]`.
    values: Vec<f32>,
}

impl Signals {
    /// Columns for `set`, all zero. Each has `rows` values.
    #[must_use]
    pub fn zeros(rows: usize, set: SignalSet) -> Self {
        Self::within(Vec::new(), rows, set)
    }

    /// The same in memory that is there: of `values` nothing but the capacity is used.
    #[must_use]
    pub fn within(mut values: Vec<f32>, rows: usize, set: SignalSet) -> Self {
        values.clear();
        values.resize(rows * set.count(), 0.0);
        Self { rows, present: set, values }
    }

    /// The memory of all columns.
    #[must_use]
    pub fn into_values(self) -> Vec<f32> {
        self.values
    }

    /// Number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// The column of `signal`, if present. Shape: `[rows]`.
    #[must_use]
    pub fn get(&self, signal: Signal) -> Option<&[f32]> {
        self.place(signal).map(|place| &self.values[place])
    }

    /// The column of `signal` for writing, if present. Shape: `[rows]`.
    pub fn get_mut(&mut self, signal: Signal) -> Option<&mut [f32]> {
        self.place(signal).map(|place| &mut self.values[place])
    }

    fn place(&self, signal: Signal) -> Option<Range<usize>> {
        let before = self.present.iter().position(|s| s == signal)?;
        Some(before * self.rows..(before + 1) * self.rows)
    }
}

/// What a policy sees at an event. Row `i` of every signal is row `i` of the model now.
#[derive(Debug, Clone, Copy)]
pub struct Snapshot<'a> {
    /// Iteration just finished, 1-based.
    pub step: u32,
    /// The scene and the run.
    pub scene: &'a SceneInfo,
    /// Statistics the policy declared.
    pub signals: &'a Signals,
    /// Candidates since the last [`Reset::Candidates`](crate::plan::Reset::Candidates), in the
    /// order in which they were found.
    pub candidates: &'a [Candidate],
}

impl<'a> Snapshot<'a> {
    /// Number of rows now.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.signals.rows()
    }

    /// The values of `signal`. Shape: `[rows]`.
    ///
    /// # Errors
    /// [`PolicyError::Undeclared`] when the policy's needs did not list it, or when it is a fresh
    /// one that the policy [did not want](DensityPolicy::wants_fresh) at this event.
    pub fn signal(&self, signal: Signal) -> Result<&'a [f32], PolicyError> {
        self.signals.get(signal).ok_or(PolicyError::Undeclared { signal })
    }
}

/// [`DensityPolicy::restore`] for a policy without state of its own, whose
/// [`save`](DensityPolicy::save) returns `null`.
///
/// # Errors
/// [`PolicyError::State`] when `state` is not `null`.
pub fn restore_nothing(state: &PolicyState) -> Result<(), PolicyError> {
    if state.is_null() {
        return Ok(());
    }
    Err(PolicyError::State(format!("this policy keeps no state, but the checkpoint holds {state}")))
}

#[cfg(test)]
mod tests;
