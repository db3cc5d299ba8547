//! The native backend: rayon over tiles and rows, SIMD with run-time dispatch, one file per stage.
//!
//! It is the default on machines without a GPU and the reference for the shaders. With the same inputs
//! and the same seed, results are byte-identical at any thread count: work is split at fixed places, and every
//! floating-point sum has a fixed order and is accumulated by one thread.
//!
//! All buffers are allocated once, at the size of the budget; the ledger lists them.

mod adam;
mod apply;
mod audit;
mod batch;
mod blended;
mod blocks;
mod budget;
mod candidates;
mod depth_channel;
mod depth_gradient;
mod differentiate;
mod exposure;
mod footprint;
mod instructions;
mod loss;
mod mask;
mod moments;
mod narrow;
mod observe;
mod optimise;
mod parameters;
mod passes;
mod project;
mod project_bwd;
mod rasterize;
mod rasterize_bwd;
mod records;
mod regularise;
mod replay;
mod signals;
mod simd;
mod stage_clock;
mod state;
mod summed;
mod surface;
mod threads;
mod tiles;
mod vignette;

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::AtomicU32;
use std::time::Duration;

use densify_policies::plan::RowOps;
use densify_policies::policy::{Candidate, SignalSet, Signals};
use densify_policies::rng::PolicyRng;
use pulp::Arch;

use super::candidates::{Candidates, Photograph, error_weights};
use super::signals::{Field, counts_dominant};
use super::{
    AuxInput, AuxOutput, Backend, BackendError, Inspect, NonFinite, Rendering, Setup, Shortcuts,
    StateArray, StateError, StepInput, StepOutput, SurfaceDepths, Tensor, assert_fits,
    assert_same_size,
};
pub(crate) use adam::BiasCorrection;
use blocks::{Blocks, planes};
use densify_core::antialiasing::Antialiasing;
use densify_core::budget::RowBudget;
use densify_core::camera::Camera;
use densify_core::gaussians::{Gaussians, ModelArray};
use densify_core::memory::Ledger;
use loss::{ErrorRequests, LossBuffers};
use mask::Masks;
use moments::Moments;
use parameters::Parameters;
#[cfg(feature = "gpu")]
pub(crate) use parameters::{MEANS, narrowed, widened};
use passes::{for_each_pixel, scalars};
use project::Splat;
use rasterize::{DepthPlane, TileCanvas};
use rasterize_bwd::TileGradient;
use signals::Accumulators;
use simd::WIDTH;
use stage_clock::StageClock;
use summed::GradientSums;
use threads::Threads;
use tiles::TileLists;

pub use instructions::{INSTRUCTIONS_VARIABLE, InstructionSet};
pub use optimise::ModelGradient;
pub use threads::StepTasks;
#[cfg(feature = "gpu")]
pub(crate) use {loss::SSIM_WEIGHT, project::EXPONENT_SCALE, project::ViewParams};

/// The largest side of an image `[px]` at which every index of the stages still fits its type.
pub(crate) const MAX_SIDE: u32 = 16_384;
/// Blocks per task: 128 rows, which have 100 kB of parameters and moments at degree 3. 50,000 rows give each of 64
/// threads six tasks.
const BLOCKS_PER_TASK: usize = 8;
const ROWS_PER_TASK: usize = BLOCKS_PER_TASK * WIDTH;

/// The native backend.
#[derive(Debug)]
pub struct CpuBackend {
    arch: Arch,
    threads: Arc<Threads>,
    ledger: Ledger,
    budget: RowBudget,
    rows: usize,
    sh_degree: u8,
    near: f32,
    antialiasing: Antialiasing,
    shortcuts: Shortcuts,
    params: Parameters,
    moments: Moments,
    /// Number of optimiser steps per row, in one plane; not stored for tasks that have only frozen rows.
    ages: Blocks<u16>,
    bias: BiasCorrection,
    summed: GradientSums,
    masks: Masks,
    signals: Accumulators,
    candidates: Candidates,
    /// Number of pixels of the current view in which each row has the largest blend weight. Shape: `[budget]`, or empty
    /// if they are not counted.
    dominant: Vec<AtomicU32>,
    /// Shape: `[budget]`.
    splats: Vec<Splat>,
    /// One bit per row, set if it is on screen in the current view. Shape: `[blocks of sixteen rows]`.
    visible: Vec<u16>,
    lists: TileLists,
    /// Shape: `[tiles]`.
    canvas: Vec<TileCanvas>,
    /// Shape: `[tiles]`.
    gradient: Vec<TileGradient>,
    loss: LossBuffers,
    /// One record per entry, a (row, tile) pair, up to the cap, as bits of f32. Shape: `[record cap, stride]`.
    records: Vec<AtomicU32>,
    record_cap: usize,
    /// The sum of each row's records. Between steps the memory is lent to the signals that a policy reads, for which
    /// it is large enough. Shape: `[budget, stride of the records]`, or more.
    sums: Vec<f32>,
    clock: StageClock,
}

