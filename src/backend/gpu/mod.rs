//! The GPU backend: the native backend's stages as WGSL, through wgpu, on Vulkan, Metal and DX12.
//!
//! Parameters stay on the device. A step is encoded once and submitted once; what differs between
//! views (rows on screen, entries, bands) is counted there and drives indirect dispatches, and a few
//! scalars come back with the loss. Where a view has more tile entries than the cap, the image is
//! processed in bands: as many are encoded as the step before needed, and a step for which these do
//! not do changes nothing, says so, and is taken again with enough.
//!
//! Every sum has one order, so that the same device gives the same bytes twice.

mod buffers;
mod device;
mod edits;
mod frame;
mod passes;
mod pipelines;
mod readback;
mod signals;

use std::sync::Arc;
use std::time::{Duration, Instant};

use densify_policies::plan::RowOps;
use densify_policies::policy::{
    Cadence, Candidate, LossTerms, Needs, NoiseTerm, Signal, Signals,
};

use super::cpu::{ImageGradient, ModelGradient};
use super::{AuxInput, AuxOutput, Backend, BackendError, Rendering, StepInput, StepOutput};
use crate::camera::Camera;
use crate::dataset::images::Image8;
use crate::gaussians::{Gaussians, sh_coefficients};
use crate::memory::Ledger;
use crate::sh;

use buffers::{Buffers, MOST_ENTRIES, SH, Sizes, band_coefficients, bias_table};
use device::Device;
pub use device::{AdapterChoice, AdapterKind, AdapterSummary, GpuDevice, adapters};
use edits::EditLaunches;
use frame::{Frame, State, due, grid, target};
use passes::{Launches, Passes, Recorder, Shape};
use pipelines::Pipelines;
use signals::{Planes, record_stride};

/// Largest image side `[px]`; at this size every index of the stages still fits its type.
const MAX_SIDE: u32 = 16_384;
/// Weight of 1 − SSIM in the loss; L1 has the rest.
const SSIM_WEIGHT: f32 = 0.2;

/// How to set up a [`GpuBackend`].
#[derive(Debug, Clone)]
pub struct GpuOptions {
    /// Most rows there may ever be, >= 1 and >= the model's.
    pub budget: usize,
    /// Near plane `[scene units]`, > 0: rows nearer to the camera are not rendered.
    pub near: f32,
    /// Most (row, tile) entries held at a time; beyond it the image is processed in bands. `None`:
    /// 16 per row of the budget, or as many as the device can bind. Raised to the budget.
    pub tile_cap: Option<usize>,
    /// Largest image that will be rendered (width, height) `[px]`. Larger ones still work, with more
    /// memory than the ledger says.
    pub largest_image: (u32, u32),
    /// Signals and candidates to collect.
    pub needs: Needs,
}

impl GpuOptions {
    /// Options for models of at most `budget` rows.
    #[must_use]
    pub fn new(budget: usize) -> Self {
        Self {
            budget,
            near: 0.01,
            tile_cap: None,
            largest_image: (0, 0),
            needs: Needs::default(),
        }
    }
}

/// What waits for an optimiser step.
#[derive(Debug, Clone, Copy, Default)]
struct Waiting {
    main: bool,
    rest: bool,
}

