//! What is tested: a backend, made the same way whichever it is.

use densify_policies::policy::Needs;

use super::compare::Limits;
use crate::backend::cpu::{CpuBackend, CpuOptions, InstructionSet};
use crate::backend::gpu::GpuDevice;
use crate::backend::{BackendError, BackendOptions, Differentiable, Shortcuts, Storage};
use crate::gaussians::Gaussians;

/// What is tested.
#[derive(Debug, Clone)]
pub enum Subject {
    /// The native backend.
    Native {
        /// What its kernels are compiled for.
        instructions: InstructionSet,
        /// Worker threads; `None` takes all cores.
        threads: Option<usize>,
    },
    /// A GPU, or what stands for one.
    Gpu(GpuDevice),
}

/// What a backend is made for, beside its model. The default is what the model needs.
#[derive(Debug, Clone, Default)]
pub struct Setup {
    /// Most rows; the model's, if these are more.
    pub budget: usize,
    /// Near plane `[scene units]`; 0.01 without one.
    pub near: Option<f32>,
    /// Most (row, tile) entries held at a time.
    pub tile_cap: Option<usize>,
    /// Most gradient records held at a time; only the native backend has this limit.
    pub record_cap: Option<usize>,
    /// Largest image that its ledger shall cover `[px]`.
    pub largest_image: (u32, u32),
    /// How parameters and moments are stored; only the native backend has the choice.
    pub storage: Storage,
    /// Signals to collect.
    pub needs: Needs,
    /// Where to compute less than could be.
    pub shortcuts: Shortcuts,
}

impl Subject {
    /// The native backend as a run has it by default.
    pub const NATIVE: Self = Self::Native { instructions: InstructionSet::Best, threads: None };

    /// What is tested, for people.
    #[must_use]
    pub fn name(&self) -> String {
        match self {
            Self::Native { instructions: InstructionSet::Best, .. } => "native".into(),
            Self::Native { instructions, .. } => format!("native ({instructions})"),
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
    ///
    /// # Errors
    /// See [`BackendError`].
    pub fn backend(&self, model: &Gaussians) -> Result<Box<dyn Differentiable>, BackendError> {
        self.with(model, Setup::default())
    }

    /// A backend with room for more.
    ///
    /// # Errors
    /// See [`BackendError`].
    pub fn with(
        &self,
        model: &Gaussians,
        setup: Setup,
    ) -> Result<Box<dyn Differentiable>, BackendError> {
        let Setup { budget, near, tile_cap, record_cap, largest_image, storage, needs, shortcuts } =
            setup;
        let budget = budget.max(model.len()).max(1);
        match self {
            Self::Native { instructions, threads } => {
                let mut options = CpuOptions::new(budget);
                (options.instructions, options.threads) = (*instructions, *threads);
                options.near = near.unwrap_or(options.near);
                options.tile_cap = tile_cap.unwrap_or(options.tile_cap);
                options.record_cap = record_cap.unwrap_or(options.record_cap);
                (options.largest_image, options.needs) = (largest_image, needs);
                (options.storage, options.shortcuts) = (storage, shortcuts);
                Ok(Box::new(CpuBackend::new(model, &options)?))
            }
            Self::Gpu(device) => {
                let mut options = BackendOptions {
                    tile_cap,
                    largest_image,
                    needs,
                    shortcuts,
                    ..BackendOptions::new(budget)
                };
                options.near = near.unwrap_or(options.near);
                device.backend(model, &options)
            }
        }
    }

    /// Whether two runs give the same bits.
    #[must_use]
    pub fn is_deterministic(&self) -> bool {
        match self {
            Self::Gpu(device) => device.accumulation().is_deterministic(),
            Self::Native { .. } => true,
        }
    }

    /// How far an image may be from the reference's. The functions of a GPU are less accurate: an
    /// exponential of WGSL may be off by 3 + 2·|x| units in the last place.
    #[must_use]
    pub fn limits(&self) -> Limits {
        match self {
            Self::Gpu(_) => Limits { interior: 1e-4, ..Limits::CPU },
            Self::Native { .. } => Limits::CPU,
        }
    }

    /// How far a gradient may be from the reference's, against the largest of its class. Single
    /// precision loses about 1e-6 in a sum over pixels; a hundred times that leaves room for
    /// cancellation and none for a wrong term.
    #[must_use]
    pub fn gradient(&self) -> f64 {
        match self {
            Self::Gpu(_) => 1e-3,
            Self::Native { .. } => 1e-4,
        }
    }
}
