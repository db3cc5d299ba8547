//! The choice of a backend. Only this module turns it into limits, a memory plan, and a backend.

use clap::ValueEnum;
use densify_policies::policy::Needs;
use serde::{Deserialize, Serialize};

use super::cpu::CpuBackend;
use super::gpu::{GpuDevice, adapters, may_be_present};
use super::{Accumulation, AdapterChoice, AdapterSummary, Backend, BackendError, Setup, Storage};
use densify_core::gaussians::Gaussians;
use densify_core::memory::Ledger;

/// The backend requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BackendChoice {
    /// On a GPU if there is one, else on the processor
    #[default]
    Auto,
    /// On a GPU, or a software driver that stands in for one
    Gpu,
    /// On the processor, with the native backend
    Cpu,
}

impl BackendChoice {
    /// The name of the choice.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Gpu => "gpu",
            Self::Cpu => "cpu",
        }
    }
}

/// A kind of backend.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BackendKind {
    /// The native backend.
    Cpu,
    /// The GPU backend.
    Gpu,
}

impl BackendKind {
    /// The name in messages.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Cpu => "native",
            Self::Gpu => "GPU",
        }
    }

    /// Returns whether this program was built with the backend.
    pub const fn is_built(self) -> bool {
        matches!(self, Self::Cpu) || cfg!(feature = "gpu")
    }

    /// The choice that requests this backend.
    pub const fn choice(self) -> BackendChoice {
        match self {
            Self::Cpu => BackendChoice::Cpu,
            Self::Gpu => BackendChoice::Gpu,
        }
    }
}

/// The device that a backend runs on.
#[derive(Debug, Clone, Default)]
pub enum Device {
    /// The processor.
    #[default]
    Processor,
    /// An open adapter.
    Gpu(GpuDevice),
}

impl Device {
    /// Opens the requested device. [`BackendChoice::Auto`] selects a GPU if there is one or if `name` is given,
    /// else the processor. Without an `accumulation`, a GPU uses the fastest that it supports.
    ///
    /// # Errors
    /// When no adapter has the name or supports the accumulation, and when a name is given for the processor.
    pub fn open(
        choice: BackendChoice,
        name: Option<&str>,
        accumulation: Option<Accumulation>,
    ) -> Result<Self, BackendError> {
        let gpu_exists = || may_be_present() && adapters().iter().any(AdapterSummary::is_gpu);
        match (choice, name) {
            (BackendChoice::Cpu, Some(_)) => Err(BackendError::AdapterUnused),
            (BackendChoice::Cpu, None) => Ok(Self::Processor),
            (BackendChoice::Auto, None) if !gpu_exists() => Ok(Self::Processor),
            _ => {
                let name = name.map(str::to_owned);
                GpuDevice::open(&AdapterChoice { name, accumulation }).map(Self::Gpu)
            }
        }
    }

    /// Opens a device for rendering only, with an accumulation that every adapter supports.
    ///
    /// # Errors
    /// The errors of [`open`](Self::open).
    pub fn open_to_render(choice: BackendChoice, name: Option<&str>) -> Result<Self, BackendError> {
        Self::open(choice, name, Some(Accumulation::Slots))
    }

    /// The kind of backend that runs on the device.
    pub fn kind(&self) -> BackendKind {
        match self {
            Self::Processor => BackendKind::Cpu,
            Self::Gpu(_) => BackendKind::Gpu,
        }
    }

    /// The name of the adapter; `None` for the processor.
    pub fn adapter(&self) -> Option<&str> {
        match self {
            Self::Processor => None,
            Self::Gpu(device) => Some(&device.adapter().name),
        }
    }

    /// The method of accumulating gradients on a GPU; `None` for the processor, which has only one.
    pub fn accumulation(&self) -> Option<Accumulation> {
        match self {
            Self::Processor => None,
            Self::Gpu(device) => Some(device.accumulation()),
        }
    }

    /// The largest budget that the device can hold at a degree.
    pub fn largest_budget(&self, sh_degree: u8) -> usize {
        match self {
            Self::Processor => u32::MAX as usize,
            Self::Gpu(device) => device.largest_budget(sh_degree) as usize,
        }
    }

    /// The maximum number of (row, tile) pairs that the device can hold at a time; `depth` as in [`Setup::depth`].
    pub fn most_pairs(&self, needs: &Needs, depth: bool) -> usize {
        match self {
            Self::Processor => u32::MAX as usize,
            Self::Gpu(device) => device.max_pairs(needs, depth) as usize,
        }
    }

    /// The bytes that a backend with these options allocates for models of this degree. Nothing is allocated yet.
    /// `threads` takes precedence over [`Setup::threads`].
    pub fn memory_plan(&self, sh_degree: u8, options: &Setup, threads: usize) -> Ledger {
        match self {
            Self::Processor => CpuBackend::memory_plan(sh_degree, options, threads),
            Self::Gpu(device) => device.memory_plan(sh_degree, options),
        }
    }

    /// Bytes of a ledger that count against a memory limit: on a GPU only the bytes in its memory, else all bytes.
    pub fn limited_bytes(&self, ledger: &Ledger) -> u64 {
        match self {
            Self::Processor => ledger.total(),
            Self::Gpu(_) => ledger.on_device(),
        }
    }

    /// The number of f32 columns that the host must allocate to read signals of `columns` columns; 0 if the backend
    /// lends its own memory.
    pub fn columns_on_host(&self, columns: usize) -> usize {
        match self {
            Self::Processor => 0,
            Self::Gpu(_) => columns,
        }
    }

    /// Compiles the GPU kernels for these needs and this storage, and for depth in the loss if `depth` is set, and verifies
    /// their results on a small scene. Done before memory is
    /// planned: the plan must include the memory that the driver takes.
    ///
    /// # Errors
    /// When a kernel does not compile or its results are wrong.
    pub fn prove(&self, needs: &Needs, storage: Storage, depth: bool) -> Result<(), BackendError> {
        match self {
            Self::Processor => Ok(()),
            Self::Gpu(device) => device.run_canary(needs, storage, depth),
        }
    }

    /// Makes a backend that holds the model.
    ///
    /// # Errors
    /// When the device's limits or memory do not suffice.
    pub fn backend(
        &self,
        model: &Gaussians,
        options: &Setup,
    ) -> Result<Box<dyn Backend>, BackendError> {
        Ok(match self {
            Self::Processor => Box::new(CpuBackend::new(model, options)?),
            Self::Gpu(device) => device.backend(model, options)?,
        })
    }
}
