//! The native backend: rayon over tiles and rows, SIMD with run-time dispatch, one file per stage.
//!
//! It is the default on machines without a GPU and the reference for the shaders. The same inputs
//! and the same seed give the same bytes at any thread count: work is cut at fixed places, every
//! sum has a fixed order, and nothing is accumulated from two threads.
//!
//! All buffers are allocated once, at the budget; the ledger lists them.

mod adam;
mod apply;
mod blocks;
mod candidates;
mod fresh;
mod loss;
mod optimise;
mod project;
mod project_bwd;
mod rasterize;
mod rasterize_bwd;
mod signals;
mod simd;
mod tiles;

use std::ops::Range;
use std::sync::atomic::AtomicU32;
use std::time::{Duration, Instant};

use densify_policies::plan::RowOps;
use densify_policies::policy::{Candidate, CandidateRequest, ErrorMode, Needs, Signals};
use densify_policies::rng::PolicyRng;
use pulp::Arch;
use rayon::prelude::*;

use super::{Backend, BackendError, Rendering, StepInput, StepOutput};
use crate::camera::Camera;
use crate::dataset::images::Image8;
use crate::gaussians::Gaussians;
use crate::memory::Ledger;
use adam::BiasCorrection;
use blocks::{Blocks, planes};
use candidates::Candidates;
use loss::{LossBuffers, LossValue};
use optimise::{Differentiate, Optimise};
use project::{Project, Splat, ViewParams};
use rasterize::{CANVAS_PLANES, DARK, DEPTH, Rasterize, TRANSMITTANCE, TileCanvas, TilePlace};
use rasterize_bwd::{Detail, RasterizeBwd, TileGradient, gather};
use signals::Accumulators;
use simd::WIDTH;
use tiles::{Grid, TILE, TileLists, Visible};

pub use optimise::ModelGradient;

/// Largest image side [y][x]; at this size every index of the stages still fits its type.
const MAX_SIDE: u32 = 16_384;
/// Blocks per task: 256 rows, about a megabyte of parameters and moments at degree 3.
const BLOCKS_PER_TASK: usize = 16;
const ROWS_PER_TASK: usize = BLOCKS_PER_TASK * WIDTH;

/// How to set up a [`CpuBackend`].
#[derive(Debug, Clone)]
pub struct CpuOptions {
    /// Most rows there may ever be, >= 1 and >= the model's.
    pub budget: usize,
    /// Near plane [scene units], > 0: rows nearer to the camera are not rendered.
    pub near: f32,
    /// Most (row, tile) entries held at a time; beyond it the image is processed in bands.
    /// At least one tile's list must fit, so it is raised to the budget.
    pub tile_cap: usize,
    /// Worker threads; `None` takes all cores.
    pub threads: Option<usize>,
    /// Largest image that will be rendered (width, height) [px]. Larger ones still work, with more
    /// memory than the ledger says.
    pub largest_image: (u32, u32),
    /// Signals and candidates to collect.
    pub needs: Needs,
}

impl CpuOptions {
    /// Options for models of at most `budget` rows: entries for sixteen tiles per row.
    #[must_use]
    pub fn new(budget: usize) -> Self {
        Self {
            budget,
            near: 0.01,
            tile_cap: budget.saturating_mul(16),
            threads: None,
            largest_image: (0, 0),
            needs: Needs::default(),
        }
    }
}

/// dL/dpixel for [`CpuBackend::differentiate`].
#[derive(Debug, Clone, PartialEq)]
pub struct ImageGradient {
    /// Shape: [height, width, 3].
    pub rgb: Vec<f32>,
    /// Shape: [height, width].
    pub alpha: Vec<f32>,
    /// Shape: [height, width].
    pub depth: Vec<f32>,
}

/// The native backend.
#[derive(Debug)]
pub struct CpuBackend {
    arch: Arch,
    pool: rayon::ThreadPool,
    ledger: Ledger,
    budget: usize,
    rows: usize,
    sh_degree: u8,
    near: f32,
    params: Blocks,
    moments: [Blocks; 2],
    ages: Vec<u16>,
    bias: BiasCorrection,
    signals: Accumulators,
    candidates: Candidates,
    /// Shape: [budget].
    splats: Vec<Splat>,
    /// Bit per lane: on screen in the view at hand. Shape: [blocks].
    visible: Vec<u16>,
    lists: TileLists,
    /// Shape: [tiles].
    canvas: Vec<TileCanvas>,
    /// Shape: [tiles].
    gradient: Vec<TileGradient>,
    loss: LossBuffers,
    /// Bits of one record per slot. Shape: [tile cap, stride of the signals' detail].
    records: Vec<AtomicU32>,
    /// One record per row. Shape: [budget, stride of the signals' detail].
    sums: Vec<f32>,
    clock: StageClock,
}