impl CpuBackend {
    /// The bytes that a backend with these options allocates for models of this degree, on `threads` threads, whatever
    /// [`Setup::threads`] says.
    pub fn memory_plan(sh_degree: u8, options: &Setup, threads: usize) -> Ledger {
        budget::ledger(sh_degree, options, threads)
    }

    /// Copies `model` and allocates all buffers for `options.budget` rows.
    ///
    /// # Errors
    /// [`BackendError::OutOfMemory`] when the memory is not available; [`BackendError::Threads`].
    ///
    /// # Panics
    /// When the model has more rows than the budget: a bug in the caller, which must subsample.
    pub fn new(model: &Gaussians, options: &Setup) -> Result<Self, BackendError> {
        let budget = options.row_budget();
        let rows = budget.total;
        assert!(model.len() <= rows, "{} rows over a budget of {rows}", model.len());
        let threads = Threads::new(options.threads)?;
        let ledger = budget::ledger(model.sh_degree, options, threads.count());
        budget::reserve(&ledger)?;
        let trained = budget::trained(options);
        let signals = Accumulators::new(trained.clone(), &options.needs, options.depth);
        let (stride, sum_width) = (signals.layout().stride(), signals.sum_width());
        let (cap, record_cap) = (budget::tile_cap(options), budget::record_cap(options));
        let per_row = planes(model.sh_degree);
        let storage = options.storage;
        let mut params = Parameters::zeros(rows, per_row, storage.parameters);
        params.pack(model);
        let counted = if counts_dominant(&options.needs) { rows } else { 0 };
        Ok(Self {
            arch: options.instructions.arch(),
            threads: Arc::new(threads),
            ledger,
            budget,
            rows: model.len(),
            sh_degree: model.sh_degree,
            near: options.near,
            antialiasing: model.antialiasing,
            shortcuts: options.shortcuts,
            params,
            moments: Moments::zeros(trained.clone(), per_row, storage.moments),
            ages: Blocks::zeros(trained.clone(), 1),
            bias: BiasCorrection::new(),
            summed: GradientSums::new(trained.clone(), per_row, options.needs.cadence),
            masks: Masks::new(trained, options.needs.mask),
            signals,
            candidates: Candidates::new(options.needs.candidates),
            dominant: bytemuck::zeroed_vec(counted),
            splats: vec![Splat::default(); rows],
            visible: vec![0; rows.div_ceil(WIDTH)],
            lists: TileLists::new(rows, cap),
            canvas: Vec::new(),
            gradient: Vec::new(),
            loss: LossBuffers::new(options.needs.pixel_loss),
            records: bytemuck::zeroed_vec(record_cap * stride),
            record_cap,
            sums: vec![0.0; budget::summed_rows(options) * sum_width],
            clock: StageClock::default(),
        })
    }

    /// Starts recording the durations of the tasks of training steps. Tasks are recorded on one thread only, because
    /// several threads would slow each other down.
    ///
    /// # Panics
    /// When the backend has more than one thread.
    pub fn record_tasks(&mut self) {
        self.threads.start_recording();
    }

    /// The tasks of the last training step; empty unless they are [recorded](Self::record_tasks).
    pub fn recorded_tasks(&self) -> StepTasks {
        self.threads.recorded()
    }

    /// Runs a training step on a thread of the pool; unless it `trains`, only the pose is differentiated.
    fn step(&mut self, input: &StepInput<'_>, trains: bool) -> Result<StepOutput, BackendError> {
        let StepInput { camera, target, background, exposure, vignette, .. } = *input;
        let unexposed = exposure.map_or(background, |exposure| exposure.behind(background));
        let (depth, plane) = self.depth_loss(input);
        let frame = self.forward(camera, unexposed, input.sh_degree, plane, None)?;
        if let Some(exposure) = exposure {
            self.expose(&frame.grid, exposure);
        }
        if let Some(vignette) = vignette {
            self.dim(&frame.grid, vignette, target);
        }
        let picks = trains.then(|| self.candidates.due(input.step, self.rows)).flatten();
        let weights = picks.and_then(|(request, _)| error_weights(request.error));
        let for_rows = self.signals.layout().has(Field::Error).then_some(self.signals.planes.score);
        let errors = ErrorRequests { for_candidates: weights, for_rows };
        let value = self.image_loss(&frame.grid, target, background, errors);
        let vignette_gradient =
            vignette.map(|vignette| self.dim_bwd(&frame.grid, vignette, target));
        let exposure_gradient =
            exposure.map(|exposure| self.exposure_bwd(&frame.grid, exposure, background));
        if let Some((request, count)) = picks {
            let photograph = Photograph::from(input);
            self.collect_candidates(&frame, photograph, &request, count);
        }
        let (layout, depth) = self.backward_with_depth(&frame, depth);
        let pose = if trains {
            self.optimise(&frame, input, layout)
        } else {
            Some(self.pose_gradient(&frame, layout))
        };
        self.clock.lap("project_bwd + adam");
        Ok(StepOutput {
            visible: frame.visible,
            entries: frame.entries,
            bands: frame.bands.len() as u32,
            exposure: exposure_gradient,
            pose,
            vignette: vignette_gradient,
            depth,
            ..scalars(value)
        })
    }
}

