//! Enumerates the adapters, checks what they lack, and chooses one.

use wgpu::{
    Adapter, Backends, DeviceType, Features, Instance, InstanceDescriptor, InstanceFlags, Limits,
};

use super::device::wait;
use super::rows::widest_row;
use crate::{Accumulation, AdapterChoice, AdapterKind, AdapterSummary, BackendError};

/// Features that a kind of accumulation requires, in addition to those of all kernels.
pub(super) fn features_for(accumulation: Accumulation) -> Features {
    match accumulation {
        Accumulation::Slots => Features::empty(),
        Accumulation::SubgroupCas => Features::SUBGROUP,
        Accumulation::SubgroupAtomics => Features::SUBGROUP | Features::SHADER_FLOAT32_ATOMIC,
    }
}

/// Names of the features that an adapter lacks for a kind of accumulation.
fn missing_for(accumulation: Accumulation, available: Features) -> Vec<&'static str> {
    let lacking = features_for(accumulation).difference(available);
    let names = [
        (Features::SUBGROUP, "subgroup operations (SUBGROUP)"),
        (Features::SHADER_FLOAT32_ATOMIC, "atomic addition of f32 (SHADER_FLOAT32_ATOMIC)"),
    ];
    names
        .into_iter()
        .filter(|(feature, _)| lacking.contains(*feature))
        .map(|(_, name)| name)
        .collect()
}

impl AdapterSummary {
    fn new(adapter: &Adapter) -> Self {
        let info = adapter.get_info();
        let (limits, features) = (adapter.limits(), adapter.features());
        let is_supported = |a: &Accumulation| missing_for(*a, features).is_empty();
        Self {
            kind: match info.device_type {
                DeviceType::DiscreteGpu => AdapterKind::Discrete,
                DeviceType::IntegratedGpu => AdapterKind::Integrated,
                DeviceType::VirtualGpu => AdapterKind::Virtual,
                DeviceType::Cpu => AdapterKind::Software,
                DeviceType::Other => AdapterKind::Unknown,
            },
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            interface: info.backend.to_string(),
            name: info.name,
            largest_binding: limits.max_storage_buffer_binding_size,
            largest_buffer: limits.max_buffer_size,
            missing: missing(&limits, features),
            accumulations: Accumulation::ALL.into_iter().filter(is_supported).collect(),
        }
    }

    /// Largest budget that this adapter supports at an SH degree: each array of rows (the geometry, a band of
    /// coefficients, the sums of gradients) must fit into one buffer.
    pub fn largest_budget(&self, sh_degree: u8) -> u64 {
        let largest = self.largest_binding.min(self.largest_buffer);
        (largest / widest_row(sh_degree)).min(MAX_ROWS)
    }
}

/// False only if there is certainly no GPU: on Linux, if no device file of a GPU exists. Checked first because loading
/// drivers, even software drivers, takes time, and memory that is never freed.
pub fn may_be_present() -> bool {
    const NODES: [&str; 6] =
        ["/dev/dri", "/dev/nvidiactl", "/dev/dxg", "/dev/kgsl-3d0", "/dev/mali0", "/dev/kfd"];
    !cfg!(target_os = "linux") || NODES.iter().any(|node| std::path::Path::new(node).exists())
}

/// Largest number of rows for which all indices in the shaders fit into 32 bits.
const MAX_ROWS: u64 = 1 << 25;

/// Limits that the kernels rely on; every WebGPU device has them.
const STORAGE_BUFFERS: u32 = 8;
const INVOCATIONS: u32 = 256;
const SHARED_BYTES: u32 = 16_384;
const GROUPS: u32 = 65_535;
const IMMEDIATE_BYTES: u32 = 16;

