//! What is tested: a backend, made the same way whichever it is.

use super::compare::Limits;
use densify_core::gaussians::Gaussians;
use densify_render::cpu::{CpuBackend, InstructionSet};
use densify_render::gpu::GpuDevice;
use densify_render::{BackendError, Differentiable, Setup};

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

    /// A backend with room for more; it has room for the model whatever the budget.
    ///
    /// # Errors
    /// See [`BackendError`].
    pub fn with(
        &self,
        model: &Gaussians,
        mut setup: Setup,
    ) -> Result<Box<dyn Differentiable>, BackendError> {
        setup.budget = setup.budget.max(model.len());
        match self {
            Self::Native { instructions, threads } => {
                (setup.instructions, setup.threads) = (*instructions, *threads);
                Ok(Box::new(CpuBackend::new(model, &setup)?))
            }
            Self::Gpu(device) => device.backend(model, &setup),
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