impl Backend for CpuBackend {
    fn rows(&self) -> usize {
        self.rows
    }

    fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    fn antialiasing(&self) -> Antialiasing {
        self.antialiasing
    }

    fn budget(&self) -> usize {
        self.budget.total
    }

    fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    fn begin_epoch(&mut self) {
        self.signals.begin_epoch(&self.threads, self.rows);
    }

    fn train_step(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        assert_same_size(input.camera, input.target);
        let threads = Arc::clone(&self.threads);
        threads.step(|| self.step(input, true))
    }

    fn differentiate_pose(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        assert_same_size(input.camera, input.target);
        let threads = Arc::clone(&self.threads);
        threads.step(|| self.step(input, false))
    }

    fn observe(&mut self, input: &AuxInput<'_>) -> Result<AuxOutput, BackendError> {
        self.observe_view(input)
    }

    fn take_signals(&mut self, wanted: SignalSet) -> Result<Signals, BackendError> {
        // The memory of the summed records is unused between steps.
        let memory = std::mem::take(&mut self.sums);
        let mut signals = Signals::zeros_in(memory, self.rows, wanted);
        let of_rows = (&self.params, &self.masks, &self.ages);
        self.signals.read(&self.threads, &mut signals, wanted, of_rows);
        Ok(signals)
    }

    fn give_back(&mut self, signals: Signals) {
        if self.sums.is_empty() {
            self.sums = signals.into_values();
        }
    }

    fn candidates(&self) -> &[Candidate] {
        &self.candidates.list
    }

    fn apply(&mut self, ops: &RowOps, seed: u64, step: u32) -> Result<(), BackendError> {
        assert_fits(ops, self.rows, self.budget);
        let mut model = apply::Model {
            params: &mut self.params,
            moments: &mut self.moments,
            ages: &mut self.ages,
            masks: &mut self.masks,
            signals: &mut self.signals,
            summed: &mut self.summed,
            threads: &self.threads,
        };
        apply::apply(&mut model, ops, &PolicyRng::new(seed, step));
        self.rows = ops.rows_after;
        if ops.reset_candidates {
            self.candidates.list.clear();
        }
        Ok(())
    }

    fn audit(&mut self) -> Result<Vec<NonFinite>, BackendError> {
        Ok(self.find_non_finite())
    }

    fn render(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<Rendering, BackendError> {
        let frame = self.forward(camera, background, sh_degree, DepthPlane::Depth, None)?;
        Ok(self.rendering(&frame))
    }

    fn inspect(&mut self) -> Result<&mut dyn Inspect, BackendError> {
        Ok(self)
    }

    fn download_array(
        &self,
        array: ModelArray,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError> {
        assert!(rows.end <= self.rows, "rows {rows:?} of {}", self.rows);
        Ok(self.params.to_rows(rows, array.parameters(self.sh_degree)))
    }

    fn upload_array(
        &mut self,
        array: ModelArray,
        rows: Range<usize>,
        values: &[f32],
    ) -> Result<(), BackendError> {
        assert!(rows.end <= self.rows, "rows {rows:?} of {}", self.rows);
        self.params.set_rows(rows, array.parameters(self.sh_degree), values);
        Ok(())
    }

    fn state(&self) -> Vec<StateArray> {
        self.state_arrays()
    }

    fn save_rows(&self, name: &str, rows: Range<usize>) -> Result<Tensor, BackendError> {
        assert!(rows.end <= self.rows, "rows {rows:?} of {}", self.rows);
        Ok(self.state_tensor(name, rows))
    }

    fn restore_rows(&mut self, tensor: Tensor, rows: Range<usize>) -> Result<(), StateError> {
        assert!(rows.end <= self.rows, "rows {rows:?} of {}", self.rows);
        self.restore_tensor(tensor, rows)
    }

    fn stage_times(&self) -> &[(&'static str, Duration)] {
        &self.clock.laps
    }
}

impl Inspect for CpuBackend {
    fn render_painted(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        colours: &[[f32; 3]],
    ) -> Result<Rendering, BackendError> {
        assert_eq!(colours.len(), self.rows, "one colour per row");
        let frame = self.forward(camera, background, 0, DepthPlane::Depth, Some(colours))?;
        Ok(self.rendering(&frame))
    }

    fn counts_rows(&self) -> bool {
        true
    }

    fn render_counts(&mut self, camera: &Camera) -> Result<Rendering, BackendError> {
        let frame = self.forward(camera, [0.0; 3], 0, DepthPlane::BlendedCount, None)?;
        Ok(self.rendering(&frame))
    }

    fn render_depths(&mut self, camera: &Camera) -> Result<SurfaceDepths, BackendError> {
        self.depths_of_view(camera)
    }
}