/// The GPU backend.
#[derive(Debug)]
pub struct GpuBackend {
    device: Arc<Device>,
    sizes: Sizes,
    buffers: Buffers,
    pipelines: Arc<Pipelines>,
    launches: Launches,
    edits: EditLaunches,
    ledger: Ledger,
    budget: usize,
    rows: usize,
    near: f32,
    planes: Planes,
    terms: LossTerms,
    noise: Option<NoiseTerm>,
    cadence: Cadence,
    waiting: Waiting,
    /// Bands that are encoded for the next view.
    bands: u32,
    laps: Vec<(&'static str, Duration)>,
}

impl GpuBackend {
    /// Takes over `model` and allocates everything for `options.budget` rows.
    ///
    /// # Errors
    /// [`BackendError`]: a limit of the device, its memory, or needs that it cannot fulfil.
    ///
    /// # Panics
    /// When the model has more rows than the budget: the caller subsamples before.
    pub fn new(
        model: &Gaussians,
        options: &GpuOptions,
        device: &GpuDevice,
    ) -> Result<Self, BackendError> {
        let budget = options.budget.max(1);
        assert!(model.len() <= budget, "{} rows over a budget of {budget}", model.len());
        check_needs(&options.needs)?;
        let device = device.0.clone();
        let most = device.summary.largest_budget(model.sh_degree);
        if budget as u64 > most {
            return Err(BackendError::OverLimit(format!(
                "a budget of {budget} rows: {} takes {most} at degree {}; use --budget {most}",
                device.summary.name, model.sh_degree
            )));
        }
        let planes = Planes::new(options.needs.signals);
        let bindable = device.largest_binding() / (4 * record_stride(planes.detail));
        let cap = match options.tile_cap {
            Some(cap) => cap as u64,
            None => (16 * budget as u64).min(bindable),
        };
        let cap = cap.max(budget as u64).min(MOST_ENTRIES);
        let (width, height) = options.largest_image;
        let image = (width.clamp(1, MAX_SIDE), height.clamp(1, MAX_SIDE));
        let sizes = Sizes::new(budget, cap, model.sh_degree, image, &options.needs);
        let buffers = Buffers::new(&device, &sizes)?;
        let pipelines = device.pipelines(sizes.detail, sizes.more)?;
        let launches = device
            .guarded("the kernels", 0, |device| Launches::new(device, &pipelines, &buffers))?;
        let edits = EditLaunches::new(&device, &sizes, &planes, &buffers, &pipelines);
        let gpu = Self {
            ledger: sizes.ledger(),
            device,
            sizes,
            buffers,
            pipelines,
            launches,
            edits,
            budget,
            rows: model.len(),
            near: options.near,
            planes,
            terms: options.needs.loss_terms,
            noise: options.needs.noise,
            cadence: options.needs.cadence,
            waiting: Waiting::default(),
            bands: 1,
            laps: Vec::new(),
        };
        gpu.write("bias", bytemuck::cast_slice(&bias_table()));
        gpu.upload(model);
        gpu.device.check()?;
        Ok(gpu)
    }

    /// The adapter that was taken.
    #[must_use]
    pub fn adapter(&self) -> &AdapterSummary {
        &self.device.summary
    }

    /// What is allocated on the device now `[bytes]`.
    #[must_use]
    pub fn allocated(&self) -> u64 {
        self.buffers.bytes()
    }

    fn write(&self, name: &str, bytes: &[u8]) {
        if !bytes.is_empty() {
            self.device.queue.write_buffer(self.buffers.get(name), 0, bytes);
        }
    }

    fn upload(&self, model: &Gaussians) {
        let mut rows = Vec::with_capacity(12 * model.len());
        for i in 0..model.len() {
            rows.extend_from_slice(&model.means[i]);
            rows.extend_from_slice(&model.log_scales[i]);
            rows.extend_from_slice(&model.quats[i]);
            rows.extend_from_slice(&[model.opacity_logits[i], 0.0]);
        }
        self.write("rows", bytemuck::cast_slice(&rows));
        let mut first = 0;
        for band in 0..=usize::from(model.sh_degree) {
            let numbers = 3 * band_coefficients(band);
            let of_row = |i| &model.sh_of(i)[first..first + numbers];
            let values: Vec<f32> = (0..model.len()).flat_map(of_row).copied().collect();
            self.write(SH[band], bytemuck::cast_slice(&values));
            first += numbers;
        }
    }

    fn read(&self, name: &str, from: u64, bytes: u64) -> Result<Vec<f32>, BackendError> {
        let staging = self.buffers.get("read");
        let bytes = readback::read(&self.device, staging, self.buffers.get(name), from, bytes)?;
        Ok(bytemuck::pod_collect_to_vec(&bytes))
    }

    /// Makes room for images of this size.
    fn fit_image(&mut self, width: u32, height: u32) -> Result<(), BackendError> {
        if width > MAX_SIDE || height > MAX_SIDE {
            return Err(BackendError::ImageTooLarge { width, height, max: MAX_SIDE });
        }
        let (most_wide, most_high) = self.sizes.image;
        if width > most_wide || height > most_high {
            self.sizes.image = (most_wide.max(width), most_high.max(height));
            self.rebuild()?;
        }
        Ok(())
    }

