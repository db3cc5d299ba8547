//! The line about the device that a run or a command computes on.

use densify_render::{AdapterKind, BackendKind, Device};

/// Describes the device, with a hint where another choice may be better.
pub(crate) fn describe(device: &Device) -> String {
    match device {
        Device::Processor if BackendKind::Gpu.is_built() => {
            "processor (`densify devices` lists GPUs)".to_owned()
        }
        Device::Processor => "processor".to_owned(),
        Device::Gpu(device) => {
            let adapter = device.adapter();
            let hint = match adapter.kind {
                AdapterKind::Software => ", a software driver: --backend cpu is faster",
                _ => "",
            };
            format!("{} ({}){hint}", adapter.name, adapter.interface)
        }
    }
}
