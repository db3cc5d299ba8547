//! The GPU backend: the native backend's stages as WGSL, through wgpu, on Vulkan, Metal and DX12.
//!
//! Parameters stay on the device. A step is encoded and submitted once. Numbers that differ between views
//! (visible rows, tile entries, bands) are counted on the device and drive indirect dispatches; a few scalars
//! come back with the loss. If a view has more tile entries than the cap, the image is processed in bands. As
//! many bands are encoded as the previous step needed; a step that needs more bands changes nothing, reports
//! this, and is repeated with enough bands.
//!
//! With [`Accumulation::Slots`](super::Accumulation::Slots) every sum has a fixed order, and runs on the same
//! device are reproducible byte for byte. Otherwise the order of a row's sums over tiles varies.

mod adapter;
mod audit;
mod buffers;
mod canary;
mod clock;
mod depth;
mod device;
mod differentiate;
mod edits;
mod exposure;
mod frame;
mod kernels;
mod launches;
mod memory_plan;
mod observe;
mod passes;
mod pipelines;
mod pose;
mod readback;
mod rows;
mod sizes;
mod state;
mod step;
mod submit;
mod transfer;
mod vignette;

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use densify_policies::plan::RowOps;
use densify_policies::policy::{Cadence, Candidate, MaskTerm, SignalKind, SignalSet, Signals};

use super::candidates::Candidates;
use super::cpu::{BiasCorrection, MAX_SIDE};
use super::signals::{ParameterSignal, RecordLayout, SignalPlanes, value_of};
use super::{
    AdapterSummary, AuxInput, AuxOutput, Backend, BackendError, Inspect, NonFinite, Rendering,
    Setup, Shortcuts, StateArray, StateError, StepInput, StepOutput, Tensor, assert_fits,
};
use densify_core::antialiasing::Antialiasing;
use densify_core::camera::Camera;
use densify_core::gaussians::{Gaussians, ModelArray, rgb_to_dc};
use densify_core::memory::Ledger;

pub use adapter::{adapters, may_be_present};
use buffers::Buffers;
use device::Device;
pub use device::GpuDevice;
pub use device::faults::with_device_lost_after;
use frame::Frame;
use launches::Launches;
use pipelines::Variant;
use sizes::Sizes;

/// Parameter groups whose gradients wait for an optimiser step.
#[derive(Debug, Clone, Copy, Default)]
struct Waiting {
    /// All parameters but SH bands 1–3.
    main: bool,
    /// SH bands 1–3.
    rest: bool,
}

/// A photograph that stays on the device.
#[derive(Debug, Clone, Copy)]
struct ResidentPhotograph {
    /// Place in the buffer of photographs.
    slot: u64,
    /// Width and height `[px]`.
    size: [u32; 2],
    /// Bits of [`frame::target`].
    flags: u32,
}

/// The GPU backend.
#[derive(Debug)]
pub struct GpuBackend {
    device: Arc<Device>,
    sizes: Sizes,
    buffers: Buffers,
    launches: Launches,
    ledger: Ledger,
    rows: usize,
    near: f32,
    shortcuts: Shortcuts,
    antialiasing: Antialiasing,
    planes: SignalPlanes,
    /// The records of training steps, which [`differentiate`](crate::Differentiable::differentiate) replaces.
    records: RecordLayout,
    mask: Option<MaskTerm>,
    cadence: Cadence,
    waiting: Waiting,
    candidates: Candidates,
    /// Photographs that stay on the device, by view: those used first, as many as fit. They are never replaced: views
    /// come in a new random order in each epoch, so that a photograph would often be evicted before it is used again.
    /// All other photographs are uploaded at every step.
    photographs: HashMap<usize, ResidentPhotograph>,
    /// Derivative sums of the last step's exposure, if it had one; see `shaders/exposure.wgsl`.
    exposure_sums: [[f32; 4]; 4],
    /// Sums of the last step's gradient with respect to the pose, if it had one.
    pose_sums: [[f32; 4]; 2],
    /// The same of its vignette; see `shaders/vignette.wgsl`.
    vignette_sums: [f32; 4],
    /// Number of bands to encode for the next view.
    bands: u32,
    stage_times: Vec<(&'static str, Duration)>,
}

impl GpuBackend {
    /// Creates the backend without the [canary](GpuDevice::run_canary).
    fn without_canary(
        model: &Gaussians,
        options: &Setup,
        device: &GpuDevice,
    ) -> Result<Self, BackendError> {
        let shortcuts = options.shortcuts;
        let budget = options.row_budget().total;
        assert!(model.len() <= budget, "{} rows over a budget of {budget}", model.len());
        let device = device.0.clone();
        let most = device.summary.largest_budget(model.sh_degree);
        if budget as u64 > most {
            return Err(BackendError::TooManyRows {
                budget,
                device: device.summary.name.clone(),
                most,
                sh_degree: model.sh_degree,
            });
        }
        let planes = SignalPlanes::new(&options.needs);
        let sizes = memory_plan::sizes(&device, model.sh_degree, options);
        let buffers = Buffers::new(&device, &sizes)?;
        let antialiasing = model.antialiasing;
        let launches = launches(&device, &sizes, (shortcuts, antialiasing), &buffers)?;
        let ledger = memory_plan::ledger(&sizes, &options.needs);
        let gpu = Self {
            ledger,
            device,
            records: sizes.records,
            sizes,
            buffers,
            launches,
            rows: model.len(),
            near: options.near,
            shortcuts,
            antialiasing,
            planes,
            mask: options.needs.mask,
            cadence: options.needs.cadence,
            waiting: Waiting::default(),
            candidates: Candidates::new(options.needs.candidates),
            photographs: HashMap::new(),
            exposure_sums: [[0.0; 4]; 4],
            pose_sums: [[0.0; 4]; 2],
            vignette_sums: [0.0; 4],
            bands: 1,
            stage_times: Vec::new(),
        };
        gpu.write("bias", bytemuck::cast_slice(&BiasCorrection::new().table));
        gpu.upload(model);
        gpu.device.check()?;
        Ok(gpu)
    }

