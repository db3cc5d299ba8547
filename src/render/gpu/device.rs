//! An open device with its compiled kernels; translates its errors to [`BackendError`].

use std::future::Future;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Waker};

use densify_policies::policy::{Needs, PixelLoss};
use wgpu::{DeviceDescriptor, ErrorFilter, Features, MemoryHints};

use super::adapter::{choose, enumerate, features_for};
use super::clock::{self, Clock};
use super::pipelines::{KernelCache, Pipelines, Variant};
use super::sizes::{ALLOCATOR_BLOCK, UPLOAD_BYTES};
use super::{GpuBackend, memory_plan};
use crate::signals::RecordLayout;
use crate::{
    Accumulation, AdapterChoice, AdapterSummary, BackendError, Differentiable, Setup, Storage,
};
use densify_core::gaussians::Gaussians;
use densify_core::memory::Ledger;

/// Errors that a device reports asynchronously.
#[derive(Debug, Default)]
struct ReportedErrors {
    lost: Option<String>,
    error: Option<String>,
}

/// An open device with its compiled kernels. Several backends may use it, one after the other.
#[derive(Debug, Clone)]
pub struct GpuDevice(pub(super) Arc<Device>);

impl GpuDevice {
    /// Opens an adapter.
    ///
    /// # Errors
    /// [`BackendError::NoAdapter`] with the adapters found and what they lack.
    pub fn open(choice: &AdapterChoice) -> Result<Self, BackendError> {
        Ok(Self(Arc::new(Device::open(choice, Features::empty())?)))
    }

    /// Opens an adapter and times each stage of a step, which makes steps slower. See
    /// [`stage_times`](crate::Backend::stage_times).
    ///
    /// # Errors
    /// As [`open`](Self::open); also if the adapter has no timestamps.
    pub fn open_with_clock(choice: &AdapterChoice) -> Result<Self, BackendError> {
        Ok(Self(Arc::new(Device::open(choice, clock::FEATURES)?)))
    }

    /// The adapter of the device.
    pub fn adapter(&self) -> &AdapterSummary {
        &self.0.summary
    }

    /// The accumulation of gradients in use.
    pub fn accumulation(&self) -> Accumulation {
        self.0.accumulation
    }

    /// Largest budget at an SH degree.
    pub fn largest_budget(&self, sh_degree: u8) -> u64 {
        self.0.summary.largest_budget(sh_degree)
    }

    /// Largest number of (row, tile) pairs in memory at a time, for a policy's needs; `depth` as in [`Setup::depth`].
    pub fn max_pairs(&self, needs: &Needs, depth: bool) -> u64 {
        memory_plan::max_pairs(&self.0, needs, depth)
    }

    /// Memory of a backend with these options for models of this SH degree. Nothing is allocated.
    pub fn memory_plan(&self, sh_degree: u8, options: &Setup) -> Ledger {
        memory_plan::ledger(&memory_plan::sizes(&self.0, sh_degree, options), &options.needs)
    }

    /// Creates a backend for the model; see [`GpuBackend::new`].
    ///
    /// # Errors
    /// As [`GpuBackend::new`].
    pub fn backend(
        &self,
        model: &Gaussians,
        options: &Setup,
    ) -> Result<Box<dyn Differentiable>, BackendError> {
        Ok(Box::new(GpuBackend::new(model, options, self)?))
    }
}

/// An open device.
#[derive(Debug)]
pub(super) struct Device {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    /// Timestamps, for benchmarks.
    pub(super) clock: Option<Clock>,
    pub(super) summary: AdapterSummary,
    pub(super) accumulation: Accumulation,
    reported: Arc<Mutex<ReportedErrors>>,
    /// Bytes written to the queue since the last wait, for which wgpu holds copies.
    written: Mutex<u64>,
    kernels: Mutex<KernelCache>,
    /// The record layouts, kinds of storage and pixel terms for which the device has passed the canary.
    passed: Mutex<Vec<(RecordLayout, Storage, PixelLoss)>>,
}

