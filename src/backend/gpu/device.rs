//! The device: which adapters there are, which one is taken, what it must be able to do, and how its
//! errors become ours.

use std::collections::HashMap;
use std::future::Future;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Waker};

use wgpu::{
    Adapter, Backends, DeviceDescriptor, DeviceType, ErrorFilter, Features, Instance,
    InstanceDescriptor, InstanceFlags, Limits,
};

use super::buffers::{Planned, Sizes};
use super::pipelines::Pipelines;
use crate::backend::BackendError;
use crate::memory::Bytes;

/// What an adapter is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AdapterKind {
    /// A graphics card.
    Discrete,
    /// Graphics that share the processor's memory.
    Integrated,
    /// A card that a virtual machine is lent.
    Virtual,
    /// A program on the processor.
    Software,
    /// The driver does not say.
    Unknown,
}

/// An adapter and the limits that matter.
#[derive(Debug, Clone, PartialEq)]
pub struct AdapterSummary {
    /// As the driver names it.
    pub name: String,
    /// The interface: vulkan, metal, dx12.
    pub interface: String,
    /// The driver and its version.
    pub driver: String,
    /// What it is.
    pub kind: AdapterKind,
    /// Largest buffer that a kernel can use `[bytes]`.
    pub largest_binding: u64,
    /// Largest buffer `[bytes]`.
    pub largest_buffer: u64,
    /// What it lacks to be used, if anything.
    pub missing: Vec<String>,
}

impl AdapterSummary {
    fn new(adapter: &Adapter) -> Self {
        let info = adapter.get_info();
        let limits = adapter.limits();
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
            missing: missing(&limits, adapter.features()),
        }
    }

    /// Largest budget whose parameters this adapter can hold in one piece each, at a degree: one
    /// band of the coefficients, or the geometry, or the gradients of a row.
    #[must_use]
    pub fn largest_budget(&self, sh_degree: u8) -> u64 {
        let per_row = if sh_degree >= 3 { 84 } else { 80 };
        (self.largest_binding.min(self.largest_buffer) / per_row).min(MOST_ROWS)
    }

    /// Whether `auto` may take it: a GPU that lacks nothing.
    #[must_use]
    pub fn is_gpu(&self) -> bool {
        self.kind != AdapterKind::Software && self.missing.is_empty()
    }
}

/// Rows that the numbering of work allows: 2³² bytes of nothing are indexed beyond.
pub(super) const MOST_ROWS: u64 = 1 << 25;

/// What every kernel is written for; all of it is what WebGPU promises everywhere.
const STORAGE_BUFFERS: u32 = 8;
const INVOCATIONS: u32 = 256;
const SHARED_BYTES: u32 = 16_384;
const GROUPS: u32 = 65_535;
const IMMEDIATE_BYTES: u32 = 16;

fn missing(limits: &Limits, features: Features) -> Vec<String> {
    let mut missing = Vec::new();
    let mut need = |what: &str, has: u32, needs: u32| {
        if has < needs {
            missing.push(format!("{what}: {needs} needed, {has} there"));
        }
    };
    need("storage buffers per kernel", limits.max_storage_buffers_per_shader_stage, STORAGE_BUFFERS);
    need("invocations per workgroup", limits.max_compute_invocations_per_workgroup, INVOCATIONS);
    need("bytes of workgroup memory", limits.max_compute_workgroup_storage_size, SHARED_BYTES);
    need("workgroups per dimension", limits.max_compute_workgroups_per_dimension, GROUPS);
    need("bytes of immediate data", limits.max_immediate_size, IMMEDIATE_BYTES);
    if !features.contains(Features::IMMEDIATES) {
        missing.push("immediate data (push constants)".into());
    }
    missing
}

/// Runs a future of wgpu's to its end; on native systems they are ready at once.
pub(super) fn wait<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    let mut context = Context::from_waker(Waker::noop());
    loop {
        if let Poll::Ready(value) = future.as_mut().poll(&mut context) {
            return value;
        }
        std::thread::yield_now();
    }
}

fn instance() -> Instance {
    let mut descriptor = InstanceDescriptor::new_without_display_handle();
    descriptor.backends =
        Backends::from_env().unwrap_or(Backends::VULKAN | Backends::METAL | Backends::DX12);
    // Indirect dispatches take numbers that our own kernels have bounded.
    descriptor.flags = InstanceFlags::empty();
    Instance::new(descriptor)
}