    /// The adapter in use.
    pub fn adapter(&self) -> &AdapterSummary {
        &self.device.summary
    }

    /// Planned size of all buffers on the device `[bytes]`.
    pub fn planned_bytes(&self) -> u64 {
        self.sizes.planned().iter().map(|planned| planned.bytes).sum()
    }

    /// Current size of all buffers on the device `[bytes]`.
    pub fn allocated_bytes(&self) -> u64 {
        self.buffers.bytes()
    }

    /// Enlarges the buffers if the image does not fit.
    fn fit_image(&mut self, width: u32, height: u32) -> Result<(), BackendError> {
        if width > MAX_SIDE || height > MAX_SIDE {
            return Err(BackendError::ImageTooLarge { width, height, max: MAX_SIDE });
        }
        let (max_width, max_height) = self.sizes.image;
        if width > max_width || height > max_height {
            self.sizes.image = (max_width.max(width), max_height.max(height));
            // The slots of the photographs have moved.
            self.photographs.clear();
            self.rebuild()?;
        }
        Ok(())
    }

    /// Reallocates buffers whose size has changed, and binds all buffers again.
    fn rebuild(&mut self) -> Result<(), BackendError> {
        self.buffers.resize(&self.device, &self.sizes)?;
        let constants = (self.shortcuts, self.antialiasing);
        self.launches = launches(&self.device, &self.sizes, constants, &self.buffers)?;
        Ok(())
    }

    fn frame(&self, camera: &Camera, background: [f32; 3], sh_degree: u8) -> Frame {
        let degree = u32::from(sh_degree.min(self.sizes.sh_degree));
        let Sizes { cap, budget, .. } = self.sizes;
        let model = [self.rows as u32, degree, cap as u32, self.sizes.trained() as u32];
        let mut frame = Frame::for_view(camera, background, self.near, model);
        frame.frozen[0] = budget.frozen as u32;
        frame
    }
}

/// Compiles the kernels for these sizes and binds them to the buffers.
fn launches(
    device: &Device,
    sizes: &Sizes,
    (shortcuts, antialiasing): (Shortcuts, Antialiasing),
    buffers: &Buffers,
) -> Result<Launches, BackendError> {
    let &Sizes { records, alpha_and_depth, depth, counts_dominant, pixel_loss, .. } = sizes;
    let variant = Variant {
        records,
        alpha_and_depth,
        depth,
        pixel_loss,
        shortcuts,
        formats: sizes.formats(),
        counts_dominant,
        antialiasing,
    };
    let pipelines = device.pipelines(variant)?;
    device.guarded("the kernels", 0, |device| Launches::bind(device, &pipelines, buffers, sizes))
}

impl Backend for GpuBackend {
    fn rows(&self) -> usize {
        self.rows
    }

    fn sh_degree(&self) -> u8 {
        self.sizes.sh_degree
    }

