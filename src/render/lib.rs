//! The interface between the trainer and its backends, each a differentiable rasteriser with an optimiser.
//!
//! A step takes a view, runs on the device and returns a few scalars. Signals are downloaded when a policy is due,
//! and row operations are uploaded; parameters stay on the device.

mod adapter;
mod audit;
mod candidates;
mod choice;
pub mod cpu;
mod depth;
mod differentiable;
mod error;
#[cfg(feature = "gpu")]
pub mod gpu;
#[cfg(not(feature = "gpu"))]
#[path = "without_gpu.rs"]
pub mod gpu;
mod inspect;
mod pixel_map;
mod setup;
mod signals;
mod state;

use std::ops::Range;
use std::time::Duration;

use densify_policies::plan::RowOps;
use densify_policies::policy::{
    AuxColumn, AuxRequest, Cadence, Candidate, LossTerms, NoiseTerm, SignalSet, Signals,
};

pub use adapter::{AdapterChoice, AdapterKind, AdapterSummary};
pub use audit::{NonFinite, NumberKind};
pub use choice::{BackendChoice, BackendKind, Device};
use densify_core::antialiasing::Antialiasing;
use densify_core::budget::RowBudget;
use densify_core::camera::Camera;
use densify_core::colour::{ColourGradient, ColourTransform};
use densify_core::gaussians::{Gaussians, ModelArray};
use densify_core::image::Image8;
use densify_core::image::depth::DepthMap;
use densify_core::memory::Ledger;
use densify_core::pose::PoseGradient;
use densify_core::vignette::{COEFFICIENTS, Vignette};
pub use densify_shaders::Accumulation;
pub use depth::{DepthTarget, DepthTerm};
pub use differentiable::{Differentiable, ImageGradient};
pub use error::{BackendError, Fit};
pub use inspect::{DepthKind, Inspect, SurfaceDepths};
pub use setup::{KeptPhotographs, MomentStorage, ParameterStorage, Setup, Shortcuts, Storage};
pub use state::{StateArray, StateError, Tensor, Values};

/// Side of a tile, of all backends `[px]`.
pub const TILE: u32 = 16;

/// Learning rates of one iteration. If all are 0, the default, the model is unchanged, but signals are still measured.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LearningRates {
    /// Means `[scene units per step]`.
    pub mean: f32,
    /// The rate of the means without the boost of short runs. Noise on the means is proportional to this rate
    /// `[scene units per step]`.
    pub noise: f32,
    /// Log-scales `[ln scene units per step]`.
    pub log_scale: f32,
    /// Quaternions.
    pub quat: f32,
    /// Opacity logits.
    pub opacity: f32,
    /// Spherical-harmonic coefficients of band 0.
    pub sh_dc: f32,
    /// Spherical-harmonic coefficients of bands 1–3.
    pub sh_rest: f32,
}

/// The input of a training step.
#[derive(Debug, Clone, Copy)]
pub struct StepInput<'a> {
    /// The iteration, 1-based.
    pub step: u32,
    /// The view's number. Its image never changes, so that a backend may keep it.
    pub view: usize,
    /// The view's camera.
    pub camera: &'a Camera,
    /// The view's image, of the camera's size.
    pub target: &'a Image8,
    /// Background colour, sRGB-encoded in `[0, 1]`; targets with alpha are composited on it as well.
    pub background: [f32; 3],
    /// The exposure of the photograph; requires a backend [set up](Setup::exposures) for exposures. The loss compares
    /// the photograph with the rendering after this transform, which keeps the background unchanged.
    pub exposure: Option<&'a ColourTransform>,
    /// True to differentiate with respect to the camera's pose; requires a backend [set up](Setup::poses) for it.
    pub pose: bool,
    /// The vignette of the photograph, which follows the exposure; requires a backend [set up](Setup::vignettes) for
    /// vignettes. It dims the background only where the photograph is opaque.
    pub vignette: Option<&'a Vignette>,
    /// Given depth of the view; requires a backend [set up](Setup::depth) for depth.
    pub depth: Option<DepthTarget<'a>>,
    /// Weight λ of the distortion term, λ/N·Σ w·(x/X − 1)² over pixels and Gaussians, where x is a Gaussian's inverse
    /// depth and X the pixel's expected one, held fixed; >= 0. 0 is off, else it requires a backend
    /// [set up](Setup::depth) for depth.
    pub distortion: f32,
    /// Spherical-harmonic degree to evaluate and train, <= the model's.
    pub sh_degree: u8,
    /// Learning rates.
    pub rates: LearningRates,
    /// Terms added to the loss.
    pub loss_terms: LossTerms,
    /// Noise on the means.
    pub noise: Option<NoiseTerm>,
    /// Intervals of the optimiser's steps, no longer than those the backend was set up for.
    pub cadence: Cadence,
    /// Seed of the run, for noise on the means and for stochastic rounding.
    pub seed: u64,
}