impl Device {
    /// Opens the chosen adapter with all of its limits, and with the features `more` besides those that steps need.
    fn open(choice: &AdapterChoice, more: Features) -> Result<Self, BackendError> {
        let mut all = enumerate();
        let summaries: Vec<_> = all.iter().map(|(_, summary)| summary.clone()).collect();
        let (adapter, summary) = all.swap_remove(choose(&summaries, choice)?);
        let accumulation = choice.accumulation(&summary, adapter.features())?;
        let descriptor = DeviceDescriptor {
            label: Some("densify"),
            // No more than is used: requested features can change how a driver compiles.
            required_features: Features::IMMEDIATES | features_for(accumulation) | more,
            required_limits: adapter.limits(),
            // Buffers above the size of a block have exactly the memory that they need.
            memory_hints: MemoryHints::Manual {
                suballocated_device_memory_block_size: ALLOCATOR_BLOCK..ALLOCATOR_BLOCK,
            },
            ..DeviceDescriptor::default()
        };
        let (device, queue) = wait(adapter.request_device(&descriptor)).map_err(|e| {
            BackendError::NoAdapter(format!("{} cannot be opened: {e}", summary.name))
        })?;
        let reported = Arc::new(Mutex::new(ReportedErrors::default()));
        let (errors, losses) = (reported.clone(), reported.clone());
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            lock(&errors).error.get_or_insert(error.to_string());
        }));
        device.set_device_lost_callback(move |reason, message| {
            lock(&losses).lost.get_or_insert(format!("{reason:?}: {message}"));
        });
        let clock = (!more.is_empty()).then(|| Clock::new(&device, &queue));
        Ok(Self {
            device,
            queue,
            clock,
            summary,
            accumulation,
            reported,
            written: Mutex::default(),
            kernels: Mutex::default(),
            passed: Mutex::default(),
        })
    }

    /// The kernels of a variant, compiled on first use.
    pub(super) fn pipelines(&self, variant: Variant) -> Result<Arc<Pipelines>, BackendError> {
        let mut cache = self.kernels.lock().unwrap_or_else(PoisonError::into_inner);
        let compiled = self.guarded("the kernels", 0, |device| cache.pipelines(device, variant));
        if compiled.is_err() {
            // Some of the new kernels may be invalid.
            *cache = KernelCache::default();
        }
        compiled
    }

    /// Runs `check` unless the device has already passed it for these kernels.
    pub(super) fn check_once(
        &self,
        kernels: (RecordLayout, Storage, PixelLoss),
        check: impl FnOnce() -> Result<(), BackendError>,
    ) -> Result<(), BackendError> {
        let mut passed = self.passed.lock().unwrap_or_else(PoisonError::into_inner);
        if !passed.contains(&kernels) {
            check()?;
            passed.push(kernels);
        }
        Ok(())
    }

    /// Returns an error that the device has reported, if any. A lost device ignores commands silently.
    pub(super) fn check(&self) -> Result<(), BackendError> {
        faults::lose(&self.device);
        let reported = lock(&self.reported);
        let device = self.summary.name.clone();
        if let Some(why) = &reported.lost {
            return Err(BackendError::DeviceLost { device, why: why.clone() });
        }
        match &reported.error {
            Some(why) => Err(BackendError::Device { device, why: why.clone() }),
            None => Ok(()),
        }
    }

    /// Records that the device has failed and returns the error. All later [checks](Self::check) fail too: a
    /// command was not executed, so that later results would be wrong.
    pub(super) fn failed(&self, why: String) -> BackendError {
        lock(&self.reported).error.get_or_insert_with(|| why.clone());
        let device = self.summary.name.clone();
        self.check().err().unwrap_or(BackendError::Device { device, why })
    }

    /// Writes to a buffer, starting at byte `at`. Waits whenever [`UPLOAD_BYTES`] have been written, so that the copies
    /// that wgpu holds until the device has taken them are never larger.
    pub(super) fn write(&self, buffer: &wgpu::Buffer, at: u64, bytes: &[u8]) {
        let mut written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
        let mut at = at;
        for chunk in bytes.chunks(UPLOAD_BYTES as usize) {
            let length = chunk.len() as u64;
            if *written + length > UPLOAD_BYTES {
                self.queue.submit([]);
                if let Err(error) = self.device.poll(wgpu::PollType::wait_indefinitely()) {
                    // Kept for the next check.
                    self.failed(error.to_string());
                }
                *written = 0;
            }
            self.queue.write_buffer(buffer, at, chunk);
            *written += length;
            at += length;
        }
    }

    /// Notes that the device has executed all commands, and so has taken everything written before.
    pub(super) fn uploads_are_done(&self) {
        *self.written.lock().unwrap_or_else(PoisonError::into_inner) = 0;
    }

    /// Runs `create` and returns the errors that the device reports meanwhile; `what` and `bytes` describe the result.
    pub(super) fn guarded<T>(
        &self,
        what: &'static str,
        bytes: u64,
        create: impl FnOnce(&wgpu::Device) -> T,
    ) -> Result<T, BackendError> {
        let memory = self.device.push_error_scope(ErrorFilter::OutOfMemory);
        let internal = self.device.push_error_scope(ErrorFilter::Internal);
        let validation = self.device.push_error_scope(ErrorFilter::Validation);
        let created = create(&self.device);
        let failure = wait(validation.pop()).or(wait(internal.pop()));
        if wait(memory.pop()).is_some() {
            return Err(BackendError::OutOfMemory { what, bytes });
        }
        if let Some(error) = failure {
            let device = self.summary.name.clone();
            return Err(BackendError::Device { device, why: format!("{what}: {error}") });
        }
        self.check()?;
        Ok(created)
    }

    /// Largest buffer that a kernel can bind `[bytes]`.
    pub(super) fn largest_binding(&self) -> u64 {
        self.summary.largest_binding.min(self.summary.largest_buffer)
    }
}

