//! An open device with its kernels; translates its errors to [`BackendError`].

use std::future::Future;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Waker};

use densify_policies::policy::Needs;
use wgpu::{DeviceDescriptor, ErrorFilter, Features, MemoryHints};

use super::adapter::{choose, enumerate, features_for};
use super::clock::{self, Clock};
use super::pipelines::{Pipelines, Variant};
use super::{GpuBackend, promise};
use crate::signals::RecordLayout;
use crate::{Accumulation, AdapterChoice, AdapterSummary, BackendError, Differentiable, Setup};
use densify_core::gaussians::Gaussians;
use densify_core::memory::Ledger;

/// Errors that a device reports outside of any call.
#[derive(Debug, Default)]
struct Reported {
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
    /// [`BackendError::NoAdapter`] with the adapters found and what they lack, in general or for the
    /// requested accumulation.
    pub fn open(choice: &AdapterChoice) -> Result<Self, BackendError> {
        Ok(Self(Arc::new(Device::open(choice, Features::empty())?)))
    }

    /// Opens an adapter to measure how long each stage of a step takes on it, which makes steps slower:
    /// [`stage_times`](crate::Backend::stage_times) then tells the stages apart.
    ///
    /// # Errors
    /// As [`open`](Self::open), and where the adapter has no clock.
    pub fn open_with_clock(choice: &AdapterChoice) -> Result<Self, BackendError> {
        Ok(Self(Arc::new(Device::open(choice, clock::FEATURES)?)))
    }

    /// The adapter.
    #[must_use]
    pub fn adapter(&self) -> &AdapterSummary {
        &self.0.summary
    }

    /// How it adds up gradients.
    #[must_use]
    pub fn accumulation(&self) -> Accumulation {
        self.0.accumulation
    }

    /// Most rows that a backend on it can hold at a degree.
    #[must_use]
    pub fn largest_budget(&self, sh_degree: u8) -> u64 {
        self.0.summary.largest_budget(sh_degree)
    }

    /// Most (row, tile) pairs that a backend on it can hold at a time for such needs.
    #[must_use]
    pub fn most_pairs(&self, needs: &Needs) -> u64 {
        promise::most_pairs(&self.0, needs)
    }

    /// Bytes per buffer of a backend with these options for models of this degree; nothing is allocated.
    #[must_use]
    pub fn promise(&self, sh_degree: u8, options: &Setup) -> Ledger {
        promise::ledger(&promise::sizes(&self.0, sh_degree, options), &options.needs)
    }

    /// A backend that holds the model; see [`GpuBackend::new`].
    ///
    /// # Errors
    /// As it.
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
    /// For benchmarks.
    pub(super) clock: Option<Clock>,
    pub(super) summary: AdapterSummary,
    pub(super) accumulation: Accumulation,
    reported: Arc<Mutex<Reported>>,
    /// The compiled variants; there are few.
    pipelines: Mutex<Vec<(Variant, Arc<Pipelines>)>>,
    /// The records for which the device has passed the canary.
    proven: Mutex<Vec<RecordLayout>>,
}