/// Wall time of the stages of the last step.
#[derive(Debug, Default)]
struct StageClock {
    laps: Vec<(&'static str, Duration)>,
    last: Option<Instant>,
}

impl StageClock {
    fn start(&mut self) {
        self.laps.clear();
        self.last = Some(Instant::now());
    }

    fn lap(&mut self, stage: &'static str) {
        let now = Instant::now();
        if let Some(last) = self.last.replace(now) {
            self.laps.push((stage, now - last));
        }
    }
}

/// One view between its forward and its backward pass.
struct Frame {
    view: ViewParams,
    grid: Grid,
    background: [f32; 3],
    bands: Vec<Range<usize>>,
    entries: u64,
    visible: usize,
}

impl CpuBackend {
    /// Takes over `model` and allocates everything for `options.budget` rows.
    ///
    /// # Errors
    /// [`BackendError::OutOfMemory`] when the memory cannot be had.
    ///
    /// # Panics
    /// When the model has more rows than the budget: the caller subsamples before.
    pub fn new(model: &Gaussians, options: &CpuOptions) -> Result<Self, BackendError> {
        let budget = options.budget.max(1);
        assert!(model.len() <= budget, "{} rows over a budget of {budget}", model.len());
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(options.threads.unwrap_or(0))
            .thread_name(|i| format!("densify-{i}"))
            .build()
            .map_err(|error| BackendError::Threads(error.to_string()))?;
        let ledger = ledger(model.sh_degree, options, pool.current_num_threads());
        reserve(&ledger)?;
        let signals = Accumulators::new(budget, options.needs.signals);
        let stride = signals.detail().stride();
        let cap = tile_cap(options);
        let blocks = budget.div_ceil(WIDTH);
        let per_row = planes(model.sh_degree);
        let mut params = Blocks::zeros(budget, per_row);
        params.pack(model);
        Ok(Self {
            arch: Arch::new(),
            pool,
            ledger,
            budget,
            rows: model.len(),
            sh_degree: model.sh_degree,
            near: options.near,
            params,
            moments: [Blocks::zeros(budget, per_row), Blocks::zeros(budget, per_row)],
            ages: vec![0; blocks * WIDTH],
            bias: BiasCorrection::new(),
            signals,
            candidates: Candidates::new(options.needs.candidates),
            splats: vec![Splat::default(); budget],
            visible: vec![0; blocks],
            lists: TileLists::new(budget, cap),
            canvas: Vec::new(),
            gradient: Vec::new(),
            loss: LossBuffers::new(),
            records: atomic_zeros(cap * stride),
            sums: vec![0.0; blocks * WIDTH * stride],
            clock: StageClock::default(),
        })
    }

