//! Errors of runs: an exit code with what went wrong. [Problems](Problem) are data; their words are in one place, and
//! whoever shows them says how options are spelled.

pub(crate) mod notes;
mod problem;
mod words;

use std::fmt::Display;
use std::path::Path;

pub use problem::{
    BackendRemedy, Difference, ModelProblem, OptionProblem, Problem, Remedy, ResumeProblem,
    SizeProblem, TrainingProblem,
};

use densify_policies::policy::PolicyError;
use densify_scenegen::Error as SceneError;

use densify_core::files::FileError;
use densify_core::spelling::Spelling;
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
/// Exit code if a measured value is beyond the limit that was given for it.
pub const LIMIT: u8 = 4;
/// Exit code if device or memory do not suffice.
pub const DEVICE: u8 = 3;

/// The failure of a run or a command. Displayed with options as on a terminal.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{}", self.words(Spelling::Terminal))]
pub struct Failure {
    /// Exit code.
    pub code: u8,
    parts: Vec<Part>,
}

/// A part of what a failure says.
#[derive(Debug, Clone, PartialEq)]
enum Part {
    /// Words, such as those of another library.
    Text(String),
    Problem(Box<Problem>),
    /// An option that what follows is about, perhaps with its value.
    Option(&'static str, Option<String>),
}

impl Failure {
    /// A failure in words that name no option, or of a command.
    #[must_use]
    #[expect(clippy::needless_pass_by_value, reason = "errors are passed as they come")]
    pub fn new(code: u8, message: impl ToString) -> Self {
        Self { code, parts: vec![Part::Text(message.to_string())] }
    }

    /// Bad input: a file, an option, a field.
    #[must_use]
    pub fn input(message: impl ToString) -> Self {
        Self::new(INPUT, message)
    }

    /// The failure of a problem with this exit code.
    #[must_use]
    pub fn with_code(code: u8, problem: impl Into<Problem>) -> Self {
        Self { code, parts: vec![Part::Problem(Box::new(problem.into()))] }
    }

    /// The same failure, of `origin`.
    #[must_use]
    pub fn within(self, origin: &str) -> Self {
        self.after([Part::Text(format!("{origin}: "))])
    }

    /// The same failure, of an option, or of the value that it has.
    #[must_use]
    pub fn within_option(self, option: &'static str, value: Option<String>) -> Self {
        self.after([Part::Option(option, value), Part::Text(": ".to_owned())])
    }

    /// The same failure, in the file of options.
    #[must_use]
    pub(crate) fn within_config_file(self, path: &Path) -> Self {
        self.within_option("config", Some(path.display().to_string()))
    }

    fn after<const COUNT: usize>(mut self, parts: [Part; COUNT]) -> Self {
        self.parts.splice(0..0, parts);
        self
    }

    /// The same failure with another line.
    #[must_use]
    pub fn and(mut self, more: &str) -> Self {
        self.parts.push(Part::Text(format!("\n{more}")));
        self
    }

    /// The same failure, with another problem.
    #[must_use]
    pub fn with(mut self, more: impl Into<Problem>) -> Self {
        self.parts.push(Part::Text("\n".to_owned()));
        self.parts.push(Part::Problem(Box::new(more.into())));
        self
    }