fn enumerate() -> Vec<(Adapter, AdapterSummary)> {
    let all = wait(instance().enumerate_adapters(Backends::all()));
    all.into_iter().map(|a| { let s = AdapterSummary::new(&a); (a, s) }).collect()
}

/// All adapters, as `WGPU_BACKEND` and the drivers' own variables let them be seen.
#[must_use]
pub fn adapters() -> Vec<AdapterSummary> {
    enumerate().into_iter().map(|(_, summary)| summary).collect()
}

/// Which adapter to take.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct AdapterChoice {
    /// Part of its name or its driver's, in any case of letters; the best there is without one.
    pub name: Option<String>,
}

impl AdapterChoice {
    fn matches(&self, summary: &AdapterSummary) -> bool {
        let Some(name) = &self.name else { return true };
        let name = name.to_lowercase();
        [&summary.name, &summary.driver].iter().any(|s| s.to_lowercase().contains(&name))
    }
}

/// The place of the adapter to take: the best of those that match and lack nothing. Software comes
/// last.
///
/// # Errors
/// [`BackendError::NoAdapter`] with what there is and what it lacks.
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
            format!("no adapter can do what is needed: {}", lacking.join(", "))
        }
        (Some(name), true) if !all.is_empty() => {
            format!("no adapter is called `{name}`; there are: {}", names.join(", "))
        }
        _ => "no adapter was found; install a Vulkan, Metal or DX12 driver".into(),
    }))
}

/// What a device tells outside of any call.
#[derive(Debug, Default)]
struct Told {
    lost: Option<String>,
    error: Option<String>,
}

/// An open device with its kernels, which several backends may share, one after the other.
#[derive(Debug, Clone)]
pub struct GpuDevice(pub(super) Arc<Device>);

impl GpuDevice {
    /// Opens an adapter.
    ///
    /// # Errors
    /// [`BackendError::NoAdapter`] with what there is and what it lacks.
    pub fn open(choice: &AdapterChoice) -> Result<Self, BackendError> {
        Ok(Self(Arc::new(Device::open(choice)?)))
    }

    /// The adapter.
    #[must_use]
    pub fn adapter(&self) -> &AdapterSummary {
        &self.0.summary
    }
}

/// An open device.
#[derive(Debug)]
pub(super) struct Device {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) summary: AdapterSummary,
    told: Arc<Mutex<Told>>,
    /// By detail of the records, and by whether alpha and depth have gradients.
    pipelines: Mutex<HashMap<(u32, bool), Arc<Pipelines>>>,
}

