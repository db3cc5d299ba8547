//! The backend under test, behind one door: tests name what they vary, and nothing else.

use densify::backend::cpu::{CpuBackend, CpuOptions, ModelGradient};
use densify::backend::{Rendering, StepOutput};
use densify::camera::Camera;
use densify::dataset::images::Image8;
use densify::gaussians::Gaussians;

pub(crate) use densify::verify::compare::class;
use densify::verify::reference::Upstream;
use densify::verify::scenes;
pub(crate) use densify::verify::values::RATES;

/// What must not change the outcome.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Resources {
    /// Most (row, tile) entries at a time; `None` is the default.
    pub(crate) tile_cap: Option<usize>,
    /// Most gradient records at a time; `None` is the default.
    pub(crate) record_cap: Option<usize>,
    /// Worker threads; `None` takes all cores.
    pub(crate) threads: Option<usize>,
}

pub(crate) fn options(rows: usize, resources: Resources) -> CpuOptions {
    let mut options = CpuOptions::new(rows.max(1));
    options.near = 0.01;
    options.threads = resources.threads;
    if let Some(cap) = resources.tile_cap {
        options.tile_cap = cap;
    }
    if let Some(cap) = resources.record_cap {
        options.record_cap = cap;
    }
    options
}

pub(crate) fn backend(model: &Gaussians, resources: Resources) -> CpuBackend {
    CpuBackend::new(model, &options(model.len(), resources)).expect("a small model fits")
}

/// Renders a view and differentiates Σ image · upstream.
pub(crate) fn differentiate(
    backend: &mut CpuBackend,
    camera: &Camera,
    background: [f32; 3],
    sh_degree: u8,
    upstream: &Upstream,
) -> (Rendering, ModelGradient) {
    let outcome = backend.differentiate(camera, background, sh_degree, &scenes::narrowed(upstream));
    outcome.expect("a small image is rendered")
}

/// The training loss of an image of the target's size, and its gradient.
pub(crate) fn loss(
    rendered: &[f32],
    target: &Image8,
    background: [f32; 3],
) -> (StepOutput, Vec<f32>) {
    let empty = Gaussians::default();
    backend(&empty, Resources::default()).loss(
        &scenes::opaque(rendered, target),
        target,
        background,
    )
}
