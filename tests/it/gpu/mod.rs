//! The GPU backend against the native one, on every adapter that there is: stage by stage, over
//! training runs, against the stored float64 arrays, and where numbers are hardest.
//!
//! Where there is no adapter, each test says so and passes, unless `DENSIFY_REQUIRE_GPU` is set.
//! `VK_DRIVER_FILES` chooses drivers, several if need be.

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

use densify::backend::gpu::{AdapterChoice, GpuBackend, GpuDevice, GpuOptions, adapters};
use densify::gaussians::Gaussians;
use densify_policies::policy::Needs;

/// The devices under test, opened once; none, said aloud, where there is no driver.
pub(crate) fn subjects() -> &'static [GpuDevice] {
    static DEVICES: OnceLock<Vec<GpuDevice>> = OnceLock::new();
    DEVICES.get_or_init(open)
}

#[expect(clippy::print_stderr, reason = "a skipped test must say so")]
fn open() -> Vec<GpuDevice> {
    let usable = adapters().into_iter().filter(|a| a.missing.is_empty());
    let mut names: Vec<String> = usable.map(|a| a.name).collect();
    // Fast ones first: SwiftShader is slow.
    names.sort_by_key(|name| name.contains("SwiftShader"));
    if names.is_empty() {
        let needed = std::env::var_os("DENSIFY_REQUIRE_GPU").is_some();
        assert!(!needed, "DENSIFY_REQUIRE_GPU is set, but there is no usable adapter");
        eprintln!("skipped: there is no usable GPU adapter, not even a software driver");
    }
    let open = |name| GpuDevice::open(&AdapterChoice { name: Some(name) });
    names.into_iter().map(|name| open(name).expect("a usable adapter opens")).collect()
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
