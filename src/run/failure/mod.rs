//! Errors of runs: an exit code and a message. [Problems](Problem) are data; all their messages are in one place, and
//! the code that shows them chooses how options are spelled.

pub(crate) mod notes;
mod problem;
mod words;

use std::fmt::Display;

pub use problem::{
    BackendRemedy, Difference, ModelProblem, OptionProblem, Problem, Remedy, ResumeProblem,
    SizeProblem, TrainRemedy, TrainingProblem,
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
use densify_train::output::FolderError;
use densify_train::trainer::TrainError;

/// Exit code of all other errors.
pub const OTHER: u8 = 1;
/// Exit code of bad input and usage.
pub const INPUT: u8 = 2;
/// Exit code if a measured value is beyond the limit that was given for it.
pub const LIMIT: u8 = 4;
/// Exit code if the device is unsuitable or lost, or there is too little memory.
pub const DEVICE: u8 = 3;

/// The failure of a run or a command. It is displayed with options spelled as on a terminal.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{}", self.words(Spelling::Terminal))]
pub struct Failure {
    /// Exit code.
    pub code: u8,
    parts: Vec<Part>,
}

/// A part of a failure's message.
#[derive(Debug, Clone, PartialEq)]
enum Part {
    /// Text, such as the message of another library.
    Text(String),
    Problem(Box<Problem>),
    /// The option that the next part is about, with its value if there is one.
    Option(&'static str, Option<String>),
}

impl Failure {
    /// A failure with a complete message: one that names no option, or that comes from a command.
    #[expect(clippy::needless_pass_by_value, reason = "errors are passed as they come")]
    pub fn new(code: u8, message: impl ToString) -> Self {
        Self { code, parts: vec![Part::Text(message.to_string())] }
    }

    /// A failure because of bad input: a file, an option or a field.
    pub fn input(message: impl ToString) -> Self {
        Self::new(INPUT, message)
    }

    /// A problem as a failure with this exit code.
    pub fn with_code(code: u8, problem: impl Into<Problem>) -> Self {
        Self { code, parts: vec![Part::Problem(Box::new(problem.into()))] }
    }

    /// The same failure, with its origin before the message.
    #[must_use]
    pub fn within(self, origin: &str) -> Self {
        self.with_prefix([Part::Text(format!("{origin}: "))])
    }

    /// The same failure, with an option, and its value if there is one, before the message.
    #[must_use]
    pub fn within_option(self, option: &'static str, value: Option<String>) -> Self {
        self.with_prefix([Part::Option(option, value), Part::Text(": ".to_owned())])
    }

    fn with_prefix<const COUNT: usize>(mut self, parts: [Part; COUNT]) -> Self {
        self.parts.splice(0..0, parts);
        self
    }

    /// The same failure, with one more line.
    #[must_use]
    pub fn and(mut self, more: &str) -> Self {
        self.parts.push(Part::Text(format!("\n{more}")));
        self
    }

    /// The same failure, with one more problem.
    #[must_use]
    pub fn with(mut self, more: impl Into<Problem>) -> Self {
        self.parts.push(Part::Text("\n".to_owned()));
        self.parts.push(Part::Problem(Box::new(more.into())));
        self
    }

    /// The whole message, with options in this spelling.
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

macro_rules! problems {
    ($($problem:ident: $kind:ident),*) => {$(
        impl From<$problem> for Problem {
            fn from(problem: $problem) -> Self {
                Self::$kind(problem)
            }
        }
    )*};
}

problems!(OptionProblem: Options, SizeProblem: Size, ModelProblem: Model, ResumeProblem: Resume);
problems!(TrainingProblem: Training, BackendRemedy: Backend, TrainRemedy: Train, LoadError: Load);

macro_rules! bad_input {
    ($($error:ident),*) => {$(
        impl From<$error> for Failure {
            fn from(error: $error) -> Self {
                Self::with_code(INPUT, error)
            }
        }
    )*};
}

bad_input!(OptionProblem, SizeProblem, ModelProblem, ResumeProblem, LoadError);

impl OptionProblem {
    /// A wrong value of an option.
    pub(crate) fn value(option: &'static str, problem: impl Display) -> Self {
        Self::Value { option, problem: problem.to_string() }
    }
}

/// Errors that are always due to bad input.
pub trait BadInput: Display {}

impl BadInput for FormatError {}
/// Before training, such an error means that the policy's name or parameters are wrong.
impl BadInput for PolicyError {}

impl<E: BadInput> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::input(error)
    }
}

impl From<BackendError> for Failure {
    fn from(error: BackendError) -> Self {
        Self::from_backend(&error, &error)
    }
}

impl Failure {
    /// A failure of a backend: the message, which ends with the error, and its remedy.
    fn from_backend(error: &BackendError, message: impl ToString) -> Self {
        let (code, remedy) = BackendRemedy::for_error(error);
        Self::with_remedy(code, message, remedy)
    }

    fn with_remedy(code: u8, message: impl ToString, remedy: impl Into<Problem>) -> Self {
        let mut failure = Self::new(code, message);
        failure.parts.push(Part::Text("; ".to_owned()));
        failure.parts.push(Part::Problem(Box::new(remedy.into())));
        failure
    }
}

impl BackendRemedy {
    /// The exit code and the remedy for an error; the code is that of bad input if other options would avoid the error.
    fn for_error(error: &BackendError) -> (u8, Self) {
        match error {
            BackendError::OutOfMemory { .. } => (DEVICE, Self::LessMemory),
            BackendError::Threads(_) => (DEVICE, Self::FewerThreads),
            BackendError::ImageTooLarge { .. } => (INPUT, Self::SmallerImages),
            BackendError::NoAdapter(_) => (INPUT, Self::ListAdapters),
            BackendError::AdapterUnused => (INPUT, Self::NoAdapterOrGpu),
            BackendError::WithoutGpu => (INPUT, Self::BuildWithGpu),
            BackendError::TooManyRows { most, .. } => (INPUT, Self::Budget(*most)),
            BackendError::BufferTooLarge { fit, .. } => match fit {
                Fit::TileCap(pairs) => (INPUT, Self::TileCap(*pairs)),
                Fit::Budget(rows) => (INPUT, Self::Budget(*rows)),
                Fit::ImageSize => (INPUT, Self::SmallerImages),
            },
            BackendError::Unsupported(_) => (INPUT, Self::NativeBackend),
            BackendError::DeviceLost { .. } => (DEVICE, Self::StartAgain),
            BackendError::LoopCut { accumulation, .. } if *accumulation != Accumulation::Slots => {
                (DEVICE, Self::SlotsOrOtherDriver)
            }
            BackendError::Device { .. } | BackendError::LoopCut { .. } => {
                (DEVICE, Self::OtherDriver)
            }
        }
    }
}

impl From<FileError> for Failure {
    fn from(error: FileError) -> Self {
        let is_input = matches!(error, FileError::Malformed { .. });
        Self::new(if is_input { INPUT } else { OTHER }, error)
    }
}

impl From<FolderError> for Failure {
    fn from(error: FolderError) -> Self {
        let remedy = match error {
            FolderError::File(error) => return error.into(),
            FolderError::NoRun { .. }
            | FolderError::NotAModel { .. }
            | FolderError::NotFound { .. } => return Self::input(error),
            FolderError::Lost { .. } | FolderError::NotReplaced { .. } => {
                return Self::new(OTHER, error);
            }
            FolderError::Occupied { .. } => TrainRemedy::OtherFolderOrOverwrite,
            FolderError::InUse { .. } => TrainRemedy::WaitOrOtherFolder,
            FolderError::NotAFolder { .. } => TrainRemedy::OtherFolder,
        };
        Self::with_remedy(INPUT, error, remedy)
    }
}

impl From<InitError> for Failure {
    fn from(error: InitError) -> Self {
        let remedy = match error {
            InitError::TooManyPoints(_) => return Self::input(error),
            InitError::NoBudget => TrainRemedy::Budget,
            InitError::Degree(_) => TrainRemedy::Degree,
            InitError::NoPoints => TrainRemedy::RandomStart,
        };
        Self::with_remedy(INPUT, error, remedy)
    }
}

impl From<TrainError> for Failure {
    fn from(error: TrainError) -> Self {
        let code = match &error {
            TrainError::BadOption(_) | TrainError::View { .. } => INPUT,
            TrainError::NoView => {
                return Self::with_remedy(INPUT, error, TrainRemedy::MoreViews);
            }
            TrainError::Backend { source, .. } => return Self::from_backend(source, &error),
            _ => OTHER,
        };
        Self::new(code, error)
    }
}

impl From<CheckpointError> for Failure {
    fn from(error: CheckpointError) -> Self {
        match error {
            CheckpointError::File(error) => error.into(),
            CheckpointError::Folder(error) => error.into(),
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
                return Self::from_backend(source, &error);
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

    /// The error's message comes first, then the remedy, even if the error is the source of another.
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
                "a tile); --knob accumulation=slots may avoid this",
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
        let failure = Failure::from(FolderError::Occupied { folder: "out".into() });
        let expected = "out holds another run; continue it with --resume, choose another folder with -o, or replace it with \
             --overwrite";
        assert_eq!((failure.code, &*failure.to_string()), (INPUT, expected));
    }
}
