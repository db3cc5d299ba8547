//! Everything that can be wrong with a run, as data: the option or file, its value, and a valid alternative. Options
//! are named as [`OPTIONS`](crate::OPTIONS) names them.

use std::path::PathBuf;

use densify_core::antialiasing::Antialiasing;
use densify_data::LoadError;
use densify_render::{Accumulation, BackendKind};
use densify_train::poses::PoseChoice;

/// A problem with options: with one by itself, or with several that contradict each other.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the fields are the data of the message of each variant")]
pub enum OptionProblem {
    /// A file has a key that is no option.
    UnknownOption { name: String, nearest: Option<String> },
    /// An option has an invalid value.
    Value { option: &'static str, problem: String },
    /// Parts of an option contradict each other.
    Conflict { option: &'static str, problem: String },
    /// A value of `policy_set` is not of the form `policy.parameter=value`.
    PolicySetting { setting: String },
    /// A path cannot be written to `config.toml`.
    NotUtf8 { option: &'static str, path: PathBuf },
    /// No dataset is named.
    NoScene,
    /// The model is to be saved or tested after an iteration that the run does not have.
    IterationOutOfRange { option: &'static str, step: u32, last: u32 },
    /// A value cannot be parsed; `origin` names its source.
    Malformed { origin: String, problem: String },
    /// `deterministic` contradicts the knob `accumulation`.
    AccumulationConflict { given: Accumulation },
    /// A knob is set that this backend does not have.
    KnobOfOtherBackend {
        knob: &'static str,
        value: String,
        backend: BackendKind,
        only_on: BackendKind,
        default: &'static str,
    },
    /// `full` disables automatic reductions, but this option asks for one.
    AutomaticWithFull { option: &'static str },
    /// An automatic budget cannot remove frozen Gaussians.
    AutoBudgetWithFreeze,
    /// Frozen Gaussians do not move with the poses.
    PosesWithFreeze { choice: PoseChoice },
    /// Focal lengths are to be refined, but not poses.
    FocalWithoutPoses,
    /// A number of random points is given, but the run does not start from random points.
    UnusedInitPoints { points: usize },
    /// Test views are to be measured, but there are none.
    NothingToTest,
    /// Vignettes are to be learned, but a view is one of several of its photograph.
    VignetteOfDivided { view: String },
}

/// A size that is contradictory or does not fit.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the fields are the data of the message of each variant")]
pub enum SizeProblem {
    /// The scene has more views than can be counted.
    TooManyViews,
    /// Frozen Gaussians leave no room in the budget.
    FreezeFillsBudget { frozen: usize, budget: usize },
    /// `tile_cap` and the knob `pairs_per_row` both set the length of tile lists.
    TileCapConflict { cap: usize, pairs: usize },
    /// A resumed run needs more than its memory limit.
    OverMemory { memory: u64, needed: u64, remedies: Vec<Vec<Remedy>> },
    /// The system does not grant the process the memory that the run needs.
    OverGrant {
        needed: u64,
        resident: u64,
        limit: &'static str,
        left: u64,
        remedies: Vec<Vec<Remedy>>,
    },
    /// No size fits the memory, and the smallest sufficient memory is unknown.
    NoSize { memory: u64 },
    /// Not even the smallest model fits the memory.
    NoModelFits { memory: u64, rows: usize, sh_degree: u8, needed: u64, remedies: Vec<Vec<Remedy>> },
}

/// A problem with a model, or with the dataset that it belongs to.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the fields are the data of the message of each variant")]
pub enum ModelProblem {
    /// The model of an option has no Gaussian.
    EmptyModel { option: &'static str, file: PathBuf },
    /// Too few Gaussians of the model of `init` lie in a training view.
    InitOutOfView { file: PathBuf, seen: usize, rows: usize },
    /// No Gaussian of the model of `freeze` lies in a training view.
    FreezeOutOfView { file: PathBuf, rows: usize },
    /// The models of `init` and `freeze` were trained with different antialiasing.
    AntialiasingDiffers { init: Antialiasing, frozen: Antialiasing },
    /// The model of `freeze` has changed.
    FreezeChanged { file: PathBuf, rows: usize, expected: usize },
    /// A model is in other coordinates than the dataset.
    OtherCoordinates { option: Option<&'static str>, file: PathBuf, correlation: f64 },
    /// The test split has no views.
    NoTestViews,
    /// The dataset of a run is no longer where it was.
    DatasetMoved,
    /// A run was stopped before it saved a model.
    NoModelYet { run: PathBuf, step: u32 },
    /// A run has no model of this iteration.
    NoSuchIteration { iteration: u32, run: PathBuf, saved: Vec<u32> },
    /// A run is being trained, and has saved no model.
    StillTraining { run: PathBuf },
    /// An iteration is given for a file, which has only one model.
    IterationOfFile,
}

/// A run that cannot be resumed.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the fields are the data of the message of each variant")]
pub enum ResumeProblem {
    /// A run that was to replace this one was interrupted.
    InterruptedReplacement { output: PathBuf, staged: PathBuf },
    /// A run cannot be made shorter.
    Shortened { asked: u32, origin: String, length: u32, done: u32 },
    /// `auto` is given, but the run was started with a fixed value.
    AutoOnResume { option: &'static str, origin: String, saved: String },
    /// No checkpoint is usable.
    NoSoundCheckpoint { output: PathBuf, errors: Vec<String> },
    /// A run has saved models, but no checkpoint.
    NoCheckpoint { output: PathBuf },
    /// A run was saved or resumed here, and another process has continued it since.
    Continued { output: PathBuf },
    /// Options would change the result of a resumed run.
    ResultWouldDiffer { origin: PathBuf, differences: Vec<Difference> },
    /// A run is resumed with another dataset.
    OtherDataset { origin: PathBuf, difference: String },
}

/// A problem that ended a run, or the files that the run left.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the fields are the data of the message of each variant")]
pub enum TrainingProblem {
    /// More than half of the last renderings are empty.
    DrawsNothing { empty: usize, views: usize },
    /// A signal stopped the run; `step` is `None` if nothing was written.
    Stopped { by: &'static str, step: Option<u32> },
    /// The checkpoint at the end could not be written.
    CheckpointFailed { error: String },
    /// The file with the model as it was before the policy failed, or the error of saving that model.
    ModelSaved { saved: Result<PathBuf, String> },
    /// Measuring failed; the run itself is complete.
    OnlyMeasuringFailed { run: PathBuf },
    /// The files of a run that failed, and the checkpoint to resume from.
    LeftBehind { run: PathBuf, checkpoint: Option<PathBuf>, scene: PathBuf },
}

/// Any problem with a run, or its remedy.
#[derive(Debug, Clone, PartialEq)]
pub enum Problem {
    /// A problem with the options.
    Options(OptionProblem),
    /// A problem with the size of the run.
    Size(SizeProblem),
    /// A problem with a model.
    Model(ModelProblem),
    /// A problem with resuming the run.
    Resume(ResumeProblem),
    /// A problem during training.
    Training(TrainingProblem),
    /// The remedy for an error of a backend, whose message precedes it.
    Backend(BackendRemedy),
    /// The remedy for an error of training, whose message precedes it.
    Train(TrainRemedy),
    /// A dataset or model that cannot be loaded.
    Load(LoadError),
}

/// The remedy for an error of training: in the output folder, the first Gaussians or the views.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrainRemedy {
    /// Another folder, or continuing or replacing the run in this one.
    OtherFolderOrOverwrite,
    /// Waiting for the process that trains in the folder, stopping it, or another folder.
    WaitOrOtherFolder,
    /// Another folder.
    OtherFolder,
    /// A budget of at least 1.
    Budget,
    /// A suitable degree.
    Degree,
    /// A start from random points.
    RandomStart,
    /// More views to train on.
    MoreViews,
}

/// The remedy for an error of a backend.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BackendRemedy {
    /// A smaller model, a lower degree or shorter tile lists.
    LessMemory,
    /// Fewer threads.
    FewerThreads,
    /// Smaller images.
    SmallerImages,
    /// Listing the available adapters, or the native backend.
    ListAdapters,
    /// Naming no adapter, or not choosing the native backend.
    NoAdapterOrGpu,
    /// A program built with the GPU backend.
    BuildWithGpu,
    /// A budget of this many Gaussians.
    Budget(u64),
    /// Tile lists of this many pairs.
    TileCap(u64),
    /// The native backend.
    NativeBackend,
    /// Restarting from the saved files, or the native backend.
    StartAgain,
    /// Accumulation in slots, another driver, or the native backend.
    SlotsOrOtherDriver,
    /// Another driver, or the native backend.
    OtherDriver,
}

/// A change of the options that makes a run fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Remedy {
    /// Keep no decoded photographs.
    NoImages,
    /// Choose the length of tile lists automatically.
    NoTileCap,
    /// Tile lists of this many pairs.
    TileCap(usize),
    /// The preset for runs that are short of memory.
    Preset(&'static str),
    /// Degree 0.
    LeastDegree,
    /// Photographs smaller by this factor.
    Shrink(u32),
    /// A memory limit `[MiB]`.
    Memory(u64),
    /// At most this many rows.
    Budget(usize),
}

/// A setting that differs from that of the run being resumed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The option.
    pub option: String,
    /// The part of the option, such as a knob; empty for options without parts.
    pub member: String,
    /// The value given now, as text; `None`: not set.
    pub now: Option<String>,
    /// The value in the run being resumed, as text; `None`: not set.
    pub then: Option<String>,
}
