//! Errors as they reach a user: one message with the remedy, and the exit code that it stands for.

use std::fmt::Display;

use densify_policies::policy::PolicyError;
use densify_scenegen::Error as SceneError;

use crate::knobs::KnobError;
use densify_core::files::OutputError;
use densify_data::LoadError;
use densify_data::models::FormatError;
use densify_render::BackendError;
use densify_train::checkpoint::CheckpointError;
use densify_train::evaluate::EvaluateError;
use densify_train::init::InitError;
use densify_train::trainer::TrainError;

/// Exit code of anything that has no code of its own.
pub const OTHER: u8 = 1;
/// Exit code of bad input and usage.
pub const INPUT: u8 = 2;
/// Exit code where a measured value is beyond the limit that was given for it.
pub const LIMIT: u8 = 4;
/// Exit code where device or memory do not suffice.
pub const DEVICE: u8 = 3;

/// Why a run or a command failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct Failure {
    /// Exit code.
    pub code: u8,
    /// One message, with the remedy.
    pub message: String,
}

impl Failure {
    /// Bad input: a file, a flag, a field.
    #[must_use]
    #[expect(clippy::needless_pass_by_value, reason = "errors are passed as they come")]
    pub fn input(message: impl ToString) -> Self {
        Self { code: INPUT, message: message.to_string() }
    }

    /// The same failure, said of `origin`: a file, or an option.
    #[must_use]
    pub fn within(self, origin: &str) -> Self {
        Self { message: format!("{origin}: {}", self.message), ..self }
    }

    /// The same failure with more to say.
    #[must_use]
    pub fn and(self, more: &str) -> Self {
        Self { message: format!("{}\n{more}", self.message), ..self }
    }
}

/// Errors that are always of bad input.
pub trait BadInput: Display {}

impl BadInput for LoadError {}
impl BadInput for FormatError {}
impl BadInput for InitError {}
impl BadInput for KnobError {}
/// Before training: the policy's name or parameters are wrong.
impl BadInput for PolicyError {}

impl<E: BadInput> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::input(error)
    }
}

impl From<BackendError> for Failure {
    fn from(error: BackendError) -> Self {
        let code = if is_input(&error) { INPUT } else { DEVICE };
        Self { code, message: error.to_string() }
    }
}

/// Whether other arguments would do.
fn is_input(error: &BackendError) -> bool {
    matches!(
        error,
        BackendError::ImageTooLarge { .. }
            | BackendError::NoAdapter(_)
            | BackendError::OverLimit(_)
    )
}

impl From<OutputError> for Failure {
    fn from(error: OutputError) -> Self {
        let code = if matches!(error, OutputError::Unfit(_)) { INPUT } else { OTHER };
        Self { code, message: error.to_string() }
    }
}

impl From<TrainError> for Failure {
    fn from(error: TrainError) -> Self {
        let code = match &error {
            TrainError::BadOption(_) | TrainError::View { .. } => INPUT,
            TrainError::Backend { source, .. } if is_input(source) => INPUT,
            TrainError::Backend { .. } => DEVICE,
            _ => OTHER,
        };
        Self { code, message: error.to_string() }
    }
}

impl From<CheckpointError> for Failure {
    fn from(error: CheckpointError) -> Self {
        match error {
            CheckpointError::File(error) => error.into(),
            CheckpointError::Backend(error) => error.into(),
            CheckpointError::Policy { .. } => Self { code: OTHER, message: error.to_string() },
            CheckpointError::Invalid { .. } => Self::input(error),
        }
    }
}

impl From<EvaluateError> for Failure {
    fn from(error: EvaluateError) -> Self {
        let code = match &error {
            EvaluateError::Stopped => OTHER,
            EvaluateError::Backend { source, .. } | EvaluateError::Model(source)
                if !is_input(source) =>
            {
                DEVICE
            }
            _ => INPUT,
        };
        Self { code, message: error.to_string() }
    }
}

impl From<SceneError> for Failure {
    fn from(error: SceneError) -> Self {
        let code = match error {
            SceneError::Write { .. } => OTHER,
            _ => INPUT,
        };
        Self { code, message: error.to_string() }
    }
}