    /// Allocates buffers whose size has changed, and binds all of them anew.
    fn rebuild(&mut self) -> Result<(), BackendError> {
        self.buffers.resize(&self.device, &self.sizes)?;
        let Self { device, sizes, pipelines, buffers, .. } = self;
        *pipelines = device.pipelines(sizes.detail, sizes.more)?;
        self.launches = device
            .guarded("the kernels", 0, |device| Launches::new(device, pipelines, buffers))?;
        self.edits = EditLaunches::new(device, sizes, &self.planes, buffers, pipelines);
        Ok(())
    }

    fn frame(&self, camera: &Camera, background: [f32; 3], sh_degree: u8) -> Frame {
        let degree = u32::from(sh_degree.min(self.sizes.sh_degree));
        let of_model = [self.rows as u32, degree, self.sizes.cap as u32, self.budget as u32];
        Frame::of_view(camera, background, self.near, of_model)
    }

    /// Encodes and submits a view's passes until the bands that were encoded do, and returns the
    /// state that they left. `encode` records everything, with the bands that it is given.
    fn run(
        &mut self,
        frame: &Frame,
        encode: impl Fn(&Passes<'_>, &mut Recorder<'_, '_>),
    ) -> Result<State, BackendError> {
        self.write("frame", bytemuck::bytes_of(frame));
        let [rows, ..] = frame.model;
        let tiles = frame.image[3];
        loop {
            let shape = Shape { rows, tiles, bands: self.bands };
            let groups = self.buffers.get("groups");
            let passes = Passes { launches: &self.launches, groups, shape };
            let mut encoder = self.device.device.create_command_encoder(&Default::default());
            if shape.bands > 1 {
                encoder.clear_buffer(self.buffers.get("tile counts"), 0, None);
            }
            let pass = encoder.begin_compute_pass(&Default::default());
            encode(&passes, &mut Recorder { pass, pipelines: &self.pipelines });
            let staging = self.buffers.get("read");
            let bytes = size_of::<State>() as u64;
            encoder.copy_buffer_to_buffer(self.buffers.get("state"), 0, staging, 0, bytes);
            let bytes = readback::finish(&self.device, staging, encoder, bytes)?;
            let state: State = bytemuck::pod_read_unaligned(&bytes);
            if state.short == 0 {
                self.bands = state.bands.max(1);
                return Ok(state);
            }
            // One band was tried: a guess. Several: now the device has counted how many.
            let guess = (2 * u64::from(state.total)).div_ceil(self.sizes.cap).max(2);
            let needed = if shape.bands == 1 { guess } else { u64::from(state.bands) };
            self.bands = needed.min(u64::from(tiles)) as u32;
        }
    }

    /// Packs a photograph and uploads it; returns the bits that say what it has.
    fn upload_target(&self, image: &Image8) -> u32 {
        let pixels = image.width as usize * image.height as usize;
        let mut words = vec![0_u32; pixels];
        for (word, rgb) in words.iter_mut().zip(image.rgb.as_chunks::<3>().0) {
            *word = u32::from_le_bytes([rgb[0], rgb[1], rgb[2], 255]);
        }
        if let Some(alpha) = &image.alpha {
            for (word, &a) in words.iter_mut().zip(alpha) {
                *word = *word & 0x00ff_ffff | u32::from(a) << 24;
            }
        }
        self.write("truth", bytemuck::cast_slice(&words));
        if let Some(mask) = &image.mask {
            let mut mask = mask.clone();
            mask.resize(mask.len().next_multiple_of(4), 0);
            self.write("mask", &mask);
        }
        (if image.alpha.is_some() { target::HAS_ALPHA } else { 0 })
            | (if image.mask.is_some() { target::HAS_MASK } else { 0 })
    }

    /// The image of the last view rendered.
    fn rendering(&self, width: u32, height: u32) -> Result<Rendering, BackendError> {
        let pixels = width as usize * height as usize;
        let canvas = self.read("canvas", 0, 16 * pixels as u64)?;
        let finish = self.read("finish", 0, 8 * pixels as u64)?;
        let canvas = canvas.as_chunks::<4>().0;
        Ok(Rendering {
            width,
            height,
            rgb: canvas.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect(),
            alpha: finish.as_chunks::<2>().0.iter().map(|[light, _]| 1.0 - light).collect(),
            depth: canvas.iter().map(|[.., depth]| *depth).collect(),
        })
    }

    /// Renders a view and differentiates Σ rgb·upstream.rgb + Σ alpha·upstream.alpha +
    /// Σ depth·upstream.depth with respect to every parameter. Changes nothing of the model.
    ///
    /// Needs records of full detail, so that it allocates more than the ledger says where the
    /// policy's needs are smaller: it is a tool for tests and for research, not part of training.
    ///
    /// # Errors
    /// [`BackendError`].
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
        if !self.sizes.more {
            (self.sizes.more, self.sizes.detail) = (true, 2);
            self.rebuild()?;
        }
        self.fit_image(camera.width, camera.height)?;
        let channel = |c: usize| upstream.rgb.iter().skip(c).step_by(3).copied();
        let planes = (0..3).flat_map(channel).chain(upstream.alpha.iter().copied());
        let planes: Vec<f32> = planes.chain(upstream.depth.iter().copied()).collect();
        self.write("pixel gradient", bytemuck::cast_slice(&planes));
        let frame = self.frame(camera, background, sh_degree);
        self.run(&frame, |passes, to| {
            passes.forward(to);
            passes.backward(to);
            passes.differentiate(to);
        })?;
        let rendering = self.rendering(camera.width, camera.height)?;
        Ok((rendering, self.model_gradient(frame.model[1] as u8)?))
    }

