//! Where the cases run: a backend with what only tests and research look at.

use densify_policies::policy::Needs;

use super::compare::Limits;
use crate::backend::cpu::{CpuBackend, CpuOptions, ImageGradient, ModelGradient};
use crate::backend::gpu::{GpuBackend, GpuDevice, GpuOptions};
use crate::backend::{Backend, BackendError, Rendering, StepOutput};
use crate::camera::Camera;
use crate::dataset::images::Image8;
use crate::gaussians::Gaussians;

/// What is tested.
#[derive(Debug, Clone)]
pub enum Bench {
    /// The native backend.
    Native {
        /// Worker threads; `None` takes all cores.
        threads: Option<usize>,
    },
    /// A GPU, or what stands for one.
    Gpu(GpuDevice),
    /// The native backend, which errs on purpose.
    #[cfg(test)]
    Sabotaged(super::sabotage::Sabotage),
}

/// What a backend is made for, beside its model. The default is what the model needs.
#[derive(Debug, Clone, Default)]
pub(super) struct Room {
    /// Most rows; the model's, if these are more.
    pub(super) budget: usize,
    /// Most (row, tile) entries held at a time.
    pub(super) tile_cap: Option<usize>,
    /// Largest image that its ledger shall cover `[px]`.
    pub(super) largest_image: (u32, u32),
    /// Signals to collect.
    pub(super) needs: Needs,
}

/// A backend with gradients and losses on their own.
pub(super) trait Subject: Backend {
    /// Renders a view and differentiates Σ image · upstream.
    fn differentiate(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        upstream: &ImageGradient,
    ) -> Result<(Rendering, ModelGradient), BackendError>;

    /// The training loss of a rendering, and its gradient.
    fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> Result<(StepOutput, Vec<f32>), BackendError>;
}

impl Subject for CpuBackend {
    fn differentiate(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        upstream: &ImageGradient,
    ) -> Result<(Rendering, ModelGradient), BackendError> {
        self.differentiate(camera, background, sh_degree, upstream)
    }

    fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> Result<(StepOutput, Vec<f32>), BackendError> {
        Ok(self.loss(rendering, target, background))
    }
}

impl Subject for GpuBackend {
    fn differentiate(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        upstream: &ImageGradient,
    ) -> Result<(Rendering, ModelGradient), BackendError> {
        self.differentiate(camera, background, sh_degree, upstream)
    }

    fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> Result<(StepOutput, Vec<f32>), BackendError> {
        self.loss(rendering, target, background)
    }
}

impl Bench {
    /// What is tested, for people.
    #[must_use]
    pub fn name(&self) -> String {
        match self {
            Self::Native { .. } => "native".into(),
            #[cfg(test)]
            Self::Sabotaged(how) => format!("native, with errors in {how:?}"),
            Self::Gpu(device) => {
                let (adapter, way) = (device.adapter(), device.accumulation());
                let note = match way.is_deterministic() {
                    true => String::new(),
                    false => format!(", accumulation={way}"),
                };
                format!("{} ({}, {}{note})", adapter.name, adapter.interface, adapter.driver)
            }
        }
    }

    /// A backend for a model.
    pub(super) fn backend(&self, model: &Gaussians) -> Result<Box<dyn Subject>, BackendError> {
        self.with(model, Room::default())
    }

    /// A backend with room for more.
    pub(super) fn with(
        &self,
        model: &Gaussians,
        room: Room,
    ) -> Result<Box<dyn Subject>, BackendError> {
        let Room { budget, tile_cap, largest_image, needs } = room;
        let budget = budget.max(model.len()).max(1);
        let native = |threads: Option<usize>, needs| {
            let mut options = CpuOptions::new(budget);
            options.threads = threads;
            options.tile_cap = tile_cap.unwrap_or(options.tile_cap);
            (options.largest_image, options.needs) = (largest_image, needs);
            CpuBackend::new(model, &options)
        };
        match self {
            Self::Native { threads } => Ok(Box::new(native(*threads, needs)?)),
            #[cfg(test)]
            Self::Sabotaged(how) => {
                Ok(Box::new(super::sabotage::Saboteur::new(native(None, needs)?, *how)))
            }
            Self::Gpu(device) => {
                let options =
                    GpuOptions { tile_cap, largest_image, needs, ..GpuOptions::new(budget) };
                Ok(Box::new(GpuBackend::new(model, &options, device)?))
            }
        }
    }

    /// How far an image may be from the reference's. The functions of a GPU are less accurate: an
    /// exponential of WGSL may be off by 3 + 2·|x| units in the last place.
    pub(super) fn limits(&self) -> Limits {
        match self {
            Self::Gpu(_) => Limits { interior: 1e-4, ..Limits::CPU },
            _ => Limits::CPU,
        }
    }

    /// How far a gradient may be from the reference's, against the largest of its class. Single
    /// precision loses about 1e-6 in a sum over pixels; a hundred times that leaves room for
    /// cancellation and none for a wrong term.
    pub(super) fn gradient(&self) -> f64 {
        match self {
            Self::Gpu(_) => 1e-3,
            _ => 1e-4,
        }
    }
}
