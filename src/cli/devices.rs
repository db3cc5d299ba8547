//! `densify devices`: the GPU adapters and their limits.

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
/// not report how much memory there is in all. `WGPU_BACKEND` (vulkan, metal, dx12) and, for
/// Vulkan, `VK_DRIVER_FILES` select the drivers. Accumulation is the way gradients are added up:
/// slots repeat, atomics and cas are faster (`train --knob accumulation=NAME`, `train --deterministic`).
#[derive(Debug, Args)]
pub(super) struct DevicesArgs {}

pub(super) fn run(_: &DevicesArgs, console: &Console) -> Result<(), Failure> {
    let all = adapters();
    for adapter in &all {
        let kind = match adapter.kind {
            AdapterKind::Discrete => "graphics card",
            AdapterKind::Integrated => "integrated GPU",
            AdapterKind::Virtual => "virtual GPU",
            AdapterKind::Software => "software; used only on request",
            AdapterKind::Unknown => "of unknown kind",
        };
        console.result(format_args!("{}", adapter.name));
        console.result(format_args!("  {kind}; {}, {}", adapter.interface, adapter.driver));
        let largest = adapter.largest_binding.min(adapter.largest_buffer);
        console.result(format_args!("  largest buffer  {}", Bytes(largest)));
        let budgets = (0..=MAX_SH_DEGREE).map(|degree| {
            format!("{} at degree {degree}", grouped(adapter.largest_budget(degree) as usize))
        });
        let budgets: Vec<_> = budgets.collect();
        console.result(format_args!("  largest budget  {}", budgets.join(", ")));
        let own = adapter.accumulation();
        let others = adapter.accumulations.iter().filter(|way| **way != own);
        let others: Vec<_> = others.map(ToString::to_string).collect();
        let note = if others.is_empty() {
            String::new()
        } else {
            format!("; on request, {}", others.join(", "))
        };
        console.result(format_args!("  accumulation    {own}{note}"));
        for missing in &adapter.missing {
            console.result(format_args!("  cannot be used: {missing}"));
        }
    }
    if all.is_empty() {
        console.result("There is no adapter; the native backend trains on the processor.");
    }
    Ok(())
}