    /// What stages 5 and 6 have left.
    fn model_gradient(&self, degree: u8) -> Result<ModelGradient, BackendError> {
        let n = self.rows as u64;
        let gradient = self.read("gradient", 0, 80 * n)?;
        let sums = self.read("row sums", 0, 60 * n)?;
        let splats = self.read("splats", 0, 48 * n)?;
        let depths = self.read("depths", 0, 4 * n)?;
        let planes = self.sizes.sh_numbers();
        let mut out = ModelGradient { sh: vec![0.0; planes * self.rows], ..Default::default() };
        let rows = gradient.as_chunks::<20>().0.iter().zip(sums.as_chunks::<15>().0);
        let rest = splats.as_chunks::<12>().0.iter().zip(depths);
        for (row, ((g, sums), (splat, depth))) in rows.zip(rest).enumerate() {
            let seen = depth.to_bits() != u32::MAX;
            let sums = if seen { *sums } else { [0.0; 15] };
            let l1 = if seen { splat[2] } else { 0.0 };
            let unfold = 1.0 / 0.849_321_8_f32;
            out.means.push([g[0], g[1], g[2]]);
            out.log_scales.push([g[3], g[4], g[5]]);
            out.quats.push([g[6], g[7], g[8], g[9]]);
            out.opacity_logits.push(g[10]);
            out.mean2d.push([g[11], g[15]]);
            out.mean2d_abs.push([
                l1 * unfold * unfold * sums[9],
                unfold * unfold * sums[10],
            ]);
            out.colour.push([sums[6], sums[7], sums[8]]);
            out.max_weight.push(sums[14]);
            out.sum_weight.push(sums[11]);
            out.pixel_count.push(sums[12] as u32);
            out.visible.push(seen);
            let mut y = [0.0_f32; 16];
            y[0] = sh::C0;
            sh::basis(degree, [g[16], g[17], g[18]], &mut y);
            for k in 0..sh_coefficients(degree) {
                for channel in 0..3 {
                    out.sh[row * planes + 3 * k + channel] = y[k] * g[12 + channel];
                }
            }
        }
        Ok(out)
    }

    /// The training loss of a rendering against a target and its gradient by the rendering's
    /// pixels. Shape of the gradient: `[height, width, 3]`.
    ///
    /// # Errors
    /// [`BackendError`].
    ///
    /// # Panics
    /// When rendering and target differ in size.
    pub fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> Result<(StepOutput, Vec<f32>), BackendError> {
        let (width, height) = (rendering.width, rendering.height);
        assert_eq!((width, height), (target.width, target.height), "sizes differ");
        self.fit_image(width, height)?;
        let pixels = rendering.rgb.as_chunks::<3>().0;
        let canvas: Vec<[f32; 4]> = pixels.iter().map(|&[r, g, b]| [r, g, b, 0.0]).collect();
        self.write("canvas", bytemuck::cast_slice(&canvas));
        let [columns, tiles] = grid(width, height);
        let [r, g, b] = background;
        let frame = Frame {
            background: [r, g, b, 0.0],
            image: [width, height, columns, tiles],
            draw: [0, 0, 0, self.upload_target(target)],
            ..bytemuck::Zeroable::zeroed()
        };
        // Nothing was counted in this run, so that there is nothing for which bands might not do.
        self.write("state", bytemuck::bytes_of(&<State as bytemuck::Zeroable>::zeroed()));
        let state = self.run(&frame, |passes, to| passes.loss(to, [0.0; 2]))?;
        let planes = self.read("pixel gradient", 0, 12 * pixels.len() as u64)?;
        let n = pixels.len();
        let gradient = (0..3 * n).map(|i| planes[i % 3 * n + i / 3]).collect();
        Ok((scalars(&state), gradient))
    }

