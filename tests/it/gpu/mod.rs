//! The GPU backend against the native one, on every adapter that there is: stage by stage, over
//! training runs, against the stored float64 arrays, and where numbers are hardest.
//!
//! Where there is no adapter, each test says so and passes, unless `DENSIFY_REQUIRE_GPU` is set.
//! `VK_DRIVER_FILES` chooses drivers, several if need be.

mod depth;
mod edits;
mod extremes;
mod looking;
mod oracle;
mod photographs;
mod policies;
mod quarantine;
mod resuming;
mod training;
mod twins;

use std::sync::OnceLock;

use densify::backend::gpu::{
    Accumulation, AdapterChoice, AdapterSummary, GpuBackend, GpuDevice, GpuOptions, adapters,
};
use densify::gaussians::Gaussians;
use densify_policies::policy::Needs;

/// The devices under test, opened once, with sums in slots; none, said aloud, where there is no driver.
pub(crate) fn subjects() -> &'static [GpuDevice] {
    static DEVICES: OnceLock<Vec<GpuDevice>> = OnceLock::new();
    DEVICES.get_or_init(|| usable().iter().filter_map(|a| open(a, Accumulation::Slots)).collect())
}

/// The devices under test, each in every way that it can add up gradients; ways that it lacks are said
/// aloud.
pub(crate) fn ways() -> &'static [GpuDevice] {
    static DEVICES: OnceLock<Vec<GpuDevice>> = OnceLock::new();
    DEVICES.get_or_init(|| {
        let more = [Accumulation::SubgroupCas, Accumulation::SubgroupAtomics];
        let all = usable();
        let others = all.iter().flat_map(|a| more.into_iter().filter_map(|way| open(a, way)));
        subjects().iter().cloned().chain(others).collect()
    })
}

/// Those of [`ways`] whose sums have any order.
fn atomics() -> impl Iterator<Item = &'static GpuDevice> {
    ways().iter().filter(|device| !device.accumulation().is_deterministic())
}

#[expect(clippy::print_stderr, reason = "a skipped test must say so")]
fn usable() -> Vec<AdapterSummary> {
    let mut usable: Vec<_> = adapters().into_iter().filter(|a| a.missing.is_empty()).collect();
    // Fast ones first: SwiftShader is slow.
    usable.sort_by_key(|adapter| adapter.name.contains("SwiftShader"));
    if usable.is_empty() {
        let needed = std::env::var_os("DENSIFY_REQUIRE_GPU").is_some();
        assert!(!needed, "DENSIFY_REQUIRE_GPU is set, but there is no usable adapter");
        eprintln!("skipped: there is no usable GPU adapter, not even a software driver");
    }
    usable
}

/// Opens an adapter. What it does not have is refused, and skipped; llvmpipe has everything.
#[expect(clippy::print_stderr, reason = "a skipped test must say so")]
fn open(adapter: &AdapterSummary, accumulation: Accumulation) -> Option<GpuDevice> {
    let name = Some(adapter.name.clone());
    let opened = GpuDevice::open(&AdapterChoice { name, accumulation: Some(accumulation) });
    if adapter.accumulations.contains(&accumulation) {
        let device = opened.expect("a usable adapter opens");
        assert_eq!(device.accumulation(), accumulation);
        return Some(device);
    }
    let refusal = opened.expect_err("it lacks what is asked for");
    assert!(!adapter.name.contains("llvmpipe"), "{refusal}");
    eprintln!("skipped: {refusal}");
    None
}

/// What is under test, for people.
fn name(device: &GpuDevice) -> String {
    format!("{}, {}", device.adapter().name, device.accumulation())
}

fn options(model: &Gaussians) -> GpuOptions {
    GpuOptions::new(model.len().max(1))
}

fn backend(model: &Gaussians, device: &GpuDevice) -> GpuBackend {
    backend_for(model, device, &Needs::default())
}

fn backend_for(model: &Gaussians, device: &GpuDevice, needs: &Needs) -> GpuBackend {
    let options = GpuOptions { needs: needs.clone(), ..options(model) };
    GpuBackend::new(model, &options, device).expect("a small model fits")
}
