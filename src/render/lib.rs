//! What a renderer-and-optimiser does for the trainer, whatever it runs on.
//!
//! Data flows one way: a view goes in, a step is taken on the device, a few scalars come back.
//! Signals come down when a policy is due, row operations go up; parameters stay where they are. One piece: the trait
//! with what goes in and comes out of it.

mod adapter;
mod audit;
mod candidates;
mod choice;
pub mod cpu;
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
pub use audit::{Attribute, Kept, Unsound};
pub use choice::{BackendChoice, BackendKind, Device};
use densify_core::camera::Camera;
use densify_core::colour::{ColourGradient, ColourTransform};
use densify_core::gaussians::{Gaussians, ModelArray};
use densify_core::image::Image8;
use densify_core::memory::Ledger;
pub use densify_shaders::Accumulation;
pub use differentiable::{Differentiable, ImageGradient};
pub use error::{BackendError, Fit};
pub use inspect::Inspect;
pub use setup::{KeptPhotographs, MomentStorage, ParameterStorage, Setup, Shortcuts, Storage};
pub use state::{StateArray, StateError, Tensor, Values};

/// Step sizes of one iteration, one per parameter class.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearningRates {
    /// Means `[scene units per step]`.
    pub mean: f32,
    /// Means, without the [boost](densify_train::schedule::RateOptions::boost) of short runs: what noise is
    /// proportional to `[scene units per step]`.
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

impl LearningRates {
    /// Steps of length zero: the model stays as it is, and signals are measured all the same.
    pub const STILL: Self = Self {
        mean: 0.0,
        noise: 0.0,
        log_scale: 0.0,
        quat: 0.0,
        opacity: 0.0,
        sh_dc: 0.0,
        sh_rest: 0.0,
    };
}

/// One training step: what to render, what it should look like, how far to go.
#[derive(Debug, Clone, Copy)]
pub struct StepInput<'a> {
    /// Iteration, 1-based.
    pub step: u32,
    /// The view's number; a view has one image, which a backend may keep.
    pub view: usize,
    /// The view's camera.
    pub camera: &'a Camera,
    /// The view's image, of the camera's size.
    pub target: &'a Image8,
    /// Background colour, sRGB-encoded in `[0, 1]`; a target with alpha is composited on it too.
    pub background: [f32; 3],
    /// How the image was exposed, in a backend [made](Setup::exposures) for it: the loss sees the rendering
    /// so transformed, but for the background.
    pub exposure: Option<&'a ColourTransform>,
    /// Spherical-harmonic degree evaluated and trained now, <= the model's.
    pub sh_degree: u8,
    /// Step sizes.
    pub rates: LearningRates,
    /// Terms added to the loss.
    pub loss_terms: LossTerms,
    /// Noise on the means.
    pub noise: Option<NoiseTerm>,
    /// How often the optimiser steps, no longer than the backend was made for.
    pub cadence: Cadence,
    /// Seed of the run, for noise on the means.
    pub seed: u64,
}

/// A training view to be measured for a policy's event.
#[derive(Debug, Clone, Copy)]
pub struct AuxInput<'a> {
    /// Iteration just finished, 1-based.
    pub step: u32,
    /// The view's number, for random draws.
    pub view: usize,
    /// Seed of the run, for random draws.
    pub seed: u64,
    /// The view's camera.
    pub camera: &'a Camera,
    /// The view's image, of the camera's size.
    pub target: &'a Image8,
    /// Background colour, sRGB-encoded in `[0, 1]`.
    pub background: [f32; 3],
    /// As [`StepInput::exposure`].
    pub exposure: Option<&'a ColourTransform>,
    /// Spherical-harmonic degree evaluated now, <= the model's.
    pub sh_degree: u8,
    /// What to measure.
    pub request: &'a AuxRequest,
}

/// What was measured in a view.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AuxOutput {
    /// 0.8·L1 + 0.2·(1 − SSIM).
    pub loss: f32,
    /// The columns asked for, in their order. Shape of each: `[rows]`.
    pub columns: Vec<(AuxColumn, Vec<f32>)>,
    /// Surface points; their error is the pixel's alpha.
    pub points: Vec<Candidate>,
}

/// The scalars of one training step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StepOutput {
    /// 0.8·L1 + 0.2·(1 − SSIM), without the terms that a policy adds; L1 where SSIM is left out.
    pub loss: f32,
    /// Mean over pixels and channels of |I − G|.
    pub l1: f32,
    /// Mean structural similarity.
    pub ssim: f32,
    /// Rows whose projection is on screen.
    pub visible: usize,
    /// (row, tile) pairs rendered.
    pub entries: u64,
    /// Passes in which the tile lists were processed; 1 unless the cap made it more.
    pub bands: u32,
    /// Derivatives of the loss by the exposure, where there is one.
    pub exposure: Option<ColourGradient>,
}

/// A rendered view.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendering {
    /// Width `[px]`.
    pub width: u32,
    /// Height `[px]`.
    pub height: u32,
    /// Background included, not clamped. Shape: `[height, width, 3]`.
    pub rgb: Vec<f32>,
    /// 1 − final transmittance, in `[0, 1]`. Shape: `[height, width]`.
    pub alpha: Vec<f32>,
    /// Σ α·T·z, camera z `[scene units]`, without a background term. Shape: `[height, width]`.
    pub depth: Vec<f32>,
}

