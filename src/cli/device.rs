//! Which backend renders and trains: the options of the commands that need one, and their answer.

use clap::{Args, ValueEnum};

use super::console::Console;
use super::failure::Failure;
use crate::backend::gpu::{
    Accumulation, AdapterChoice, AdapterKind, AdapterSummary, GpuDevice, adapters, may_be_present,
};

/// Where to compute.
#[derive(Debug, Args)]
pub(super) struct DeviceArgs {
    /// Where to compute
    #[arg(long, value_enum, value_name = "WHERE", help_heading = "Device", default_value_t = Where::Auto)]
    pub(super) backend: Where,
    /// The adapter to compute on, by part of its name; `densify devices` lists them
    /// `[default: the best]`
    #[arg(long, value_name = "NAME", help_heading = "Device")]
    pub(super) gpu: Option<String>,
}

/// Where to compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Where {
    /// On a GPU if there is one, else on the processor
    Auto,
    /// On a GPU, or what stands for one
    Gpu,
    /// On the processor, with the native backend
    Cpu,
}

impl DeviceArgs {
    /// Opens the device to compute on; `None` is the processor. Says which it is. Without an
    /// `accumulation`, how it adds up gradients is its own choice.
    pub(super) fn open(
        &self,
        accumulation: Option<Accumulation>,
        console: &Console,
    ) -> Result<Option<GpuDevice>, Failure> {
        if self.backend == Where::Cpu {
            if self.gpu.is_some() {
                return Err(Failure::input(
                    "--gpu names an adapter, but --backend cpu uses none; leave one of them out",
                ));
            }
            return Ok(None);
        }
        let is_asked_for = self.backend == Where::Gpu || self.gpu.is_some();
        let is_there = || may_be_present() && adapters().iter().any(AdapterSummary::is_gpu);
        if !is_asked_for && !is_there() {
            console.say(
                "device   processor (no GPU was found; `densify devices` shows what there is)",
            );
            return Ok(None);
        }
        let device = GpuDevice::open(&AdapterChoice { name: self.gpu.clone(), accumulation })?;
        let adapter = device.adapter();
        let note = match adapter.kind {
            AdapterKind::Software => ", a software driver: --backend cpu is faster",
            _ => "",
        };
        console.say(format_args!("device   {} ({}){note}", adapter.name, adapter.interface));
        Ok(Some(device))
    }

    /// The same for what needs no gradients, and so nothing of a device but what all have.
    pub(super) fn open_to_render(&self, console: &Console) -> Result<Option<GpuDevice>, Failure> {
        self.open(Some(Accumulation::Slots), console)
    }
}
