//! Errors that end training.

use densify_policies::policy::PolicyError;

use densify_data::views::ViewError;
use densify_render::BackendError;

/// Reason why training cannot continue. The model stays as it was before the step's edit and can still be
/// [read](super::Trainer::model); after [`Diverged`](Self::Diverged), however, it is unusable.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// There is no view to train on.
    #[error("there is no training view")]
    NoView,
    /// An option is out of its range.
    #[error("{0}")]
    BadOption(String),
    /// The image of a view cannot be read.
    #[error("step {step}: view `{view}`: {source}")]
    View {
        /// Iteration.
        step: u32,
        /// The view's name.
        view: String,
        /// The error of the view source.
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
    /// Rows have non-finite values: too many of them, or any with [`OnNan::Stop`](super::OnNan::Stop).
    #[error(
        "step {step}: {count} of {rows} Gaussians have non-finite values, the first in {first}; \
         lower the learning rates, and check the scene's scale and cameras"
    )]
    NonFinite {
        /// Iteration.
        step: u32,
        /// Number of rows with non-finite values.
        count: usize,
        /// Number of rows of the model.
        rows: usize,
        /// Description of the first of them.
        first: String,
    },
    /// The policy reported an error, panicked, or returned a plan that breaks an invariant.
    #[error("step {step}: policy `{policy}`: {source}")]
    Policy {
        /// Iteration.
        step: u32,
        /// The policy's name.
        policy: String,
        /// The policy's error.
        source: PolicyError,
    },
    /// The backend failed.
    #[error("step {step}: {source}")]
    Backend {
        /// Iteration.
        step: u32,
        /// The backend's error.
        source: BackendError,
    },
}

/// Names the step in which a backend failed.
pub(super) trait AtStep<T> {
    fn at(self, step: u32) -> Result<T, TrainError>;
}

impl<T> AtStep<T> for Result<T, BackendError> {
    fn at(self, step: u32) -> Result<T, TrainError> {
        self.map_err(|source| TrainError::Backend { step, source })
    }
}
