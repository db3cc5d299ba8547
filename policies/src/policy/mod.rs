//! The policy interface: a policy's declarations, inputs and outputs.
//!
//! A policy decides which Gaussians are cloned, split, pruned or added. It declares the statistics
//! it needs ([`Needs`]), and the backend accumulates only these. At its events, the steps at which it
//! [`is_due`](DensityPolicy::is_due), it reads a [`Snapshot`] and writes its edits into an
//! [`EditPlan`]. It accesses neither the model's parameters nor devices, so every policy runs unchanged on every
//! backend and can be tested without a renderer.

use serde::{Deserialize, Serialize};

pub use crate::error::{PolicyError, PolicyResult};
pub use crate::needs::{
    AuxRequest, Cadence, CandidateRequest, DepthMode, ErrorMap, ErrorMode, ErrorScore, Fade,
    LossTerms, MaskTerm, Needs, NoiseTerm, PixelLoss, PixelLossChoice, PixelMap, Rate,
    RateOverrides, StartRule,
};
use crate::plan::EditPlan;
use crate::rng::PolicyRng;
pub use crate::signals::{
    AuxColumn, PixelSum, SUPPORT_WEIGHT, Signal, SignalKind, SignalSet, Signals,
};

/// A density-control policy.
pub trait DensityPolicy: Send {
    /// The inputs of this policy, and its changes to initialisation and training. Only these inputs are
    /// computed and allocated; reading any other returns [`PolicyError::Undeclared`].
    fn needs(&self, scene: &SceneInfo) -> Needs;

    /// True if this policy edits after the optimiser step of iteration `step` (1-based).
    fn is_due(&self, step: u32) -> bool;

    /// The interval of optimiser steps at iteration `step`, at most the [declared](Needs::cadence) interval. If
    /// it changes, the gradients summed so far are used at the next optimiser step.
    fn cadence(&self, step: u32) -> Cadence {
        let _ = step;
        Cadence::default()
    }

    /// The terms added to the loss of iteration `step`; `declared` are those of [`Needs::loss_terms`].
    fn loss_terms(&self, step: u32, declared: LossTerms) -> LossTerms {
        let _ = step;
        declared
    }

    /// The noise added to the means after iteration `step`; `declared` is that of [`Needs::noise`].
    fn noise(&self, step: u32, declared: Option<NoiseTerm>) -> Option<NoiseTerm> {
        let _ = step;
        declared
    }

    /// Factor on both sides of the training image at iteration `step`, from the
    /// [declared minimum](Needs::least_resolution) to 1. Auxiliary and test views are always full-size.
    fn resolution(&self, step: u32) -> f64 {
        let _ = step;
        1.0
    }

    /// Number of training views, drawn at random without replacement, that are rendered and
    /// [observed](Self::observe) before the plan of `step`, at which the policy is due; all of them
    /// if there are fewer. 0 for a policy that declares no [`Needs::aux`].
    fn aux_views(&self, step: u32, rows: usize, budget: usize) -> u32 {
        let _ = (step, rows, budget);
        0
    }

    /// Reads one auxiliary view, before the plan of the same step. Views come one at a time, and
    /// each is discarded before the next.
    ///
    /// # Errors
    /// As for [`plan`](Self::plan).
    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        let _ = view;
        Ok(())
    }

    /// Writes the edits of this event into `plan`. A pure function of its arguments and the policy's own
    /// state: no device, no I/O, and no randomness other than `rng`.
    ///
    /// # Errors
    /// [`PolicyError`] stops the run with the policy's name and the step; the plan is dropped.
    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult;

    /// The state that future decisions depend on, apart from the policy's own parameters. The default is for
    /// policies without state.
    fn save(&self) -> PolicyState {
        PolicyState::Null
    }

    /// Restores what [`save`](Self::save) returned.
    ///
    /// # Errors
    /// [`PolicyError::State`] when `state` belongs to another policy.
    fn restore(&mut self, state: PolicyState) -> PolicyResult {
        if state.is_null() {
            return Ok(());
        }
        Err(PolicyError::State(format!(
            "this policy keeps no state, but the checkpoint holds {state}"
        )))
    }
}

/// A policy's state as JSON; `null` for a policy without state.
pub type PolicyState = serde_json::Value;