/// Panics unless they have the same size.
fn assert_same_size(camera: &Camera, image: &Image8) {
    let [camera, image] = [[camera.width, camera.height], [image.width, image.height]];
    assert_eq!(camera, image, "camera and image differ in size");
}

/// Panics unless a plan fits the rows; in release builds too, as this is the promise.
fn assert_fits(ops: &RowOps, frozen: usize, rows: usize, budget: usize) {
    assert_eq!(ops.first_row, frozen, "a plan for another number of frozen rows");
    assert_eq!(ops.rows_before, rows, "a plan for another number of rows");
    assert_eq!(ops.budget, budget, "a plan for another budget");
    assert!(ops.rows_after <= budget, "{} rows over the budget", ops.rows_after);
    if let Err(broken) = ops.check() {
        panic!("a plan that breaks its own rules: {broken}");
    }
}

/// A differentiable rasteriser with its optimiser and the model's only copy.
pub trait Backend: Send {
    /// Rows now.
    fn rows(&self) -> usize;

    /// Spherical-harmonic degree of the model.
    fn sh_degree(&self) -> u8;

    /// Most rows there may ever be; all buffers have this size from the start.
    fn budget(&self) -> usize;

    /// Bytes per buffer, as promised and at their peak.
    fn ledger(&self) -> &Ledger;

    /// Says that a new epoch begins (`WeightMax` is kept by epoch).
    fn begin_epoch(&mut self);

    /// One forward pass, backward pass and optimiser step; accumulates signals.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn train_step(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError>;

    /// Renders a view as the model is now and measures what is asked for. Changes nothing of the
    /// model, of the optimiser, or of the signals.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn observe(&mut self, input: &AuxInput<'_>) -> Result<AuxOutput, BackendError>;

    /// Copies these signals to the host.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn take_signals(&mut self, wanted: SignalSet) -> Result<Signals, BackendError>;

    /// Takes back the signals when they have been read: a backend may have lent memory of its own for
    /// them, which it has to allocate anew otherwise.
    fn give_back(&mut self, signals: Signals) {
        drop(signals);
    }

    /// The candidates collected since their last reset.
    fn candidates(&self) -> &[Candidate];

    /// Executes a plan of iteration `step`: parameters, moments and age in place.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When `ops` was made for another number of rows or another budget: that is a bug in the
    /// caller, and going on would exceed the budget or corrupt the model.
    fn apply(&mut self, ops: &RowOps, seed: u64, step: u32) -> Result<(), BackendError>;

    /// The rows with a parameter or a moment that is NaN or infinite, in order. Until they are
    /// removed they are not rendered, and nothing else depends on them.
    ///
    /// # Errors
    /// See [`BackendError`].
    fn audit(&mut self) -> Result<Vec<Unsound>, BackendError>;

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

    /// The renderings for inspection; an error if the backend has none.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`].
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
    /// When there are no such rows: a bug in the caller.
    fn download_rows(&self, rows: Range<usize>) -> Result<Gaussians, BackendError> {
        let array = |array| self.download_array(array, rows.clone());
        Gaussians::from_arrays(self.sh_degree(), array)
    }

    /// Copies some rows of one of the model's arrays to the host, row after row.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When there are no such rows: a bug in the caller.
    fn download_array(
        &self,
        array: ModelArray,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError>;

    /// Takes back what [`download_array`](Self::download_array) returned for the same rows.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When there are no such rows: a bug in the caller.
    fn upload_array(
        &mut self,
        array: ModelArray,
        rows: Range<usize>,
        values: &[f32],
    ) -> Result<(), BackendError>;

    /// The arrays that hold, beside the model, all that the future depends on: moments, ages,
    /// accumulated signals, and whatever else outlives a step. See [`Tensor`] for their order.
    fn state(&self) -> Vec<StateArray>;

    /// Copies one array of [`state`](Self::state) to the host.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When there is no such array: a bug in the caller.
    fn save(&self, name: &str) -> Result<Tensor, BackendError> {
        self.save_rows(name, 0..self.rows())
    }

    /// Copies some rows of an array to the host; one that is not [by rows](StateArray::by_rows) is whole,
    /// whatever the rows.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When there is no such array, or there are no such rows: a bug in the caller.
    fn save_rows(&self, name: &str, rows: Range<usize>) -> Result<Tensor, BackendError>;

    /// Takes back what [`save`](Self::save) returned, into a backend made with the same options for
    /// the [model](Self::download) of that moment. When all arrays are back, the future is the same
    /// to the bit.
    ///
    /// # Errors
    /// [`StateError`] when this backend has no such array, or one of another type or shape. The
    /// array may come from a file that cannot be trusted.
    fn restore(&mut self, tensor: Tensor) -> Result<(), StateError> {
        self.restore_rows(tensor, 0..self.rows())
    }

    /// Takes back what [`save_rows`](Self::save_rows) returned for the same rows.
    ///
    /// # Errors
    /// As [`restore`](Self::restore).
    ///
    /// # Panics
    /// When there are no such rows: a bug in the caller.
    fn restore_rows(&mut self, tensor: Tensor, rows: Range<usize>) -> Result<(), StateError>;

    /// Wall time of each stage of the last step, in order; a stage that ran more than once stands
    /// there as often.
    fn stage_times(&self) -> &[(&'static str, Duration)];
}
