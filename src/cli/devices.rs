//! `densify devices`: lists the GPU adapters and their limits.

use clap::Args;

use super::console::Console;
use densify_core::gaussians::MAX_SH_DEGREE;
use densify_core::memory::Bytes;
use densify_core::numbers::grouped;
use densify_render::AdapterKind;
use densify_render::gpu::adapters;
use densify_run::failure::Failure;

/// Lists the adapters that can train and render, with their limits.
///
/// Choose one with `--gpu NAME`. The largest budget is what one buffer of the adapter can hold; drivers do
/// not report the total memory. `WGPU_BACKEND` (vulkan, metal, dx12) and, for Vulkan, `VK_DRIVER_FILES`
/// select the drivers. Accumulation is the way gradients are added up: slots is deterministic; atomics and
/// cas are faster (`train --knob accumulation=NAME`, `train --deterministic`).
#[derive(Debug, Args)]
pub(super) struct DevicesArgs {}

pub(super) fn run(_: &DevicesArgs, console: &Console) -> Result<(), Failure> {
    let adapters = adapters();
    for adapter in &adapters {
        let kind = match adapter.kind {
            AdapterKind::Discrete => "graphics card",
            AdapterKind::Integrated => "integrated GPU",
            AdapterKind::Virtual => "virtual GPU",
            AdapterKind::Software => "software; used only on request",
            AdapterKind::Unknown => "unknown kind",
        };
        console.result(format_args!("{}", adapter.name));
        console.result(format_args!("  {kind}; {}, {}", adapter.interface, adapter.driver));
        let largest = adapter.largest_binding.min(adapter.largest_buffer);
        console.result(format_args!("  largest buffer  {}", Bytes(largest)));
        let budgets: Vec<_> = (0..=MAX_SH_DEGREE)
            .map(|degree| (degree, grouped(adapter.largest_budget(degree) as usize)))
            .map(|(degree, rows)| format!("{rows} at degree {degree}"))
            .collect();
        console.result(format_args!("  largest budget  {}", budgets.join(", ")));
        let default = adapter.accumulation();
        let others = adapter.accumulations.iter().filter(|method| **method != default);
        let others: Vec<_> = others.map(ToString::to_string).collect();
        let note = if others.is_empty() { "" } else { "; on request, " };
        console.result(format_args!("  accumulation    {default}{note}{}", others.join(", ")));
        for missing in &adapter.missing {
            console.result(format_args!("  cannot be used: {missing}"));
        }
    }
    if adapters.is_empty() {
        console.result("There is no adapter; the native backend trains on the processor.");
    }
    Ok(())
}
