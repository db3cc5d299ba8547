//! Why a run stops.

use densify_policies::policy::PolicyError;

use crate::backend::BackendError;
use crate::views::ViewError;

/// Why training cannot go on. The model stays as it was before the step's edit and can still be
/// [read](super::Trainer::model); only after [`Diverged`](Self::Diverged) it is worth nothing.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// There is nothing to train on.
    #[error("there is no training view; use a larger --test-every or add images")]
    NoViews,
    /// An option is out of its range.
    #[error("{0}")]
    BadOption(String),
    /// A view's pixels could not be read.
    #[error("step {step}: view `{view}`: {source}")]
    View {
        /// Iteration.
        step: u32,
        /// The view's name.
        view: String,
        /// What the source of the views says.
        source: ViewError,
    },
    /// The loss is not a finite number.
    #[error(
        "step {step}: the loss of view `{view}` is {loss}, so the model is lost; \
         lower the learning rates, and check the scene's scale and cameras"
    )]
    Diverged {
        /// Iteration.
        step: u32,
        /// The view's name.
        view: String,
        /// The loss.
        loss: f32,
    },
    /// Rows hold numbers that are not finite: more of them than a sound run has, or any where none is
    /// wanted.
    #[error(
        "step {step}: {count} of {rows} rows hold numbers that are not finite, first {first}; \
         lower the learning rates, and check the scene's scale and cameras"
    )]
    Unsound {
        /// Iteration.
        step: u32,
        /// How many rows.
        count: usize,
        /// Of how many.
        rows: usize,
        /// The first of them, and its number.
        first: String,
    },
    /// The policy reported an error.
    #[error("step {step}: policy `{policy}`: {source}")]
    Policy {
        /// Iteration.
        step: u32,
        /// The policy's name.
        policy: String,
        /// What it reported.
        source: PolicyError,
    },
    /// The policy's plan breaks an invariant of plans.
    #[error(
        "step {step}: the plan of policy `{policy}` does not hold: {reason}; this is a bug, please report it"
    )]
    BrokenPlan {
        /// Iteration.
        step: u32,
        /// The policy's name.
        policy: String,
        /// What is wrong.
        reason: String,
    },
    /// The backend cannot go on.
    #[error("step {step}: {source}")]
    Backend {
        /// Iteration.
        step: u32,
        /// What the backend says.
        source: BackendError,
    },
}