    /// Wall time of each stage of the last training step, in order. Bands add up under one name
    /// only as far as they follow one another.
    #[must_use]
    pub fn stage_times(&self) -> &[(&'static str, Duration)] {
        &self.clock.laps
    }

    /// Renders a view and differentiates Σ rgb·upstream.rgb + Σ alpha·upstream.alpha +
    /// Σ depth·upstream.depth with respect to every parameter. Changes nothing of the model.
    ///
    /// Needs records of full detail, so that it allocates more than the ledger says where the
    /// policy's needs are smaller: it is a tool for tests and for research, not part of training.
    ///
    /// # Errors
    /// [`BackendError::ImageTooLarge`].
    ///
    /// # Panics
    /// When `upstream` does not have the image's size.
    pub fn differentiate(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        upstream: &ImageGradient,
    ) -> Result<(Rendering, ModelGradient), BackendError> {
        let pixels = camera.width as usize * camera.height as usize;
        assert_eq!(upstream.rgb.len(), 3 * pixels, "upstream.rgb");
        assert_eq!(upstream.alpha.len(), pixels, "upstream.alpha");
        assert_eq!(upstream.depth.len(), pixels, "upstream.depth");
        let detail = Detail::All;
        let records = self.lists.cap() * detail.stride();
        if self.records.len() < records {
            self.records = atomic_zeros(records);
        }
        self.sums.resize(self.visible.len() * WIDTH * detail.stride(), 0.0);
        let frame = self.forward(camera, background, sh_degree, true)?;
        let rendering = self.rendering(&frame);
        for (tile, gradient) in self.gradient.iter_mut().enumerate() {
            gradient.planes = [DARK; 5];
            for_each_pixel(&frame.grid, tile, |y, x, at| {
                for channel in 0..3 {
                    gradient.planes[channel][y][x] = upstream.rgb[3 * at + channel];
                }
                gradient.planes[3][y][x] = upstream.alpha[at];
                gradient.planes[4][y][x] = upstream.depth[at];
            });
        }
        self.backward(&frame, detail);
        let mut gradient = ModelGradient::zeros(self.rows, self.sh_degree);
        self.arch.dispatch(Differentiate {
            params: self.params.of_rows(self.rows),
            stride: self.params.stride(),
            sums: &self.sums,
            visible: &self.visible,
            view: &frame.view,
            out: &mut gradient,
        });
        Ok((rendering, gradient))
    }

    /// The training loss of a rendering against a target and its gradient by the rendering's
    /// pixels. Shape of the gradient: [height, width, 3].
    ///
    /// # Panics
    /// When rendering and target differ in size.
    pub fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> (StepOutput, Vec<f32>) {
        assert_eq!(
            (rendering.width, rendering.height),
            (target.width, target.height),
            "rendering and target differ in size"
        );
        let grid = Grid::new(rendering.width, rendering.height);
        self.resize_images(&grid);
        for (tile, canvas) in self.canvas.iter_mut().enumerate() {
            for_each_pixel(&grid, tile, |y, x, at| {
                for channel in 0..3 {
                    canvas.planes[channel][y][x] = rendering.rgb[3 * at + channel];
                }
            });
        }
        let value = self.image_loss(&grid, target, background, None);
        let mut gradient = vec![0.0; rendering.rgb.len()];
        for (tile, from) in self.gradient.iter().enumerate() {
            for_each_pixel(&grid, tile, |y, x, at| {
                for channel in 0..3 {
                    gradient[3 * at + channel] = from.planes[channel][y][x];
                }
            });
        }
        (scalars(value), gradient)
    }

    fn resize_images(&mut self, grid: &Grid) {
        self.canvas.resize(grid.tiles(), TileCanvas::EMPTY);
        self.gradient.resize(grid.tiles(), TileGradient { planes: [DARK; 5] });
    }

    fn image_loss(
        &mut self,
        grid: &Grid,
        target: &Image8,
        background: [f32; 3],
        error_weights: Option<[f32; 2]>,
    ) -> LossValue {
        let Self { pool, loss, arch, canvas, gradient, clock, .. } = self;
        let value = pool
            .install(|| loss.run(*arch, grid, canvas, target, background, gradient, error_weights));
        clock.lap("loss");
        value
    }

    /// Stages 1–3. Afterwards the canvas holds the image and, if there is one band only, the
    /// lists hold its entries.
    fn forward(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        with_depth: bool,
    ) -> Result<Frame, BackendError> {
        if camera.width > MAX_SIDE || camera.height > MAX_SIDE {
            return Err(BackendError::ImageTooLarge {
                width: camera.width,
                height: camera.height,
                max: MAX_SIDE,
            });
        }
        let grid = Grid::new(camera.width, camera.height);
        self.resize_images(&grid);
        let view = ViewParams::new(camera, self.near, sh_degree.min(self.sh_degree));
        let Self { pool, arch, lists, splats, visible: seen, params, canvas, rows, clock, .. } =
            self;
        clock.start();
        let (rows, arch) = (*rows, *arch);
        let stride = params.stride();
        pool.install(|| {
            (
                params.of_rows(rows).par_chunks(stride * BLOCKS_PER_TASK),
                splats[..rows].par_chunks_mut(ROWS_PER_TASK),
                seen.par_chunks_mut(BLOCKS_PER_TASK),
            )
                .into_par_iter()
                .for_each(|(params, splats, seen)| {
                    let rows = splats.len();
                    arch.dispatch(Project { view: &view, params, stride, rows, splats, seen });
                });
            clock.lap("project");
            let visible = Visible { splats: &splats[..rows], seen };
            let (bands, entries) = lists.bands(visible, &grid);
            for band in &bands {
                lists.fill(visible, &grid, band.clone(), bands.len() == 1);
                clock.lap("tiles");
                let tiles = canvas[band.clone()].par_iter_mut().enumerate();
                tiles.for_each_init(Vec::new, |scratch, (i, canvas)| {
                    lists.sort(i, scratch);
                    arch.dispatch(Rasterize {
                        splats,
                        list: lists.of_tile(i),
                        place: TilePlace::new(&grid, band.start + i),
                        background,
                        with_depth,
                        canvas,
                    });
                });
                clock.lap("rasterize");
            }
            let visible =
                seen[..rows.div_ceil(WIDTH)].iter().map(|s| s.count_ones() as usize).sum();
            Ok(Frame { view, grid, background, bands, entries, visible })
        })
    }

    /// Stage 5: from `self.gradient` to one record per row in `self.sums`.
    fn backward(&mut self, frame: &Frame, detail: Detail) {
        let Frame { grid, background, bands, .. } = frame;
        let Self {
            pool,
            arch,
            lists,
            splats,
            records,
            sums,
            visible,
            canvas,
            gradient,
            clock,
            rows,
            ..
        } = self;
        let stride = detail.stride();
        pool.install(|| {
            for band in bands {
                if bands.len() > 1 {
                    lists.refill(Visible { splats: &splats[..*rows], seen: visible }, grid, band);
                }
                (0..band.len()).into_par_iter().for_each(|i| {
                    let tile = band.start + i;
                    let [r, g, b, alpha, depth] = &gradient[tile].planes;
                    arch.dispatch(RasterizeBwd {
                        splats,
                        list: lists.of_tile(i),
                        place: TilePlace::new(grid, tile),
                        background: *background,
                        canvas: &canvas[tile],
                        upstream: [r, g, b],
                        upstream_more: (detail == Detail::All).then_some([alpha, depth]),
                        detail,
                        records,
                    });
                });
                clock.lap("rasterize_bwd");
                let first = band.start == 0;
                let records = &records[..];
                sums.par_chunks_mut(stride * WIDTH).zip(&visible[..]).enumerate().for_each(
                    |(block, (sums, &seen))| {
                        for (lane, sum) in sums.chunks_exact_mut(stride).enumerate() {
                            if first {
                                sum.fill(0.0);
                            }
                            if seen >> lane & 1 == 1 {
                                let slots = lists.slots_of_row(block * WIDTH + lane);
                                let mine = &records[slots.start * stride..slots.end * stride];
                                gather(sum, detail, mine);
                            }
                        }
                    },
                );
                clock.lap("gather");
            }
        });
    }

    /// Adds the worst pixels of the view to the candidates.
    fn collect_candidates(
        &mut self,
        frame: &Frame,
        target: &Image8,
        request: &CandidateRequest,
        count: usize,
    ) {
        let Frame { grid, bands, background, view, .. } = frame;
        let Self { lists, splats, params, canvas, gradient, loss, candidates, visible, .. } = self;
        let visible = Visible { splats: &splats[..self.rows], seen: visible };
        let place = |x: usize, y: usize| (y / TILE * grid.columns + x / TILE, y % TILE, x % TILE);
        let error = |x: usize, y: usize| {
            let (tile, y_in, x_in) = place(x, y);
            let alpha = 1.0 - canvas[tile].planes[TRANSMITTANCE][y_in][x_in];
            (alpha >= request.min_alpha).then(|| match request.error {
                ErrorMode::Gradient => {
                    let g = |channel: usize| gradient[tile].planes[channel][y_in][x_in];
                    (g(0) * g(0) + g(1) * g(1) + g(2) * g(2)).sqrt()
                }
                ErrorMode::L1 | ErrorMode::L1Dssim => loss.error_at(x, y),
            })
        };
        let worst = candidates.worst(grid.width, grid.height, count, request.spaced, error);
        let focal = 0.5 * (view.focal[0] + view.focal[1]);
        for band in bands {
            let here = |&&(x, y, _): &&(usize, usize, f32)| band.contains(&place(x, y).0);
            if worst.iter().find(here).is_some() && bands.len() > 1 {
                lists.refill(visible, grid, band);
            }
            for &(x, y, error) in worst.iter().filter(here) {
                let at = [x as f32 + 0.5, y as f32 + 0.5];
                let list = lists.of_tile(place(x, y).0 - band.start);
                let surface = candidates::surface_row(splats, list, at, request.depth)
                    .and_then(|row| candidates::closest_approach(params, row, view, at));
                if let Some((position, depth)) = surface {
                    candidates.push(Candidate {
                        position: position.to_array(),
                        colour: target.composited(x, y, *background),
                        pixel_size: depth / focal,
                        error,
                    });
                }
            }
        }
    }

    fn rendering(&self, frame: &Frame) -> Rendering {
        let grid = &frame.grid;
        let pixels = grid.width * grid.height;
        let mut out = Rendering {
            width: grid.width as u32,
            height: grid.height as u32,
            rgb: vec![0.0; 3 * pixels],
            alpha: vec![0.0; pixels],
            depth: vec![0.0; pixels],
        };
        for (tile, canvas) in self.canvas.iter().enumerate() {
            for_each_pixel(grid, tile, |y, x, at| {
                for channel in 0..3 {
                    out.rgb[3 * at + channel] = canvas.planes[channel][y][x];
                }
                out.alpha[at] = 1.0 - canvas.planes[TRANSMITTANCE][y][x];
                out.depth[at] = canvas.planes[DEPTH][y][x];
            });
        }
        out
    }
}

/// Calls `f(y, x within the tile, pixel of the image)` for every pixel of a tile inside the image.
fn for_each_pixel(grid: &Grid, tile: usize, mut f: impl FnMut(usize, usize, usize)) {
    let place = TilePlace::new(grid, tile);
    for y in 0..place.height {
        for x in 0..place.width {
            let at = (place.y as usize + y) * grid.width + place.x as usize + x;
            f(y, x, at);
        }
    }
}

fn atomic_zeros(n: usize) -> Vec<AtomicU32> {
    (0..n).map(|_| AtomicU32::new(0)).collect()
}

fn scalars(value: LossValue) -> StepOutput {
    StepOutput {
        loss: value.loss() as f32,
        l1: value.l1 as f32,
        ssim: value.ssim as f32,
        ..StepOutput::default()
    }
}

/// A single tile's list holds each row at most once, so that the budget is always enough.
fn tile_cap(options: &CpuOptions) -> usize {
    options.tile_cap.max(options.budget).max(1).min(u32::MAX as usize)
}

/// Bytes per buffer for these options.
fn ledger(sh_degree: u8, options: &CpuOptions, threads: usize) -> Ledger {
    let budget = options.budget.max(1);
    let cap = tile_cap(options) as u64;
    let needs = &options.needs;
    let stride = Accumulators::new(1, needs.signals).detail().stride();
    let per_row = planes(sh_degree);
    let padded = budget.next_multiple_of(WIDTH) as u64;
    let (width, height) = options.largest_image;
    let grid = Grid::new(width, height);
    let float = size_of::<f32>() as u64;
    let mut ledger = Ledger::default();
    ledger.add("parameters", Blocks::bytes(budget, per_row));
    ledger.add("optimiser moments", 2 * Blocks::bytes(budget, per_row));
    ledger.add("optimiser ages and bias tables", padded * 2 + BiasCorrection::bytes());
    ledger.add("policy signals", Accumulators::bytes(budget, needs.signals));
    ledger.add("policy candidates", Candidates::bytes(needs.candidates, grid.width * grid.height));
    ledger.add(
        "projected splats",
        budget as u64 * size_of::<Splat>() as u64 + padded / WIDTH as u64 * 2,
    );
    ledger.add("splat gradients", padded * stride as u64 * float);
    ledger.add("tile lists", TileLists::bytes(budget, cap as usize, grid.tiles()));
    ledger.add("tile gradients", cap * stride as u64 * float);
    let per_tile = size_of::<TileCanvas>() + size_of::<TileGradient>();
    ledger.add("image and image gradient", (grid.tiles() * per_tile) as u64);
    ledger.add("loss", LossBuffers::bytes(grid.width, grid.height, threads));
    ledger
}

/// Asks for all of the ledger at once and gives it back, so that a refusal is an error before
/// training and not an abort within it.
fn reserve(ledger: &Ledger) -> Result<(), BackendError> {
    let bytes = ledger.total();
    let failed = BackendError::OutOfMemory { what: "the training buffers", bytes };
    let Ok(size) = usize::try_from(bytes) else {
        return Err(failed);
    };
    Vec::<u8>::new().try_reserve_exact(size).map_err(|_| failed)
}

impl Backend for CpuBackend {
    fn rows(&self) -> usize {
        self.rows
    }