    /// Who steps now and who waits, as bits of the frame, and who waits afterwards.
    fn cadence_bits(&self, input: &StepInput<'_>) -> (u32, Waiting) {
        let (step, cadence) = (input.step, input.cadence);
        assert!(cadence.is_within(self.cadence), "step {step}: {cadence:?} was not declared");
        let [main, rest] = cadence.steps_at(step);
        let bits = [
            (main, due::MAIN_STEPS),
            (rest, due::REST_STEPS),
            (self.waiting.main, due::MAIN_WAITED),
            (self.waiting.rest, due::REST_WAITED),
            (self.cadence.sh_rest > 1, due::REST_AGES),
        ];
        let bits = bits.iter().filter(|(on, _)| *on).fold(0, |all, (_, bit)| all | bit);
        (bits, Waiting { main: !main, rest: !rest })
    }

    /// A column of one plane of numbers.
    fn column(&self, plane: u32) -> Result<Vec<f32>, BackendError> {
        let pitch = 4 * self.sizes.budget;
        self.read("signals", u64::from(plane) * pitch, 4 * self.rows as u64)
    }

    /// A column of present values; see `present` in `shaders/signals.wgsl`.
    fn present(&self, which: u32) -> Result<Vec<f32>, BackendError> {
        let mut encoder = self.device.device.create_command_encoder(&Default::default());
        let pass = encoder.begin_compute_pass(&Default::default());
        let mut to = Recorder { pass, pipelines: &self.pipelines };
        to.run(&self.launches.present, [which, 0, 0, 0], (self.rows as u32).div_ceil(256));
        drop(to);
        self.device.queue.submit([encoder.finish()]);
        self.read("sums", 0, 4 * self.rows as u64)
    }
}

/// What this backend cannot do yet.
fn check_needs(needs: &Needs) -> Result<(), BackendError> {
    let lacking = [
        (needs.candidates.is_some(), "candidates for new rows (compensation)"),
        (needs.aux.is_some(), "auxiliary views"),
    ];
    match lacking.iter().find(|(wanted, _)| *wanted) {
        Some((_, what)) => Err(BackendError::Unsupported(format!(
            "the policy needs {what}, which the GPU backend does not have; use --backend cpu"
        ))),
        None => Ok(()),
    }
}

fn scalars(state: &State) -> StepOutput {
    let State { l1, ssim, .. } = *state;
    StepOutput {
        loss: (1.0 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1.0 - ssim),
        l1,
        ssim,
        visible: state.visible as usize,
        entries: state.entries(),
        bands: state.bands,
    }
}

impl Backend for GpuBackend {
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
        if let Some(plane) = self.planes.begin_epoch() {
            self.clear_planes(&[plane]);
        }
    }

    fn train_step(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        let StepInput { camera, target, background, .. } = *input;
        assert_eq!(
            (camera.width, camera.height),
            (target.width, target.height),
            "camera and image differ in size"
        );
        let start = Instant::now();
        self.fit_image(camera.width, camera.height)?;
        let (due, waiting) = self.cadence_bits(input);
        let mut frame = self.frame(camera, background, input.sh_degree);
        frame.draw[3] = self.upload_target(target);
        frame.for_step(input, due, (self.terms, self.noise), &self.planes);
        let (degree, signals) = (frame.model[1] as u8, self.planes.count > 0);
        let state = self.run(&frame, |passes, to| {
            passes.forward(to);
            passes.loss(to, [0.0; 2]);
            passes.backward(to);
            passes.optimise(to, degree, signals);
        })?;
        self.waiting = waiting;
        self.laps.clear();
        self.laps.push(("device", start.elapsed()));
        Ok(scalars(&state))
    }

