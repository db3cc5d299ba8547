//! Everything that can be wrong with a run, as data: the option or file, its content, and what would fit. Options are
//! named as [`OPTIONS`](crate::OPTIONS) names them.

use std::path::PathBuf;

use densify_data::LoadError;
use densify_render::{Accumulation, BackendKind};

/// A problem with options: with one by itself, or with several that contradict each other.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the fields are the data of the message of each variant")]
pub enum OptionProblem {
    /// A file has a key that is no option.
    UnknownOption { name: String, nearest: Option<String> },
    /// An option has a value that is not one of its values.
    Value { option: &'static str, problem: String },
    /// Parts of an option contradict each other.
    Conflict { option: &'static str, problem: String },
    /// A value of `policy_set` is not of its form.
    PolicySetting { setting: String },
    /// A path cannot be written to `config.toml`.
    NotUtf8 { option: &'static str, path: PathBuf },
    /// No dataset is named.
    NoScene,
    /// Something is to be done after an iteration that the run does not have.
    IterationOutOfRange { option: &'static str, step: u32, last: u32 },
    /// A file is not what it should be.
    Malformed { origin: String, problem: String },
    /// `deterministic` contradicts the knob.
    AccumulationConflict { given: Accumulation },
    /// A knob is set that this backend does not have.
    KnobOfOtherBackend {
        knob: &'static str,
        value: String,
        backend: BackendKind,
        only_on: BackendKind,
        default: &'static str,
    },
    /// `full` disables what this option makes automatic.
    AutomaticWithFull { option: &'static str },
    /// An automatic budget cannot remove frozen Gaussians.
    AutoBudgetWithFreeze,
    /// A number of random points for a start that is not random.
    UnusedInitPoints { points: usize },
    /// Test views are to be measured, and there is none.
    NothingToTest,
}

/// A run that does not fit.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the fields are the data of the message of each variant")]
pub enum SizeProblem {
    /// More views than can be counted.
    TooManyViews,
    /// Frozen Gaussians leave no room in the budget.
    FreezeFillsBudget { frozen: usize, budget: usize },
    /// `tile_cap` and the knob both set the length of tile lists.
    TileCapConflict { cap: usize, pairs: usize },
    /// A run that goes on takes more than its memory.
    OverMemory { memory: u64, needed: u64, remedies: Vec<Vec<Remedy>> },
    /// The system does not grant the process the memory of the run.
    OverGrant {
        needed: u64,
        resident: u64,
        limit: &'static str,
        left: u64,
        remedies: Vec<Vec<Remedy>>,
    },
    /// No size fits the memory, and the least memory is unknown.
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
    /// The file is the folder of a run, which has this model.
    ModelOfRun { file: PathBuf },
    /// Too few Gaussians of the model of `init` lie in a training view.
    InitOutOfView { file: PathBuf, seen: usize, rows: usize },
    /// No Gaussian of the model of `freeze` lies in a training view.
    FreezeOutOfView { file: PathBuf, rows: usize },
    /// The model of `freeze` has changed.
    FreezeChanged { file: PathBuf, rows: usize, expected: usize },
    /// A model shows nothing of the photographs.
    OtherCoordinates { option: Option<&'static str>, file: PathBuf, correlation: f64 },
    /// A split has no views.
    NoTestViews,
    /// The dataset of a run is no longer where it was.
    DatasetMoved,
    /// A run was stopped before it saved a model.
    NoModelYet { run: PathBuf, step: u32 },
    /// A run has no model of this iteration.
    NoSuchIteration { iteration: u32, run: PathBuf, saved: Vec<u32> },
    /// A run is being trained, and has saved no model.
    StillTraining { run: PathBuf },
    /// An iteration is named for a file, which has one model.
    IterationOfFile,
}

/// A run that cannot go on.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the fields are the data of the message of each variant")]
pub enum ResumeProblem {
    /// A run that was to replace this one was interrupted.
    InterruptedReplacement { output: PathBuf, staged: PathBuf },
    /// A run cannot be made shorter.
    Shortened { asked: u32, origin: String, length: u32, done: u32 },
    /// An automatic value for a run that had another one.
    AutoOnResume { option: &'static str, origin: String, saved: String },
    /// No checkpoint is sound.
    NoSoundCheckpoint { output: PathBuf, errors: Vec<String> },
    /// A complete run without a checkpoint.
    NoCheckpoint { output: PathBuf },
    /// Options of a run that goes on would change its result.
    ResultWouldDiffer { origin: PathBuf, differences: Vec<Difference> },
    /// A run goes on with another dataset.
    OtherDataset { origin: PathBuf, difference: String },
}

/// The end of a run that is not complete.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the fields are the data of the message of each variant")]
pub enum TrainingProblem {
    /// The model draws nothing in most of the last views.
    DrawsNothing { empty: usize, views: usize },
    /// A signal stopped the run; without a step nothing was written.
    Stopped { by: &'static str, step: Option<u32> },
    /// The checkpoint at the end could not be written.
    CheckpointFailed { error: String },
    /// After an error of the policy, the model before it.
    ModelSaved { saved: Result<PathBuf, String> },
    /// Measuring failed; the run itself is complete.
    OnlyMeasuringFailed { run: PathBuf },
    /// The files of a run that failed, and the checkpoint to go on from.
    LeftBehind { run: PathBuf, checkpoint: Option<PathBuf>, scene: PathBuf },
}

/// Any problem with a run.
#[derive(Debug, Clone, PartialEq)]
pub enum Problem {
    /// With its options.
    Options(OptionProblem),
    /// With its size.
    Size(SizeProblem),
    /// With a model.
    Model(ModelProblem),
    /// With going on.
    Resume(ResumeProblem),
    /// While it trains.
    Training(TrainingProblem),
    /// The remedy for an error of a backend, which stands before it.
    Backend(BackendRemedy),
    /// The remedy for an error of training, which stands before it.
    Train(TrainRemedy),
    /// A dataset or model that cannot be loaded.
    Load(LoadError),
}

/// The remedy for an error of training: of its folder, its first Gaussians or its views.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrainRemedy {
    /// Another folder, or replacing the run in this one.
    OtherFolderOrOverwrite,
    /// The end of the process that trains in the folder, or another folder.
    WaitOrOtherFolder,
    /// Another folder.
    OtherFolder,
    /// A budget.
    Budget,
    /// A degree.
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
    /// A look at the adapters that exist, or the native backend.
    ListAdapters,
    /// Either no adapter, or the GPU backend.
    NoAdapterOrGpu,
    /// A program with the GPU backend.
    BuildWithGpu,
    /// A budget of this many Gaussians.
    Budget(u64),
    /// Tile lists of this many pairs.
    TileCap(u64),
    /// The native backend.
    NativeBackend,
    /// Another start from what was saved, or the native backend.
    StartAgain,
    /// Accumulation in slots, another driver, or the native backend.
    SlotsOrOtherDriver,
    /// Another driver, or the native backend.
    OtherDriver,
}

/// A change of the options after which a run fits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Remedy {
    /// Keep no decoded photographs.
    NoImages,
    /// Let the tile lists be chosen.
    NoTileCap,
    /// Tile lists of this many pairs.
    TileCap(usize),
    /// The preset for runs that are short of memory.
    Preset(&'static str),
    /// Degree 0.
    LeastDegree,
    /// Photographs this many times smaller.
    Shrink(u32),
    /// This much memory `[MiB]`.
    Memory(u64),
    /// At most this many rows.
    Budget(usize),
}

/// A setting that differs from the run that goes on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The option.
    pub option: String,
    /// The member of an option that has several; else empty.
    pub member: String,
    /// The value now, as text; `None`: not set.
    pub now: Option<String>,
    /// The value in that run.
    pub then: Option<String>,
}