fn lock(reported: &Mutex<ReportedErrors>) -> std::sync::MutexGuard<'_, ReportedErrors> {
    reported.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits for a future of wgpu; outside of browsers such futures are ready at once.
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

pub(crate) mod faults {
    //! Fault injection for tests: loses a device, as a driver reset does, in the thread that asks for it.

    use std::cell::Cell;

    thread_local! {
        /// Number of checks until the loss.
        static LEFT: Cell<Option<u32>> = const { Cell::new(None) };
    }

    /// Runs `f`, and loses the device that it uses after this number of checks. Returns true if it was lost.
    pub fn with_device_lost_after<T>(checks: u32, f: impl FnOnce() -> T) -> (T, bool) {
        LEFT.set(Some(checks));
        let result = f();
        (result, LEFT.take().is_none())
    }

    pub(super) fn lose(device: &wgpu::Device) {
        match LEFT.get() {
            Some(0) => {
                LEFT.set(None);
                device.destroy();
                // The callback comes with the next poll.
                let _ = device.poll(wgpu::PollType::Poll);
            }
            Some(left) => LEFT.set(Some(left - 1)),
            None => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::super::adapter::adapters;
    use super::*;
    use crate::{AdapterKind, Backend, Fit, Inspect};
    use densify_core::camera::Camera;

    /// A newly opened software driver, as a lost device cannot be used again. Not SwiftShader, which opens slowly.
    #[expect(clippy::print_stderr, reason = "a skipped test must say so")]
    fn software_device() -> Option<GpuDevice> {
        let found = adapters().into_iter().find(|adapter| {
            let is_slow = adapter.name.contains("SwiftShader");
            adapter.kind == AdapterKind::Software && adapter.missing.is_empty() && !is_slow
        });
        let Some(AdapterSummary { name, .. }) = found else {
            let is_required = std::env::var_os("DENSIFY_REQUIRE_GPU").is_some();
            assert!(!is_required, "DENSIFY_REQUIRE_GPU is set, but there is no software driver");
            eprintln!("skipped: no software driver to lose");
            return None;
        };
        let choice = AdapterChoice { name: Some(name), accumulation: None };
        Some(GpuDevice::open(&choice).expect("a driver"))
    }

    fn model() -> (Gaussians, Camera) {
        let mut model = Gaussians::zeros(2, 0);
        model.means = vec![[0.0, 0.0, 2.0], [0.1, 0.0, 3.0]];
        model.quats = vec![[1.0, 0.0, 0.0, 0.0]; 2];
        (model, Camera::centred((16, 16), (16.0, 16.0), DMat3::IDENTITY, DVec3::ZERO))
    }

    #[test]
    fn painting_restores_the_colours_or_fails_for_good() {
        let (model, camera) = model();
        for checks in 0.. {
            let Some(device) = software_device() else { return };
            let mut backend = GpuBackend::new(&model, &Setup::new(2), &device).expect("a backend");
            let paint = || backend.render_painted(&camera, [0.0; 3], &[[1.0, 0.0, 0.0]; 2]).err();
            let (error, lost) = faults::with_device_lost_after(checks, paint);
            if !lost {
                assert!(error.is_none() && checks > 2, "{checks} checks: {error:?}");
                assert!(backend.download().expect("a model") == model, "its colours have changed");
                return;
            }
            assert!(error.is_some() && backend.download().is_err(), "after {checks} checks");
        }
    }

    /// Everything that the allocator has reserved is in the ledger, also while a model is uploaded. With larger blocks,
    /// or copies of whole arrays, the device would hold more.
    #[test]
    fn the_allocator_reserves_no_more_than_the_ledger() {
        let Some(device) = software_device() else { return };
        let camera = Camera::centred((640, 480), (500.0, 500.0), DMat3::IDENTITY, DVec3::ZERO);
        let mut model = Gaussians::zeros(50_000, 3);
        // Behind the camera: only memory matters here.
        model.means.iter_mut().for_each(|mean| mean[2] = -2.0);
        model.quats.iter_mut().for_each(|quat| quat[0] = 1.0);
        let setup =
            Setup { largest_image: (640, 480), tile_cap: Some(200_000), ..Setup::new(model.len()) };
        let mut backend = GpuBackend::new(&model, &setup, &device).expect("a backend");
        let reserved = || {
            let report = device.0.device.generate_allocator_report();
            report.expect("wgpu reports what it allocates on Vulkan").total_reserved_bytes
        };
        let uploaded = reserved();
        backend.render(&camera, [0.0; 3], 0).expect("a rendering");
        let promised = backend.ledger().on_device();
        let found = [uploaded, reserved()];
        assert!(found.iter().all(|bytes| *bytes <= promised), "{found:?} of {promised}");
        assert!(found[1] > promised / 2, "{found:?} of {promised}");
    }

    /// Lists that are too long name the longest that fit, not a smaller budget.
    #[test]
    fn tile_lists_beyond_a_limit_of_the_device_name_the_largest_cap() {
        let Some(device) = software_device() else { return };
        let pairs = |bytes: u64| usize::try_from(bytes / 4).expect("64 bits");
        let summary = device.adapter();
        let beyond_binding = pairs(summary.largest_binding.min(summary.largest_buffer)) + 1;
        for tile_cap in [beyond_binding, pairs(summary.largest_buffer)] {
            let setup = Setup { tile_cap: Some(tile_cap), ..Setup::new(2) };
            let refused = GpuBackend::new(&model().0, &setup, &device).map(|_| ());
            let Err(BackendError::BufferTooLarge { fit: Fit::TileCap(fit), .. }) = refused else {
                panic!("{tile_cap} pairs: {refused:?}");
            };
            assert!(fit > 0 && fit < tile_cap as u64, "{fit} instead of {tile_cap}");
        }
    }

    #[test]
    fn a_failed_device_stays_failed() {
        let (model, camera) = model();
        let Some(device) = software_device() else { return };
        let mut backend = GpuBackend::new(&model, &Setup::new(2), &device).expect("a backend");
        assert!(backend.render(&camera, [0.0; 3], 0).is_ok());
        device.0.failed("nothing can be mapped".into());
        let error = backend.render(&camera, [0.0; 3], 0).expect_err("the device has failed");
        assert!(error.to_string().contains("nothing can be mapped"), "{error}");
    }
}