    fn measure_weights(&mut self, camera: &Camera, sh_degree: u8) -> Result<(), BackendError> {
        if self.planes.fresh().is_none() {
            return Ok(());
        }
        self.fit_image(camera.width, camera.height)?;
        let mut frame = self.frame(camera, [0.0; 3], sh_degree);
        frame.planes = self.planes.in_frame();
        let mut encoder = self.device.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(self.buffers.get("pixel gradient"), 0, None);
        self.device.queue.submit([encoder.finish()]);
        self.run(&frame, |passes, to| {
            passes.forward(to);
            passes.backward(to);
            passes.measure(to);
        })?;
        Ok(())
    }

    fn observe(&mut self, _: &AuxInput<'_>) -> Result<AuxOutput, BackendError> {
        Err(BackendError::Unsupported("auxiliary views need --backend cpu".into()))
    }

    fn take_signals(&mut self, needs: &Needs) -> Result<(Signals, Vec<Candidate>), BackendError> {
        let mut signals = Signals::zeros(self.rows, needs.signals);
        for signal in needs.signals.iter() {
            let values = match signal {
                Signal::Opacity => self.present(0)?,
                Signal::ScaleMax => self.present(1)?,
                Signal::ScaleProduct => self.present(2)?,
                Signal::Age => self.present(3)?,
                sum => {
                    let mut most: Option<Vec<f32>> = None;
                    for plane in self.planes.of(sum) {
                        let column = self.column(plane)?;
                        most = Some(match most {
                            None => column,
                            Some(most) => {
                                most.iter().zip(&column).map(|(a, b)| a.max(*b)).collect()
                            }
                        });
                    }
                    most.unwrap_or_else(|| vec![0.0; self.rows])
                }
            };
            if let Some(column) = signals.get_mut(signal) {
                column.copy_from_slice(&values);
            }
        }
        if let Some(plane) = self.planes.fresh() {
            self.clear_planes(&[plane]);
        }
        Ok((signals, Vec::new()))
    }

    fn apply(&mut self, ops: &RowOps, seed: u64, step: u32) -> Result<(), BackendError> {
        // Kept in release builds: this is the promise.
        assert_eq!(ops.rows_before, self.rows, "a plan for another number of rows");
        assert_eq!(ops.budget, self.budget, "a plan for another budget");
        assert!(ops.rows_after <= self.budget, "{} rows over the budget", ops.rows_after);
        if let Err(broken) = ops.check() {
            panic!("a plan that breaks its own rules: {broken}");
        }
        self.edit(ops, seed, step);
        self.device.check()
    }

    fn render(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<Rendering, BackendError> {
        self.fit_image(camera.width, camera.height)?;
        let frame = self.frame(camera, background, sh_degree);
        self.run(&frame, |passes, to| passes.forward(to))?;
        self.rendering(camera.width, camera.height)
    }

    fn download(&self) -> Result<Gaussians, BackendError> {
        let n = self.rows as u64;
        let rows = self.read("rows", 0, 48 * n)?;
        let rows = rows.as_chunks::<12>().0;
        let sh_degree = self.sizes.sh_degree;
        let planes = self.sizes.sh_numbers();
        let mut sh = vec![0.0; planes * self.rows];
        let mut first = 0;
        for band in 0..=usize::from(sh_degree) {
            let numbers = 3 * band_coefficients(band);
            let values = self.read(SH[band], 0, 4 * n * numbers as u64)?;
            for (row, values) in values.chunks_exact(numbers).enumerate() {
                sh[row * planes + first..][..numbers].copy_from_slice(values);
            }
            first += numbers;
        }
        Ok(Gaussians {
            sh_degree,
            means: rows.iter().map(|r| [r[0], r[1], r[2]]).collect(),
            log_scales: rows.iter().map(|r| [r[3], r[4], r[5]]).collect(),
            quats: rows.iter().map(|r| [r[6], r[7], r[8], r[9]]).collect(),
            opacity_logits: rows.iter().map(|r| r[10]).collect(),
            sh,
        })
    }

    fn stage_times(&self) -> &[(&'static str, Duration)] {
        &self.laps
    }
}