/// A training view to measure for a policy's edit.
#[derive(Debug, Clone, Copy)]
pub struct AuxInput<'a> {
    /// The iteration just finished, 1-based.
    pub step: u32,
    /// The view's number, for random sampling.
    pub view: usize,
    /// Seed of the run, for random sampling.
    pub seed: u64,
    /// The view's camera.
    pub camera: &'a Camera,
    /// The view's image, of the camera's size.
    pub target: &'a Image8,
    /// Background colour, sRGB-encoded in `[0, 1]`.
    pub background: [f32; 3],
    /// See [`StepInput::exposure`].
    pub exposure: Option<&'a ColourTransform>,
    /// See [`StepInput::vignette`].
    pub vignette: Option<&'a Vignette>,
    /// Spherical-harmonic degree to evaluate, <= the model's.
    pub sh_degree: u8,
    /// The given depth of the view, of the camera's size, if the run trains on depth.
    pub depth: Option<&'a DepthMap>,
    /// The measurements requested.
    pub request: &'a AuxRequest,
}

impl<'a> AuxInput<'a> {
    /// Measures rows: sums and maxima of blend weights, which depend neither on the colours of the model nor on the
    /// target, an image of the camera's size.
    pub fn of_rows(camera: &'a Camera, target: &'a Image8, request: &'a AuxRequest) -> Self {
        let (step, view, seed, sh_degree) = (0, 0, 0, 0);
        let (background, exposure, vignette, depth) = ([0.0; 3], None, None, None);
        Self {
            step,
            view,
            seed,
            camera,
            target,
            background,
            exposure,
            vignette,
            sh_degree,
            depth,
            request,
        }
    }
}

/// The measurements of a view.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AuxOutput {
    /// 0.8·L1 + 0.2·(1 − SSIM).
    pub loss: f32,
    /// The requested columns, in order. Shape of each: `[rows]`.
    pub columns: Vec<(AuxColumn, Vec<f32>)>,
    /// Surface points; the field `error` of each holds the alpha of its pixel.
    pub points: Vec<Candidate>,
}

/// The scalars of one training step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StepOutput {
    /// 0.8·L1 + 0.2·(1 − SSIM), without the terms that a policy adds.
    pub loss: f32,
    /// Mean over pixels and channels of |rendering − photograph|.
    pub l1: f32,
    /// Mean structural similarity.
    pub ssim: f32,
    /// Number of rows whose projection is on screen.
    pub visible: usize,
    /// Number of rendered (row, tile) pairs.
    pub entries: u64,
    /// Number of bands in which the tile lists were processed: 1 unless the lists exceeded the cap.
    pub bands: u32,
    /// Gradient of the loss with respect to the exposure, if there is one.
    pub exposure: Option<ColourGradient>,
    /// Gradient of the loss with respect to the camera's pose and focal length, through the rows that are not frozen,
    /// if it was requested.
    pub pose: Option<PoseGradient>,
    /// Gradient of the loss with respect to the coefficients of the vignette, if there is one.
    pub vignette: Option<[f32; COEFFICIENTS]>,
    /// The [depth term](DepthTerm) without its weight, if depth is given.
    pub depth: Option<f32>,
}

/// A rendered view.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rendering {
    /// Width `[px]`.
    pub width: u32,
    /// Height `[px]`.
    pub height: u32,
    /// Colours, background included, not clamped. Shape: `[height, width, 3]`.
    pub rgb: Vec<f32>,
    /// 1 − final transmittance, in `[0, 1]`. Shape: `[height, width]`.
    pub alpha: Vec<f32>,
    /// Σ α·T·z, where z is camera-space depth; the background adds nothing `[scene units]`. Shape: `[height, width]`.
    pub depth: Vec<f32>,
}

/// Panics unless camera and image have the same size.
fn assert_same_size(camera: &Camera, image: &Image8) {
    let [camera, image] = [[camera.width, camera.height], [image.width, image.height]];
    assert_eq!(camera, image, "camera and image differ in size");
}

/// Panics unless an edit plan fits the current rows and the budget, in release builds too, because the memory limit
/// depends on this check.
fn assert_fits(ops: &RowOps, rows: usize, budget: RowBudget) {
    assert_eq!(ops.first_row, budget.frozen, "a plan for another number of frozen rows");
    assert_eq!(ops.rows_before, rows, "a plan for another number of rows");
    assert_eq!(ops.budget, budget.total, "a plan for another budget");
    assert!(ops.rows_after <= budget.total, "{} rows over the budget", ops.rows_after);
    if let Err(broken) = ops.check() {
        panic!("an inconsistent plan: {broken}");
    }
}

/// A differentiable rasteriser with its optimiser, which holds the only copy of the model.
pub trait Backend: Send {
    /// Current number of rows.
    fn rows(&self) -> usize;

    /// Spherical-harmonic degree of the model.
    fn sh_degree(&self) -> u8;

    /// Antialiasing of the model, with which it is rendered and trained.
    fn antialiasing(&self) -> Antialiasing;