    fn budget(&self) -> usize {
        self.budget
    }

    fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    fn begin_epoch(&mut self) {
        self.signals.begin_epoch(self.rows);
    }

    fn train_step(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        let StepInput { camera, target, background, .. } = *input;
        assert_eq!(
            (camera.width, camera.height),
            (target.width, target.height),
            "camera and image differ in size"
        );
        let frame = self.forward(camera, background, input.sh_degree, false)?;
        let picks = self.candidates.open(input.step, self.rows);
        let weights = picks.and_then(|(request, _)| candidates::error_weights(request.error));
        let value = self.image_loss(&frame.grid, target, background, weights);
        if let Some((request, count)) = picks {
            self.collect_candidates(&frame, target, &request, count);
        }
        let detail = self.signals.detail();
        self.backward(&frame, detail);
        self.optimise(&frame, input, detail);
        self.clock.lap("project_bwd + adam");
        Ok(StepOutput {
            visible: frame.visible,
            entries: frame.entries,
            bands: frame.bands.len() as u32,
            ..scalars(value)
        })
    }

    fn measure_weights(&mut self, camera: &Camera, sh_degree: u8) -> Result<(), BackendError> {
        self.measure(camera, sh_degree)
    }

    fn take_signals(&mut self, needs: &Needs) -> Result<(Signals, Vec<Candidate>), BackendError> {
        let signals = self.signals.take(self.rows, needs.signals, &self.params, &self.ages);
        self.signals.forget_measured(self.rows);
        Ok((signals, self.candidates.list().to_vec()))
    }