fn missing(limits: &Limits, features: Features) -> Vec<String> {
    let mut missing = Vec::new();
    let mut require = |limit: &str, available: u32, needed: u32| {
        if available < needed {
            missing.push(format!("{limit}: {needed} needed, {available} available"));
        }
    };
    require(
        "storage buffers per kernel",
        limits.max_storage_buffers_per_shader_stage,
        STORAGE_BUFFERS,
    );
    require("invocations per workgroup", limits.max_compute_invocations_per_workgroup, INVOCATIONS);
    require("bytes of workgroup memory", limits.max_compute_workgroup_storage_size, SHARED_BYTES);
    require("workgroups per dimension", limits.max_compute_workgroups_per_dimension, GROUPS);
    require("bytes of immediate data", limits.max_immediate_size, IMMEDIATE_BYTES);
    if !features.contains(Features::IMMEDIATES) {
        missing.push("immediate data (push constants)".into());
    }
    missing
}

fn instance() -> Instance {
    let mut descriptor = InstanceDescriptor::new_without_display_handle();
    descriptor.backends =
        Backends::from_env().unwrap_or(Backends::VULKAN | Backends::METAL | Backends::DX12);
    // No validation of indirect dispatches: their sizes are bounded by our own kernels.
    descriptor.flags = InstanceFlags::empty();
    Instance::new(descriptor)
}

pub(super) fn enumerate() -> Vec<(Adapter, AdapterSummary)> {
    let all = wait(instance().enumerate_adapters(Backends::all()));
    let summarise = |adapter| {
        let summary = AdapterSummary::new(&adapter);
        (adapter, summary)
    };
    all.into_iter().map(summarise).collect()
}

/// All adapters that `WGPU_BACKEND` and the variables of the drivers admit.
pub fn adapters() -> Vec<AdapterSummary> {
    enumerate().into_iter().map(|(_, summary)| summary).collect()
}

impl AdapterChoice {
    /// The accumulation to use on an adapter: the requested one, or the adapter's fastest.
    ///
    /// # Errors
    /// [`BackendError::NoAdapter`], with what the adapter lacks and supports, if it does not support the requested one.
    pub(super) fn accumulation(
        &self,
        adapter: &AdapterSummary,
        features: Features,
    ) -> Result<Accumulation, BackendError> {
        let Some(wanted) = self.accumulation else { return Ok(adapter.accumulation()) };
        let missing = missing_for(wanted, features);
        if missing.is_empty() {
            return Ok(wanted);
        }
        let supported: Vec<String> =
            adapter.accumulations.iter().map(|a| format!("accumulation={a}")).collect();
        Err(BackendError::NoAdapter(format!(
            "accumulation={wanted}: {} lacks {}; it supports {}",
            adapter.name,
            missing.join(" and "),
            supported.join(" or ")
        )))
    }

    fn matches(&self, summary: &AdapterSummary) -> bool {
        let Some(name) = &self.name else { return true };
        let name = name.to_lowercase();
        [&summary.name, &summary.driver].iter().any(|s| s.to_lowercase().contains(&name))
    }
}