    fn antialiasing(&self) -> Antialiasing {
        self.antialiasing
    }

    fn budget(&self) -> usize {
        self.sizes.budget.total
    }

    fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    fn begin_epoch(&mut self) {
        let cleared = self.planes.begin_epoch();
        self.clear_planes(&cleared);
    }

    fn train_step(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        self.step(input, true)
    }

    fn differentiate_pose(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        self.step(&StepInput { pose: true, ..*input }, false)
    }

    fn observe(&mut self, input: &AuxInput<'_>) -> Result<AuxOutput, BackendError> {
        self.observe_view(input)
    }

    fn take_signals(&mut self, wanted: SignalSet) -> Result<Signals, BackendError> {
        let mut signals = Signals::zeros(self.rows, wanted);
        for signal in wanted.iter() {
            if let Some(attribute) = ParameterSignal::new(signal) {
                self.read_attribute(&attribute, signals.get_mut(signal).unwrap_or_default())?;
                continue;
            }
            let values = if signal.kind() == SignalKind::Current {
                self.present(signal)?
            } else {
                let planes = self.planes.of_signal(signal);
                let columns: Result<Vec<_>, _> =
                    planes.map(|plane| self.column(plane, 0..self.rows)).collect();
                let max =
                    |a: Vec<f32>, b: Vec<f32>| a.iter().zip(&b).map(|(a, b)| a.max(*b)).collect();
                let mut largest =
                    columns?.into_iter().reduce(max).unwrap_or_else(|| vec![0.0; self.rows]);
                largest.iter_mut().for_each(|value| *value = value_of(signal, *value));
                largest
            };
            if let Some(column) = signals.get_mut(signal) {
                column.copy_from_slice(&values);
            }
        }
        Ok(signals)
    }

    fn candidates(&self) -> &[Candidate] {
        &self.candidates.list
    }

    fn apply(&mut self, ops: &RowOps, seed: u64, step: u32) -> Result<(), BackendError> {
        assert_fits(ops, self.rows, self.sizes.budget);
        self.edit(ops, seed, step);
        if ops.reset_candidates {
            self.candidates.list.clear();
        }
        self.device.check()
    }

    fn audit(&mut self) -> Result<Vec<NonFinite>, BackendError> {
        self.find_non_finite()
    }

    fn render(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<Rendering, BackendError> {
        self.fit_image(camera.width, camera.height)?;
        let frame = self.frame(camera, background, sh_degree);
        self.run(&frame, |passes, to| {
            passes.forward(to);
        })?;
        self.rendering(camera.width, camera.height, false)
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
        self.parameters_of(&array.parameters(self.sizes.sh_degree), rows)
    }

    fn upload_array(
        &mut self,
        array: ModelArray,
        rows: Range<usize>,
        values: &[f32],
    ) -> Result<(), BackendError> {
        assert!(rows.end <= self.rows, "rows {rows:?} of {}", self.rows);
        self.set_parameters(&array.parameters(self.sizes.sh_degree), rows, values)
    }

    fn state(&self) -> Vec<StateArray> {
        self.state_arrays()
    }

    fn save_rows(&self, name: &str, rows: Range<usize>) -> Result<Tensor, BackendError> {
        assert!(rows.end <= self.rows, "rows {rows:?} of {}", self.rows);
        self.state_tensor(name, rows)
    }

    fn restore_rows(&mut self, tensor: Tensor, rows: Range<usize>) -> Result<(), StateError> {
        assert!(rows.end <= self.rows, "rows {rows:?} of {}", self.rows);
        self.restore_tensor(tensor, rows)
    }

    fn stage_times(&self) -> &[(&'static str, Duration)] {
        &self.stage_times
    }
}

impl Inspect for GpuBackend {
    fn render_painted(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        colours: &[[f32; 3]],
    ) -> Result<Rendering, BackendError> {
        assert_eq!(colours.len(), self.rows, "one colour per row");
        // The colours temporarily replace band 0, which needs no additional device memory.
        let (band, rows) = (ModelArray::Sh.parameters(0), 0..self.rows);
        let own = self.parameters_of(&band, rows.clone())?;
        let painted: Vec<f32> = colours.as_flattened().iter().copied().map(rgb_to_dc).collect();
        self.set_parameters(&band, rows.clone(), &painted)?;
        let rendering = self.render(camera, background, 0);
        // If restoring fails, the device has failed, so that no step is ever taken with these colours.
        self.set_parameters(&band, rows, &own)?;
        rendering
    }
}

#[cfg(test)]
mod tests;
