//! The backend under test, created the same way for every kind.

use super::compare::Limits;
use densify_core::gaussians::Gaussians;
use densify_render::cpu::{CpuBackend, InstructionSet};
use densify_render::gpu::GpuDevice;
use densify_render::{BackendError, Differentiable, Setup};

/// A backend under test.
#[derive(Debug, Clone)]
pub enum Subject {
    /// The native backend.
    Native {
        /// Instruction set of the kernels.
        instructions: InstructionSet,
        /// Worker threads; `None` uses all cores.
        threads: Option<usize>,
    },
    /// A GPU, or a software driver.
    Gpu(GpuDevice),
}

impl Subject {
    /// The native backend with its default options.
    pub const NATIVE: Self = Self::Native { instructions: InstructionSet::Best, threads: None };

    /// A name to show to the user.
    pub fn name(&self) -> String {
        match self {
            Self::Native { instructions: InstructionSet::Best, .. } => "native".into(),
            Self::Native { instructions, .. } => format!("native ({instructions})"),
            Self::Gpu(device) => {
                let (adapter, accumulation) = (device.adapter(), device.accumulation());
                let note = if accumulation.is_deterministic() {
                    String::new()
                } else {
                    format!(", accumulation={accumulation}")
                };
                format!("{} ({}, {}{note})", adapter.name, adapter.interface, adapter.driver)
            }
        }
    }

    /// Creates a backend with room for the model.
    ///
    /// # Errors
    /// See [`BackendError`].
    pub fn backend(&self, model: &Gaussians) -> Result<Box<dyn Differentiable>, BackendError> {
        self.backend_with(model, Setup::default())
    }

    /// Creates a backend with these options; a budget too small for the model is raised.
    ///
    /// # Errors
    /// See [`BackendError`].
    pub fn backend_with(
        &self,
        model: &Gaussians,
        mut setup: Setup,
    ) -> Result<Box<dyn Differentiable>, BackendError> {
        setup.budget.total = setup.budget.total.max(model.len());
        match self {
            Self::Native { instructions, threads } => {
                (setup.instructions, setup.threads) = (*instructions, *threads);
                let backend = CpuBackend::new(model, &setup)?;
                #[cfg(test)]
                return Ok(crate::fault_injection::wrap(backend));
                #[cfg(not(test))]
                Ok(Box::new(backend))
            }
            Self::Gpu(device) => device.backend(model, &setup),
        }
    }

    /// True if two runs give the same bits.
    pub fn is_deterministic(&self) -> bool {
        !matches!(self, Self::Gpu(device) if !device.accumulation().is_deterministic())
    }

    /// Tolerances of an image against the reference. Functions are less accurate on a GPU: WGSL allows `exp(x)`
    /// an error of 3 + 2·|x| units in the last place.
    pub fn limits(&self) -> Limits {
        match self {
            Self::Gpu(_) => Limits { interior: 1e-4, ..Limits::CPU },
            Self::Native { .. } => Limits::CPU,
        }
    }

    /// Tolerance of a gradient against the reference, relative to the largest of its parameter class. Single
    /// precision loses about 1e-6 in a sum over pixels; a hundred times that allows for cancellation, but
    /// not for a wrong term.
    pub fn gradient_tolerance(&self) -> f64 {
        match self {
            Self::Gpu(_) => 1e-3,
            Self::Native { .. } => 1e-4,
        }
    }
}
