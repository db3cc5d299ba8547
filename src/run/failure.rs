//! Errors as they reach a user: one message with the remedy, and the exit code that it stands for.

use std::fmt::Display;

use densify_policies::policy::PolicyError;
use densify_scenegen::Error as SceneError;

use crate::knobs::KnobError;
use densify_core::files::FileError;
use densify_data::LoadError;
use densify_data::models::FormatError;
use densify_render::{Accumulation, BackendError, Fit};
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
        Self::of_backend(&error, &error)
    }
}

impl Failure {
    /// A failure of a backend: the message, which ends with the error, and its remedy.
    fn of_backend(error: &BackendError, message: impl Display) -> Self {
        let code = if is_input(error) { INPUT } else { DEVICE };
        Self { code, message: format!("{message}; {}", remedy(error)) }
    }
}

/// Whether other arguments would avoid the error.
fn is_input(error: &BackendError) -> bool {
    match error {
        BackendError::ImageTooLarge { .. }
        | BackendError::NoAdapter(_)
        | BackendError::AdapterUnused
        | BackendError::WithoutGpu
        | BackendError::TooManyRows { .. }
        | BackendError::BufferTooLarge { .. }
        | BackendError::Unsupported(_) => true,
        BackendError::OutOfMemory { .. }
        | BackendError::Threads(_)
        | BackendError::DeviceLost { .. }
        | BackendError::Device { .. }
        | BackendError::LoopCut { .. } => false,
    }
}

/// The remedy for a backend's error, with options as the command line spells them.
fn remedy(error: &BackendError) -> String {
    let remedy = match error {
        BackendError::OutOfMemory { .. } => "lower --budget, --sh-degree or --tile-cap",
        BackendError::Threads(_) => "lower --threads",
        BackendError::ImageTooLarge { .. } => "use --resolution to shrink it",
        BackendError::NoAdapter(_) => {
            "`densify devices` lists the adapters, and --backend cpu needs none"
        }
        BackendError::AdapterUnused => "leave out --gpu or --backend cpu",
        BackendError::WithoutGpu => {
            "add it to the features of densify in Cargo.toml, or leave out --backend gpu and --gpu"
        }
        BackendError::TooManyRows { most, .. } => return format!("use --budget {most}"),
        BackendError::BufferTooLarge { fit, .. } => match fit {
            Fit::TileCap(pairs) => return format!("use --tile-cap {pairs}"),
            Fit::Budget(rows) => return format!("use --budget {rows}"),
            Fit::ImageSize => "shrink the images with --resolution",
        },
        BackendError::Unsupported(_) => "use --backend cpu",
        BackendError::DeviceLost { .. } => "start again from what was saved, or use --backend cpu",
        BackendError::LoopCut { accumulation, .. } if *accumulation != Accumulation::Slots => {
            "--knob accumulation=slots goes through more; otherwise try another driver, or --backend cpu"
        }
        BackendError::Device { .. } | BackendError::LoopCut { .. } => {
            "try another driver, or --backend cpu"
        }
    };
    remedy.to_owned()
}

impl From<FileError> for Failure {
    fn from(error: FileError) -> Self {
        match error {
            FileError::Occupied { .. } => Self::input(format!(
                "{error}; choose another folder with -o, or replace it with --overwrite"
            )),
            FileError::Unfit(_) => Self::input(error),
            _ => Self { code: OTHER, message: error.to_string() },
        }
    }
}

impl From<TrainError> for Failure {
    fn from(error: TrainError) -> Self {
        let code = match &error {
            TrainError::BadOption(_) | TrainError::View { .. } => INPUT,
            TrainError::Backend { source, .. } => return Self::of_backend(source, &error),
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
            EvaluateError::Backend { source, .. } | EvaluateError::Model(source) => {
                return Self::of_backend(source, &error);
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

#[cfg(test)]
mod tests {
    use super::*;

    /// The error's own words first, then the remedy; also when the error is the source of another.
    #[test]
    fn errors_of_backends_end_with_their_remedy() {
        let device = || "Card".to_owned();
        let too_large = |fit| BackendError::BufferTooLarge {
            buffer: "loss",
            bytes: 3 << 30,
            device: device(),
            most: 1 << 30,
            fit,
        };
        let cut = |accumulation| BackendError::LoopCut { device: device(), accumulation };
        let lost = BackendError::DeviceLost { device: device(), why: "reset".into() };
        for (error, code, message) in [
            (
                BackendError::OutOfMemory { what: "the training buffers", bytes: 7 },
                DEVICE,
                "cannot allocate 7 bytes for the training buffers; lower --budget, --sh-degree or --tile-cap",
            ),
            (
                too_large(Fit::TileCap(5)),
                INPUT,
                "loss: 3.0 GiB in one buffer, but Card supports at most 1.0 GiB; use --tile-cap 5",
            ),
            (too_large(Fit::ImageSize), INPUT, "1.0 GiB; shrink the images with --resolution"),
            (
                lost,
                DEVICE,
                "Card was lost (reset); start again from what was saved, or use --backend cpu",
            ),
            (cut(Accumulation::Slots), DEVICE, "a tile); try another driver, or --backend cpu"),
            (
                cut(Accumulation::SubgroupCas),
                DEVICE,
                "a tile); --knob accumulation=slots goes through",
            ),
        ] {
            let wrapped = TrainError::Backend { step: 3, source: error };
            let failure = Failure::from(wrapped);
            assert_eq!(failure.code, code, "{failure}");
            assert!(failure.message.starts_with("step 3: "), "{failure}");
            assert!(failure.message.contains(message), "{failure}");
        }
    }

    #[test]
    fn an_occupied_folder_names_the_options_that_help() {
        let failure = Failure::from(FileError::occupied("out".as_ref()));
        let expected =
            "out holds another run; choose another folder with -o, or replace it with --overwrite";
        assert_eq!((failure.code, &*failure.message), (INPUT, expected));
    }
}