    /// The largest number of rows; all buffers have this size from the start.
    fn budget(&self) -> usize;

    /// The planned bytes of each buffer.
    fn ledger(&self) -> &Ledger;

    /// Starts a new epoch; the signal `WeightMax` is accumulated per epoch.
    fn begin_epoch(&mut self);

    /// Runs a forward pass, a backward pass and an optimiser step, and accumulates signals.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn train_step(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError>;

    /// Runs a forward and a backward pass and differentiates with respect to the camera's pose; requires a backend
    /// [set up](Setup::poses) for it. Model, optimiser and signals are unchanged.
    ///
    /// # Errors
    /// See [`BackendError`]; [`BackendError::Unsupported`] if the backend has no such derivatives.
    fn differentiate_pose(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        let _ = input;
        Err(BackendError::Unsupported("derivatives with respect to poses"))
    }

    /// Renders a view and takes the requested measurements. Model, optimiser and signals are unchanged.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn observe(&mut self, input: &AuxInput<'_>) -> Result<AuxOutput, BackendError>;

    /// Copies the requested signals to the host.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn take_signals(&mut self, wanted: SignalSet) -> Result<Signals, BackendError>;

    /// Hands signals back to the backend after they have been read. Their memory may belong to the backend, which
    /// must otherwise allocate it again.
    fn give_back(&mut self, signals: Signals) {
        drop(signals);
    }

    /// The candidates collected since the last reset.
    fn candidates(&self) -> &[Candidate];

    /// Executes the edit plan of iteration `step` in place, on parameters and all other arrays of rows.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When `ops` was made for another number of rows or another budget: a bug in the caller that would
    /// exceed the budget or corrupt the model.
    fn apply(&mut self, ops: &RowOps, seed: u64, step: u32) -> Result<(), BackendError>;

    /// Lists the rows with a non-finite parameter or moment, in order. Such rows are not rendered and affect
    /// nothing else until they are removed.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn audit(&mut self) -> Result<Vec<NonFinite>, BackendError>;

    /// Renders a view.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn render(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<Rendering, BackendError>;

    /// The backend's renderings for inspection.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`] if it has none.
    fn inspect(&mut self) -> Result<&mut dyn Inspect, BackendError> {
        Err(BackendError::Unsupported("inspection"))
    }

    /// Copies the model to the host.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn download(&self) -> Result<Gaussians, BackendError> {
        self.download_rows(0..self.rows())
    }

    /// Copies some rows of the model to the host.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When a row does not exist: a bug in the caller.
    fn download_rows(&self, rows: Range<usize>) -> Result<Gaussians, BackendError> {
        let array = |array| self.download_array(array, rows.clone());
        let model = Gaussians::from_arrays(self.sh_degree(), array)?;
        Ok(Gaussians { antialiasing: self.antialiasing(), ..model })
    }

    /// Copies some rows of one of the model's arrays to the host, row-major.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When a row does not exist: a bug in the caller.
    fn download_array(
        &self,
        array: ModelArray,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError>;

    /// Uploads an array that [`download_array`](Self::download_array) returned for the same rows.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When a row does not exist: a bug in the caller.
    fn upload_array(
        &mut self,
        array: ModelArray,
        rows: Range<usize>,
        values: &[f32],
    ) -> Result<(), BackendError>;

    /// The arrays that hold everything on which later steps depend, except the model: moments, ages, accumulated
    /// signals and so on.
    fn state(&self) -> Vec<StateArray>;

    /// Copies one array of [`state`](Self::state) to the host.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When the array does not exist: a bug in the caller.
    fn save(&self, name: &str) -> Result<Tensor, BackendError> {
        self.save_rows(name, 0..self.rows())
    }

    /// Copies some rows of an array to the host; an array that is not [by rows](StateArray::by_rows) is copied
    /// whole.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When the array or a row does not exist: a bug in the caller.
    fn save_rows(&self, name: &str, rows: Range<usize>) -> Result<Tensor, BackendError>;

    /// Restores an array that [`save`](Self::save) returned. The backend must be set up with the same options and with
    /// the [model](Self::download) of the same step. Once all arrays are restored, later steps are bit-identical.
    ///
    /// # Errors
    /// [`StateError`] when this backend has no such array, or one of another type or shape. The
    /// array may come from an untrusted file.
    fn restore(&mut self, tensor: Tensor) -> Result<(), StateError> {
        self.restore_rows(tensor, 0..self.rows())
    }

    /// Restores rows that [`save_rows`](Self::save_rows) returned for the same range.
    ///
    /// # Errors
    /// The errors of [`restore`](Self::restore).
    ///
    /// # Panics
    /// When a row does not exist: a bug in the caller.
    fn restore_rows(&mut self, tensor: Tensor, rows: Range<usize>) -> Result<(), StateError>;

    /// Wall time of each stage of the last step, in order. A stage that is executed several times may have several
    /// entries.
    fn stage_times(&self) -> &[(&'static str, Duration)];
}