/// The scene and the run, as known before the first step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneInfo {
    /// Size of the scene `[scene units]`, > 0: 1.1 times the largest distance of a training camera from the mean
    /// of all cameras or, if all cameras coincide, the median distance of the points (see [`Signal::Position`]).
    /// Size thresholds are fractions of it.
    pub extent: f32,
    /// Number of training views, >= 1; also the length of an epoch in steps.
    pub train_views: u32,
    /// Maximum number of rows of the model.
    pub budget: usize,
    /// Rows after initialisation, <= `budget`.
    pub initial_rows: usize,
    /// Length of the run in steps.
    pub iterations: u32,
    /// True if images are composited on white (the original 3DGS then resets opacities at step 500).
    pub white_background: bool,
}

/// The inputs of a policy at an event. Row `i` of every signal is the current row `i` of the model.
#[derive(Debug, Clone, Copy)]
pub struct Snapshot<'a> {
    /// Iteration just finished, 1-based.
    pub step: u32,
    /// The scene and the run.
    pub scene: &'a SceneInfo,
    /// The signals that the policy declared.
    pub signals: &'a Signals,
    /// Candidates since the last [`Reset::Candidates`](crate::plan::Reset::Candidates), in the
    /// order in which they were found.
    pub candidates: &'a [Candidate],
}

impl<'a> Snapshot<'a> {
    /// Current number of rows.
    pub fn rows(&self) -> usize {
        self.signals.rows()
    }

    /// The values of `signal`. Shape: `[rows, width]`, where the [width](Signal::width) is usually 1.
    ///
    /// # Errors
    /// [`PolicyError::Undeclared`] when the policy's needs do not list it.
    pub fn signal(&self, signal: Signal) -> PolicyResult<&'a [f32]> {
        self.signals.get(signal).ok_or(PolicyError::Undeclared { signal })
    }

    /// [`Signal::Position`] of each row.
    ///
    /// # Errors
    /// As [`signal`](Self::signal).
    pub fn positions(&self) -> PolicyResult<&'a [[f32; 3]]> {
        Ok(self.signal(Signal::Position)?.as_chunks().0)
    }

    /// [`Signal::LogScale`] of each row.
    ///
    /// # Errors
    /// As [`signal`](Self::signal).
    pub fn log_scales(&self) -> PolicyResult<&'a [[f32; 3]]> {
        Ok(self.signal(Signal::LogScale)?.as_chunks().0)
    }

    /// [`Signal::Orientation`] of each row.
    ///
    /// # Errors
    /// As [`signal`](Self::signal).
    pub fn orientations(&self) -> PolicyResult<&'a [[f32; 4]]> {
        Ok(self.signal(Signal::Orientation)?.as_chunks().0)
    }

    /// [`Signal::Colour`] of each row.
    ///
    /// # Errors
    /// As [`signal`](Self::signal).
    pub fn colours(&self) -> PolicyResult<&'a [[f32; 3]]> {
        Ok(self.signal(Signal::Colour)?.as_chunks().0)
    }
}

/// A pixel with a large error, and the surface point seen there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Surface point `[scene units]`.
    pub position: [f32; 3],
    /// Ground-truth colour, sRGB-encoded in `[0, 1]`.
    pub colour: [f32; 3],
    /// Width of one pixel at the depth of the surface point, depth / focal length `[scene units]`, > 0.
    pub pixel_size: f32,
    /// Error of the pixel in the requested [`ErrorMode`], > 0.
    pub error: f32,
}

/// The loss, the per-row statistics and the surface points of one auxiliary view.
#[derive(Debug, Clone, Copy)]
pub struct AuxView<'a> {
    /// Iteration just finished, 1-based.
    pub step: u32,
    /// Rows of the model.
    pub rows: usize,
    /// 0.8·L1 + 0.2·(1 − SSIM) of this view.
    pub loss: f32,
    /// The requested columns. Shape of each: `[rows]`.
    pub columns: &'a [(AuxColumn, Vec<f32>)],
    /// Surface points, in the order in which their pixels were sampled. Their `error` is the
    /// accumulated alpha of the pixel.
    pub points: &'a [Candidate],
}

impl<'a> AuxView<'a> {
    /// The values of `column`. Shape: `[rows]`.
    ///
    /// # Errors
    /// [`PolicyError::UndeclaredColumn`] when the policy's [`AuxRequest`] does not list it.
    pub fn column(&self, column: AuxColumn) -> PolicyResult<&'a [f32]> {
        let listed = self.columns.iter().find(|(name, _)| *name == column);
        listed.map(|(_, values)| &values[..]).ok_or(PolicyError::UndeclaredColumn { column })
    }
}

#[cfg(test)]
mod tests;