    fn apply(&mut self, ops: &RowOps, seed: u64, step: u32) -> Result<(), BackendError> {
        // Kept in release builds: this is the promise.
        assert_eq!(ops.rows_before, self.rows, "a plan for another number of rows");
        assert_eq!(ops.budget, self.budget, "a plan for another budget");
        assert!(ops.rows_after <= self.budget, "{} rows over the budget", ops.rows_after);
        if let Err(broken) = ops.check() {
            panic!("a plan that breaks its own rules: {broken}");
        }
        let mut model = apply::Model {
            params: &mut self.params,
            moments: self.moments.each_mut(),
            ages: &mut self.ages,
            signals: &mut self.signals,
        };
        apply::apply(&mut model, ops, &PolicyRng::new(seed, step));
        self.rows = ops.rows_after;
        if ops.reset_candidates {
            self.candidates.clear();
        }
        Ok(())
    }

    fn render(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<Rendering, BackendError> {
        let frame = self.forward(camera, background, sh_degree, true)?;
        Ok(self.rendering(&frame))
    }

    fn download(&self) -> Gaussians {
        self.params.unpack(self.rows, self.sh_degree)
    }
}

impl CpuBackend {
    /// Stages 6–8 in one sweep over the rows, so that gradients never leave the cache.
    fn optimise(&mut self, frame: &Frame, input: &StepInput<'_>, detail: Detail) {
        let Self { pool, arch, params, moments, ages, signals, sums, visible, bias, rows, .. } =
            self;
        let (rows, arch) = (*rows, *arch);
        let [m, v] = moments;
        let layout = signals.layout();
        let (stride, signal_stride) = (params.stride(), signals.blocks.stride());
        let blocks = rows.div_ceil(WIDTH);
        let mut signal_blocks: Vec<&mut [f32]> = if signal_stride == 0 {
            (0..blocks.div_ceil(BLOCKS_PER_TASK)).map(|_| Default::default()).collect()
        } else {
            let per_task = signal_stride * BLOCKS_PER_TASK;
            signals.blocks.of_rows_mut(rows).chunks_mut(per_task).collect()
        };
        pool.install(|| {
            (
                params.of_rows_mut(rows).par_chunks_mut(stride * BLOCKS_PER_TASK),
                m.of_rows_mut(rows).par_chunks_mut(stride * BLOCKS_PER_TASK),
                v.of_rows_mut(rows).par_chunks_mut(stride * BLOCKS_PER_TASK),
                ages[..blocks * WIDTH].par_chunks_mut(ROWS_PER_TASK),
                signal_blocks.par_iter_mut(),
                sums[..blocks * WIDTH * detail.stride()]
                    .par_chunks(ROWS_PER_TASK * detail.stride()),
                visible[..blocks].par_chunks(BLOCKS_PER_TASK),
            )
                .into_par_iter()
                .for_each(|(params, m, v, ages, signals, sums, visible)| {
                    arch.dispatch(Optimise {
                        params,
                        moments: [m, v],
                        stride,
                        ages,
                        signals,
                        layout,
                        sums,
                        detail,
                        visible,
                        view: &frame.view,
                        rates: &input.rates,
                        bias,
                    });
                });
        });
    }
}

const _: () = assert!(CANVAS_PLANES == 5, "a tile's gradient mirrors its canvas");
