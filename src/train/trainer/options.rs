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
    /// Rows at the front of the model that never change, and that no policy knows of.
    pub frozen: usize,
    /// Whether that degree is in use from the first step on, as a model that is trained already needs; else
    /// it rises from 0.
    pub has_all_bands: bool,
    /// Colour behind the Gaussians.
    pub background: Background,
    /// Learning rates.
    pub rates: RateOptions,
    /// Number of views to prefetch from the [`ViewSource`](densify_data::views::ViewSource).
    pub prefetch: usize,
    /// What happens to rows with non-finite values.
    pub on_nan: OnNan,
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