    /// The whole message, with options as its reader spells them.
    #[must_use]
    pub fn words(&self, spelling: Spelling) -> String {
        let words = |part: &Part| match part {
            Part::Text(text) => text.clone(),
            Part::Problem(problem) => problem.words(spelling),
            Part::Option(name, None) => spelling.option(name),
            Part::Option(name, Some(value)) => spelling.text(name, value),
        };
        self.parts.iter().map(words).collect()
    }
}

macro_rules! bad_input {
    ($($problem:ident: $kind:ident),*) => {$(
        impl From<$problem> for Problem {
            fn from(problem: $problem) -> Self {
                Self::$kind(problem)
            }
        }

        impl From<$problem> for Failure {
            fn from(problem: $problem) -> Self {
                Self::with_code(INPUT, problem)
            }
        }
    )*};
}

bad_input!(
    OptionProblem: Options,
    SizeProblem: Size,
    ModelProblem: Model,
    ResumeProblem: Resume,
    LoadError: Load
);

impl OptionProblem {
    /// A wrong value of an option.
    pub(crate) fn value(option: &'static str, problem: impl Display) -> Self {
        Self::Value { option, problem: problem.to_string() }
    }
}

impl From<TrainingProblem> for Problem {
    fn from(problem: TrainingProblem) -> Self {
        Self::Training(problem)
    }
}

/// Errors that are always of bad input.
pub trait BadInput: Display {}

impl BadInput for FormatError {}
impl BadInput for InitError {}
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
    fn of_backend(error: &BackendError, message: impl ToString) -> Self {
        let code = if is_input(error) { INPUT } else { DEVICE };
        let mut failure = Self::new(code, message);
        failure.parts.push(Part::Text("; ".to_owned()));
        failure.parts.push(Part::Problem(Box::new(BackendRemedy::of(error).into())));
        failure
    }
}

/// True if other arguments would avoid the error.
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

impl BackendRemedy {
    fn of(error: &BackendError) -> Self {
        match error {
            BackendError::OutOfMemory { .. } => Self::LessMemory,
            BackendError::Threads(_) => Self::FewerThreads,
            BackendError::ImageTooLarge { .. } => Self::SmallerImages,
            BackendError::NoAdapter(_) => Self::ListAdapters,
            BackendError::AdapterUnused => Self::NoAdapterOrGpu,
            BackendError::WithoutGpu => Self::BuildWithGpu,
            BackendError::TooManyRows { most, .. } => Self::Budget(*most),
            BackendError::BufferTooLarge { fit, .. } => match fit {
                Fit::TileCap(pairs) => Self::TileCap(*pairs),
                Fit::Budget(rows) => Self::Budget(*rows),
                Fit::ImageSize => Self::SmallerImages,
            },
            BackendError::Unsupported(_) => Self::NativeBackend,
            BackendError::DeviceLost { .. } => Self::StartAgain,
            BackendError::LoopCut { accumulation, .. } if *accumulation != Accumulation::Slots => {
                Self::SlotsOrOtherDriver
            }
            BackendError::Device { .. } | BackendError::LoopCut { .. } => Self::OtherDriver,
        }
    }
}

impl From<BackendRemedy> for Problem {
    fn from(remedy: BackendRemedy) -> Self {
        Self::Backend(remedy)
    }
}

impl From<FileError> for Failure {
    fn from(error: FileError) -> Self {
        match error {
            FileError::Occupied { folder } => {
                Self::with_code(INPUT, OptionProblem::FolderOccupied { folder })
            }
            FileError::Unfit(_) => Self::input(error),
            _ => Self::new(OTHER, error),
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
        Self::new(code, error)
    }
}

impl From<CheckpointError> for Failure {
    fn from(error: CheckpointError) -> Self {
        match error {
            CheckpointError::File(error) => error.into(),
            CheckpointError::Backend(error) => error.into(),
            CheckpointError::Policy { .. } => Self::new(OTHER, error),
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
        Self::new(code, error)
    }
}

impl From<SceneError> for Failure {
    fn from(error: SceneError) -> Self {
        let code = match error {
            SceneError::Write { .. } => OTHER,
            _ => INPUT,
        };
        Self::new(code, error)
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
            let words = failure.to_string();
            assert!(words.starts_with("step 3: "), "{failure}");
            assert!(words.contains(message), "{failure}");
        }
    }

    #[test]
    fn an_occupied_folder_names_the_options_that_help() {
        let failure = Failure::from(FileError::occupied("out".as_ref()));
        let expected =
            "out holds another run; choose another folder with -o, or replace it with --overwrite";
        assert_eq!((failure.code, &*failure.to_string()), (INPUT, expected));
    }
}