/// Index of the best adapter that matches the choice and lacks nothing. Software drivers come last.
///
/// # Errors
/// [`BackendError::NoAdapter`] with the adapters found and what they lack.
pub(super) fn choose(
    all: &[AdapterSummary],
    choice: &AdapterChoice,
) -> Result<usize, BackendError> {
    let rank = |kind: AdapterKind| match kind {
        AdapterKind::Discrete => 0,
        AdapterKind::Integrated => 1,
        AdapterKind::Virtual => 2,
        AdapterKind::Unknown => 3,
        AdapterKind::Software => 4,
    };
    let matching: Vec<usize> = (0..all.len()).filter(|&i| choice.matches(&all[i])).collect();
    let usable = matching.iter().copied().filter(|&i| all[i].missing.is_empty());
    if let Some(best) = usable.min_by_key(|&i| (rank(all[i].kind), i)) {
        return Ok(best);
    }
    let describe = |i: &usize| {
        let AdapterSummary { name, missing, .. } = &all[*i];
        format!("{name} ({})", missing.join("; "))
    };
    let names: Vec<&str> = all.iter().map(|s| &*s.name).collect();
    Err(BackendError::NoAdapter(match (&choice.name, matching.is_empty()) {
        (_, false) => {
            let lacking: Vec<String> = matching.iter().map(describe).collect();
            format!("no adapter has all required features: {}", lacking.join(", "))
        }
        (Some(name), true) if !all.is_empty() => {
            format!("no adapter is called `{name}`; available: {}", names.join(", "))
        }
        _ => "no adapter was found; install a Vulkan, Metal or DX12 driver".into(),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn adapter(name: &str, kind: AdapterKind, missing: &[&str]) -> AdapterSummary {
        AdapterSummary {
            name: name.into(),
            interface: "vulkan".into(),
            driver: "mesa".into(),
            kind,
            largest_binding: 128 << 20,
            largest_buffer: 256 << 20,
            missing: missing.iter().map(|&m| m.to_owned()).collect(),
            accumulations: vec![Accumulation::Slots],
        }
    }

    #[test]
    fn the_accumulation_is_the_requested_or_the_fastest_supported_one() {
        use Accumulation::{Slots, SubgroupAtomics, SubgroupCas};
        let subgroups = Features::SUBGROUP;
        let both = subgroups | Features::SHADER_FLOAT32_ATOMIC;
        let with = |features| AdapterSummary {
            accumulations: Accumulation::ALL
                .into_iter()
                .filter(|a| missing_for(*a, features).is_empty())
                .collect(),
            ..adapter("Card", AdapterKind::Discrete, &[])
        };
        let chosen = |features, accumulation| {
            let choice = AdapterChoice { name: None, accumulation };
            choice.accumulation(&with(features), features)
        };
        // By default the fastest.
        for (features, expected) in [
            (Features::empty(), Slots),
            (subgroups, SubgroupCas),
            (both, SubgroupCas),
            // Atomics need subgroups as well.
            (Features::SHADER_FLOAT32_ATOMIC, Slots),
        ] {
            assert_eq!(chosen(features, None).unwrap(), expected, "{features:?}");
        }
        // The requested one, or an error; `tests/it/cli/accumulation.rs` checks the message.
        for wanted in Accumulation::ALL {
            assert_eq!(chosen(both, Some(wanted)).unwrap(), wanted);
            assert_eq!(Accumulation::from_name(wanted.name()), Some(wanted));
        }
        let error = |features, wanted| chosen(features, Some(wanted)).unwrap_err().to_string();
        let without = error(subgroups, SubgroupAtomics);
        assert!(without.contains("accumulation=slots or accumulation=cas"), "{without}");
        assert!(!error(Features::empty(), SubgroupCas).contains("FLOAT32"));
    }

    #[test]
    fn the_best_adapter_that_matches_is_taken() {
        let all = [
            adapter("llvmpipe (LLVM 15)", AdapterKind::Software, &[]),
            adapter("Old Card", AdapterKind::Discrete, &["workgroups per dimension"]),
            adapter("Shared", AdapterKind::Integrated, &[]),
            adapter("Card", AdapterKind::Discrete, &[]),
        ];
        let named = |name: &str| AdapterChoice { name: Some(name.into()), accumulation: None };
        assert_eq!(choose(&all, &AdapterChoice::default()).unwrap(), 3);
        assert_eq!(choose(&all[..3], &AdapterChoice::default()).unwrap(), 2);
        assert_eq!(choose(&all[..2], &AdapterChoice::default()).unwrap(), 0);
        assert_eq!(choose(&all, &named("LLVMPIPE")).unwrap(), 0);
        let error = |all: &[AdapterSummary], choice| choose(all, &choice).unwrap_err().to_string();
        assert!(error(&all, named("old")).contains("workgroups per dimension"));
        assert!(error(&all, named("geforce")).contains("Shared"));
        assert!(error(&[], named("x")).contains("install"));
        assert!(all[3].is_gpu() && !all[0].is_gpu() && !all[1].is_gpu());
        // 128 MiB: the seven coefficients of band 3 are the widest array.
        assert_eq!(all[0].largest_budget(3), (128 << 20) / 84);
    }
}