impl Device {
    /// Opens the adapter of choice with all of its limits.
    pub(super) fn open(choice: &AdapterChoice) -> Result<Self, BackendError> {
        let mut all = enumerate();
        let summaries: Vec<_> = all.iter().map(|(_, summary)| summary.clone()).collect();
        let (adapter, summary) = all.swap_remove(choose(&summaries, choice)?);
        let descriptor = DeviceDescriptor {
            label: Some("densify"),
            required_features: Features::IMMEDIATES,
            required_limits: adapter.limits(),
            ..DeviceDescriptor::default()
        };
        let (device, queue) = wait(adapter.request_device(&descriptor))
            .map_err(|e| BackendError::NoAdapter(format!("{} cannot be opened: {e}", summary.name)))?;
        let told = Arc::new(Mutex::new(Told::default()));
        let (errors, losses) = (told.clone(), told.clone());
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            lock(&errors).error.get_or_insert(error.to_string());
        }));
        device.set_device_lost_callback(move |reason, message| {
            lock(&losses).lost.get_or_insert(format!("{reason:?}: {message}"));
        });
        Ok(Self { device, queue, summary, told, pipelines: Mutex::default() })
    }

    /// The kernels, which are compiled once.
    pub(super) fn pipelines(&self, detail: u32, more: bool) -> Result<Arc<Pipelines>, BackendError> {
        let mut all = self.pipelines.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(pipelines) = all.get(&(detail, more)) {
            return Ok(pipelines.clone());
        }
        let made = self.guarded("the kernels", 0, |device| Pipelines::new(device, detail, more))?;
        let made = Arc::new(made);
        all.insert((detail, more), made.clone());
        Ok(made)
    }

    /// An error that the device has told since, if any. A lost device ignores what it is given.
    pub(super) fn check(&self) -> Result<(), BackendError> {
        let told = lock(&self.told);
        let device = self.summary.name.clone();
        if let Some(why) = &told.lost {
            return Err(BackendError::DeviceLost { device, why: why.clone() });
        }
        match &told.error {
            Some(why) => Err(BackendError::Device { device, why: why.clone() }),
            None => Ok(()),
        }
    }

    /// Runs `create`, with the device's errors as ours.
    pub(super) fn guarded<T>(
        &self,
        what: &'static str,
        bytes: u64,
        create: impl FnOnce(&wgpu::Device) -> T,
    ) -> Result<T, BackendError> {
        let memory = self.device.push_error_scope(ErrorFilter::OutOfMemory);
        let internal = self.device.push_error_scope(ErrorFilter::Internal);
        let validation = self.device.push_error_scope(ErrorFilter::Validation);
        let made = create(&self.device);
        let broken = wait(validation.pop()).or(wait(internal.pop()));
        if wait(memory.pop()).is_some() {
            return Err(BackendError::OutOfMemory { what, bytes });
        }
        if let Some(error) = broken {
            let device = self.summary.name.clone();
            return Err(BackendError::Device { device, why: format!("{what}: {error}") });
        }
        self.check()?;
        Ok(made)
    }

    /// Refuses what this device could not bind: a driver may take it and fail later.
    pub(super) fn check_sizes(
        &self,
        planned: &[Planned],
        sizes: &Sizes,
    ) -> Result<(), BackendError> {
        let most = self.largest_binding();
        let Some(worst) = planned.iter().max_by_key(|p| p.bytes).filter(|p| p.bytes > most) else {
            return Ok(());
        };
        let device = &self.summary.name;
        let (needs, has) = (Bytes(worst.bytes), Bytes(most));
        let remedy = match worst.name {
            "records" | "keys 0" | "sums" => {
                format!("use --tile-cap {}", most / (worst.bytes / sizes.cap).max(1))
            }
            "canvas" | "finish" | "pixel gradient" | "derivatives" => {
                "shrink the images with --resolution".into()
            }
            _ => format!("use --budget {}", self.summary.largest_budget(sizes.sh_degree)),
        };
        Err(BackendError::OverLimit(format!(
            "{}: {needs} in one buffer, but {device} takes {has} at most; {remedy}",
            worst.what
        )))
    }

    /// Largest buffer that a kernel can use `[bytes]`.
    pub(super) fn largest_binding(&self) -> u64 {
        self.summary.largest_binding.min(self.summary.largest_buffer)
    }
}

fn lock(told: &Mutex<Told>) -> std::sync::MutexGuard<'_, Told> {
    told.lock().unwrap_or_else(PoisonError::into_inner)
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
        }
    }

    #[test]
    fn the_best_adapter_that_matches_is_taken() {
        let all = [
            adapter("llvmpipe (LLVM 15)", AdapterKind::Software, &[]),
            adapter("Old Card", AdapterKind::Discrete, &["workgroups per dimension"]),
            adapter("Shared", AdapterKind::Integrated, &[]),
            adapter("Card", AdapterKind::Discrete, &[]),
        ];
        let named = |name: &str| AdapterChoice { name: Some(name.into()) };
        assert_eq!(choose(&all, &AdapterChoice::default()).unwrap(), 3);
        assert_eq!(choose(&all[..3], &AdapterChoice::default()).unwrap(), 2);
        assert_eq!(choose(&all[..2], &AdapterChoice::default()).unwrap(), 0);
        assert_eq!(choose(&all, &named("LLVMPIPE")).unwrap(), 0);
        let told = |all: &[AdapterSummary], choice| choose(all, &choice).unwrap_err().to_string();
        assert!(told(&all, named("old")).contains("workgroups per dimension"));
        assert!(told(&all, named("geforce")).contains("Shared"));
        assert!(told(&[], named("x")).contains("install"));
        assert!(all[3].is_gpu() && !all[0].is_gpu() && !all[1].is_gpu());
        // 128 MiB: the seven coefficients of band 3 decide.
        assert_eq!(all[0].largest_budget(3), (128 << 20) / 84);
    }
}
