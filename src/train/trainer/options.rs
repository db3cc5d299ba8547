//! Options of the trainer.

use serde::{Deserialize, Serialize};

use super::depth::DepthTraining;
use crate::schedule::{Background, RateOptions};

/// Options of training, in addition to the scene and the policy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainOptions {
    /// Number of steps, at least 1; schedules scale with it.
    pub iterations: u32,
    /// Seed of all random draws.
    pub seed: u64,
    /// Largest spherical-harmonic degree trained, at most the model's.
    pub sh_degree: u8,
    /// Number of rows at the front of the model that never change and are hidden from policies.
    pub frozen: usize,
    /// True if `sh_degree` is used from the first step on, as for models that are trained already; otherwise the degree
    /// rises from 0.
    pub has_all_bands: bool,
    /// Background colour.
    pub background: Background,
    /// Step sizes (learning rates).
    pub rates: RateOptions,
    /// Number of views to prefetch from the [`ViewSource`](densify_data::views::ViewSource).
    pub prefetch: usize,
    /// Treatment of rows with non-finite values.
    pub on_nan: OnNan,
    /// The use of depth that views have; requires a backend [set up](densify_render::Setup::depth) for depth.
    pub depth: Option<DepthTraining>,
    /// Weight of the [distortion term](densify_render::StepInput::distortion) after a third of the run, >= 0; requires
    /// a backend set up for depth unless it is 0.
    pub distortion: f32,
    /// Remove floaters at tenths of the run; requires a backend [for it](super::floater_request).
    pub removes_floaters: bool,
}

/// Automatic choices from measurements of the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct AutoChoices {
    /// Choose the number of rows, up to the budget.
    pub rows: bool,
    /// Leave near-duplicate views out of the policy's scores.
    pub scored_views: bool,
}

/// Treatment of rows with NaN or infinite parameters or moments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum OnNan {
    /// Stop the run, with a checkpoint
    Stop,
    /// Remove them; stop only if they are more than 0.1 % at once
    #[default]
    Prune,
}