impl Device {
    /// Opens the adapter of choice with all of its limits, and with such features beside those that steps need.
    pub(super) fn open(choice: &AdapterChoice, more: Features) -> Result<Self, BackendError> {
        let mut all = enumerate();
        let summaries: Vec<_> = all.iter().map(|(_, summary)| summary.clone()).collect();
        let (adapter, summary) = all.swap_remove(choose(&summaries, choice)?);
        let accumulation = choice.accumulation(&summary, adapter.features())?;
        let descriptor = DeviceDescriptor {
            label: Some("densify"),
            // No more than is used: what is asked for can change how a driver compiles.
            required_features: Features::IMMEDIATES | features_for(accumulation) | more,
            required_limits: adapter.limits(),
            // Buffers are few and made once: no pools beyond what the ledger says.
            memory_hints: MemoryHints::MemoryUsage,
            ..DeviceDescriptor::default()
        };
        let (device, queue) = wait(adapter.request_device(&descriptor)).map_err(|e| {
            BackendError::NoAdapter(format!("{} cannot be opened: {e}", summary.name))
        })?;
        let reported = Arc::new(Mutex::new(Reported::default()));
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
            pipelines: Mutex::default(),
            proven: Mutex::default(),
        })
    }

    /// The kernels, which are compiled once.
    pub(super) fn pipelines(&self, variant: Variant) -> Result<Arc<Pipelines>, BackendError> {
        let mut all = self.pipelines.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, pipelines)) = all.iter().find(|(known, _)| *known == variant) {
            return Ok(pipelines.clone());
        }
        let made = self.guarded("the kernels", 0, |device| Pipelines::new(device, variant))?;
        let made = Arc::new(made);
        all.push((variant, made.clone()));
        Ok(made)
    }

    /// Runs `prove` once for each layout of the records.
    pub(super) fn prove(
        &self,
        records: RecordLayout,
        prove: impl FnOnce() -> Result<(), BackendError>,
    ) -> Result<(), BackendError> {
        let mut proven = self.proven.lock().unwrap_or_else(PoisonError::into_inner);
        if !proven.contains(&records) {
            prove()?;
            proven.push(records);
        }
        Ok(())
    }

    /// An error that the device has reported, if any. A lost device ignores what it is given.
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

    /// The error of a device that has failed. It is kept: what should have been done was not, so that nothing that
    /// the device does from now on is what it seems.
    pub(super) fn failed(&self, why: String) -> BackendError {
        lock(&self.reported).error.get_or_insert_with(|| why.clone());
        let device = self.summary.name.clone();
        self.check().err().unwrap_or(BackendError::Device { device, why })
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

    /// Largest buffer that a kernel can use `[bytes]`.
    pub(super) fn largest_binding(&self) -> u64 {
        self.summary.largest_binding.min(self.summary.largest_buffer)
    }
}

fn lock(reported: &Mutex<Reported>) -> std::sync::MutexGuard<'_, Reported> {
    reported.lock().unwrap_or_else(PoisonError::into_inner)
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

pub(crate) mod faults {
    //! Devices that are lost on demand, as by a driver's reset, for the thread that asks for it.

    use std::cell::Cell;

    thread_local! {
        /// Checks until the loss.
        static LEFT: Cell<Option<u32>> = const { Cell::new(None) };
    }

    /// Runs `f`; the device that it uses is lost at the check after so many. Returns whether it was.
    pub fn with_device_lost_after<T>(checks: u32, f: impl FnOnce() -> T) -> (T, bool) {
        LEFT.set(Some(checks));
        let done = f();
        (done, LEFT.take().is_none())
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
    use crate::{AdapterKind, Backend, Inspect};
    use densify_core::camera::Camera;

    /// A software driver, opened anew: what is lost cannot be used again. Not SwiftShader, which opens slowly.
    #[expect(clippy::print_stderr, reason = "a skipped test must say so")]
    fn driver() -> Option<GpuDevice> {
        let found = adapters().into_iter().find(|it| {
            let is_slow = it.name.contains("SwiftShader");
            it.kind == AdapterKind::Software && it.missing.is_empty() && !is_slow
        });
        let Some(AdapterSummary { name, .. }) = found else {
            let needed = std::env::var_os("DENSIFY_REQUIRE_GPU").is_some();
            assert!(!needed, "DENSIFY_REQUIRE_GPU is set, but there is no software driver");
            eprintln!("skipped: there is no software driver whose device could be lost");
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
    fn a_model_whose_own_colours_are_not_restored_is_not_used_any_more() {
        let (model, camera) = model();
        for checks in 0.. {
            let Some(device) = driver() else { return };
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

    #[test]
    fn a_device_that_has_failed_once_has_failed() {
        let (model, camera) = model();
        let Some(device) = driver() else { return };
        let mut backend = GpuBackend::new(&model, &Setup::new(2), &device).expect("a backend");
        assert!(backend.render(&camera, [0.0; 3], 0).is_ok());
        device.0.failed("nothing can be mapped".into());
        let error = backend.render(&camera, [0.0; 3], 0).expect_err("it has failed");
        assert!(error.to_string().contains("nothing can be mapped"), "{error}");
    }
}
