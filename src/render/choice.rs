//! Which backends there are: the one place that turns a choice into limits, a promise of bytes, and a
//! backend.

use clap::ValueEnum;
use densify_policies::policy::Needs;
use serde::{Deserialize, Serialize};

use super::cpu::CpuBackend;
use super::gpu::{GpuDevice, adapters, may_be_present};
use super::{
    Accumulation, AdapterChoice, AdapterKind, AdapterSummary, Backend, BackendError, Setup,
};
use densify_core::gaussians::Gaussians;
use densify_core::memory::Ledger;

/// Where to compute, as it is asked for.
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
    /// Its word for `--backend`.
    #[must_use]
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
    /// As it is called in messages.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Cpu => "native",
            Self::Gpu => "GPU",
        }
    }

    /// The choice that asks for it.
    #[must_use]
    pub const fn choice(self) -> BackendChoice {
        match self {
            Self::Cpu => BackendChoice::Cpu,
            Self::Gpu => BackendChoice::Gpu,
        }
    }
}

/// What a backend runs on.
#[derive(Debug, Clone, Default)]
pub enum Device {
    /// The processor.
    #[default]
    Processor,
    /// An adapter that has been opened.
    Gpu(GpuDevice),
}

impl Device {
    /// Opens what is chosen: with [`BackendChoice::Auto`] a GPU where there is one or its name is given,
    /// else the processor. Without an `accumulation` a GPU takes the fastest that it has.
    ///
    /// # Errors
    /// When no adapter has the name or the accumulation, and when a name is given for the processor.
    pub fn open(
        choice: BackendChoice,
        name: Option<&str>,
        accumulation: Option<Accumulation>,
    ) -> Result<Self, BackendError> {
        let is_there = || may_be_present() && adapters().iter().any(AdapterSummary::is_gpu);
        match (choice, name) {
            (BackendChoice::Cpu, Some(_)) => Err(BackendError::OverLimit(
                "--gpu names an adapter, but --backend cpu uses none; leave one of them out".into(),
            )),
            (BackendChoice::Cpu, None) => Ok(Self::Processor),
            (BackendChoice::Auto, None) if !is_there() => Ok(Self::Processor),
            _ => {
                let name = name.map(str::to_owned);
                GpuDevice::open(&AdapterChoice { name, accumulation }).map(Self::Gpu)
            }
        }
    }

    /// The same to render on: nothing is needed but what all adapters have.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_to_render(choice: BackendChoice, name: Option<&str>) -> Result<Self, BackendError> {
        Self::open(choice, name, Some(Accumulation::Slots))
    }

    /// Which backend runs on it.
    #[must_use]
    pub fn kind(&self) -> BackendKind {
        match self {
            Self::Processor => BackendKind::Cpu,
            Self::Gpu(_) => BackendKind::Gpu,
        }
    }

    /// The adapter's name; `None` for the processor.
    #[must_use]
    pub fn adapter(&self) -> Option<&str> {
        match self {
            Self::Processor => None,
            Self::Gpu(device) => Some(&device.adapter().name),
        }
    }

    /// How gradients are added up on a GPU; `None` for the processor, which has one way.
    #[must_use]
    pub fn accumulation(&self) -> Option<Accumulation> {
        match self {
            Self::Processor => None,
            Self::Gpu(device) => Some(device.accumulation()),
        }
    }

    /// A line about it.
    #[must_use]
    pub fn describe(&self) -> String {
        match self {
            Self::Processor if cfg!(feature = "gpu") => {
                "processor (`densify devices` lists GPUs)".to_owned()
            }
            Self::Processor => "processor".to_owned(),
            Self::Gpu(device) => {
                let adapter = device.adapter();
                let note = match adapter.kind {
                    AdapterKind::Software => ", a software driver: --backend cpu is faster",
                    _ => "",
                };
                format!("{} ({}){note}", adapter.name, adapter.interface)
            }
        }
    }

    /// Most rows that a backend on it can hold at a degree.
    #[must_use]
    pub fn largest_budget(&self, sh_degree: u8) -> usize {
        match self {
            Self::Processor => u32::MAX as usize,
            Self::Gpu(device) => device.largest_budget(sh_degree) as usize,
        }
    }

    /// Most (row, tile) pairs that a backend on it can hold at a time with these needs.
    #[must_use]
    pub fn most_pairs(&self, needs: &Needs) -> usize {
        match self {
            Self::Processor => u32::MAX as usize,
            Self::Gpu(device) => device.most_pairs(needs) as usize,
        }
    }

    /// Bytes per buffer of a backend with these options for models of this degree; nothing is allocated.
    /// The promise is for `threads` threads, whatever the options say.
    #[must_use]
    pub fn promise(&self, sh_degree: u8, options: &Setup, threads: usize) -> Ledger {
        match self {
            Self::Processor => CpuBackend::promise(sh_degree, options, threads),
            Self::Gpu(device) => device.promise(sh_degree, options),
        }
    }

    /// Bytes of a ledger that `--memory` limits: those on the device where there is one, else all.
    #[must_use]
    pub fn limited_bytes(&self, ledger: &Ledger) -> u64 {
        match self {
            Self::Processor => ledger.total(),
            Self::Gpu(_) => ledger.on_device(),
        }
    }

    /// f32 columns of a row that the host needs beside the backend while signals are read: none where
    /// the backend lends its own memory for them.
    #[must_use]
    pub fn columns_on_host(&self, columns: usize) -> usize {
        match self {
            Self::Processor => 0,
            Self::Gpu(_) => columns,
        }
    }

    /// Has a GPU's driver compile what a backend with these needs runs, and shows that it computes soundly: what it
    /// takes of the process, a promise must know.
    ///
    /// # Errors
    /// When it does not.
    pub fn prove(&self, needs: &Needs) -> Result<(), BackendError> {
        match self {
            Self::Processor => Ok(()),
            Self::Gpu(device) => device.prove(needs),
        }
    }

    /// A backend that holds the model.
    ///
    /// # Errors
    /// When device or memory do not suffice.
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
