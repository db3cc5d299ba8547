//! The backends under test: the native one with every instruction set of the machine, and every GPU adapter with every
//! accumulation method.
//!
//! Without any adapter, even a software driver, only the native backend is tested and a message is printed, unless
//! `DENSIFY_REQUIRE_GPU` is set. `VK_DRIVER_FILES` selects drivers.

use std::sync::OnceLock;

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::core::image::Image8;
use densify::render::cpu::InstructionSet;
use densify::render::gpu::{GpuDevice, adapters};
use densify::render::{Accumulation, AdapterChoice, AdapterSummary};
use densify::render::{
    Backend, MomentStorage, ParameterStorage, Rendering, StateArray, StepInput, Storage, Tensor,
};
use densify::selftest::{Differentiable, Setup, Subject};
use densify_policies::policy::{Cadence, LossTerms};
use glam::{DMat3, DVec3};
use proptest::prelude::ProptestConfig;

pub(crate) use densify::selftest::compare::class;
pub(crate) use densify::selftest::values::RATES;

/// The background of most tests.
pub(crate) const BLUE: [f32; 3] = [0.3, 0.4, 0.6];

/// The native backend with every instruction set of this machine.
pub(crate) fn natives() -> Vec<Subject> {
    let all = InstructionSet::available().into_iter();
    all.map(|instructions| Subject::Native { instructions, threads: None }).collect()
}

/// All adapters with accumulation in slots, opened once.
pub(crate) fn devices() -> &'static [GpuDevice] {
    static DEVICES: OnceLock<Vec<GpuDevice>> = OnceLock::new();
    DEVICES.get_or_init(|| usable().iter().filter_map(|a| open(a, Accumulation::Slots)).collect())
}

/// All adapters with each supported atomic method; unsupported ones are reported.
pub(crate) fn atomics() -> &'static [GpuDevice] {
    static DEVICES: OnceLock<Vec<GpuDevice>> = OnceLock::new();
    DEVICES.get_or_init(|| {
        let methods = [Accumulation::SubgroupCas, Accumulation::SubgroupAtomics];
        let all = usable();
        all.iter().flat_map(|a| methods.into_iter().filter_map(|method| open(a, method))).collect()
    })
}

/// All adapters with every supported accumulation method.
pub(crate) fn devices_by_accumulation() -> impl Iterator<Item = &'static GpuDevice> {
    devices().iter().chain(atomics())
}

/// The deterministic backends.
pub(crate) fn repeatable() -> Vec<Subject> {
    let mut all = natives();
    all.extend(devices().iter().cloned().map(Subject::Gpu));
    all
}

/// All backends.
pub(crate) fn all() -> Vec<Subject> {
    let mut all = repeatable();
    all.extend(atomics().iter().cloned().map(Subject::Gpu));
    all
}

/// All backends except the default native one, with which they are compared.
pub(crate) fn others() -> Vec<Subject> {
    let is_default =
        |s: &Subject| matches!(s, Subject::Native { instructions: InstructionSet::Best, .. });
    all().into_iter().filter(|subject| !is_default(subject)).collect()
}

#[expect(clippy::print_stderr, reason = "a skipped test must say so")]
fn usable() -> Vec<AdapterSummary> {
    let mut usable: Vec<_> = adapters().into_iter().filter(|a| a.missing.is_empty()).collect();
    // Fast adapters first: SwiftShader is slow.
    usable.sort_by_key(|adapter| adapter.name.contains("SwiftShader"));
    if usable.is_empty() {
        let needed = std::env::var_os("DENSIFY_REQUIRE_GPU").is_some();
        assert!(!needed, "DENSIFY_REQUIRE_GPU is set, but there is no usable adapter");
        eprintln!("skipped: there is no usable GPU adapter, not even a software driver");
    }
    usable
}

/// Opens an adapter. Returns `None` if it lacks the accumulation method; llvmpipe supports all.
#[expect(clippy::print_stderr, reason = "a skipped test must say so")]
fn open(adapter: &AdapterSummary, accumulation: Accumulation) -> Option<GpuDevice> {
    let name = Some(adapter.name.clone());
    let opened = GpuDevice::open(&AdapterChoice { name, accumulation: Some(accumulation) });
    if adapter.accumulations.contains(&accumulation) {
        let device = opened.expect("a usable adapter opens");
        assert_eq!(device.accumulation(), accumulation);
        return Some(device);
    }
    let refusal = opened.expect_err("an unsupported method");
    assert!(!adapter.name.contains("llvmpipe"), "{refusal}");
    eprintln!("skipped: {refusal}");
    None
}

/// Runs a check on each backend and prints its name, which locates failures.
#[expect(clippy::print_stderr, reason = "shown only where a test fails")]
pub(crate) fn on_each(subjects: Vec<Subject>, mut check: impl FnMut(&Subject)) {
    for subject in subjects {
        eprintln!("on {}:", subject.name());
        check(&subject);
    }
}

/// All kinds of parameter and moment storage of the native backend, the default first.
pub(crate) fn storages() -> [Storage; 4] {
    use {MomentStorage as Moments, ParameterStorage as Parameters};
    let both = [Moments::F32, Moments::Both8];
    let [a, b] = both.map(|moments| Storage { parameters: Parameters::F32, moments });
    let [c, d] = both.map(|moments| Storage { parameters: Parameters::F16, moments });
    [a, b, c, d]
}

/// Creates a backend for a model.
pub(crate) fn make(subject: &Subject, model: &Gaussians) -> Box<dyn Differentiable> {
    make_with(subject, model, Setup::default())
}

/// Creates a backend with a specific setup.
pub(crate) fn make_with(
    subject: &Subject,
    model: &Gaussians,
    setup: Setup,
) -> Box<dyn Differentiable> {
    subject.backend_with(model, setup).expect("a small model fits")
}

/// The proptest configuration of a backend: `PROPTEST_CASES` or `default` cases, and an eighth of that on devices,
/// because software drivers take forty times as long.
pub(crate) fn cases_on(subject: &Subject, default: u32) -> ProptestConfig {
    let base = ProptestConfig { failure_persistence: None, ..ProptestConfig::default() };
    let is_set = std::env::var_os("PROPTEST_CASES").is_some();
    let all = if is_set { base.cases } else { default };
    let cases = if matches!(subject, Subject::Gpu(_)) { all.div_ceil(8) } else { all };
    ProptestConfig { cases, ..base }
}

/// The input of a training step towards an image.
pub(crate) fn step_input<'a>(
    step: u32,
    camera: &'a Camera,
    target: &'a Image8,
    sh_degree: u8,
) -> StepInput<'a> {
    StepInput {
        step,
        view: 0,
        camera,
        target,
        background: BLUE,
        exposure: None,
        pose: false,
        vignette: None,
        depth: None,
        distortion: 0.0,
        sh_degree,
        rates: RATES,
        loss_terms: LossTerms::default(),
        noise: None,
        cadence: Cadence::default(),
        seed: 1,
    }
}

/// Normalises the quaternions of a model, as training does.
pub(crate) fn normalised(mut model: Gaussians) -> Gaussians {
    for quat in &mut model.quats {
        let norm = quat.iter().map(|v| v * v).sum::<f32>().sqrt();
        *quat = quat.map(|v| v / norm);
    }
    model
}

/// A distant camera that faces away from the scene of `camera` and sees none of its Gaussians.
pub(crate) fn turned_away(camera: &Camera) -> Camera {
    let turn = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, -1.0));
    let translation = turn * camera.translation - DVec3::new(0.0, 0.0, 1000.0);
    Camera { rotation: turn * camera.rotation, translation, ..*camera }
}

/// Converts a rendering to a photograph.
pub(crate) fn photograph(image: &Rendering) -> Image8 {
    let rgb = image.rgb.iter().map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    Image8 { width: image.width, height: image.height, rgb, alpha: None, mask: None }
}

/// The state that a checkpoint saves: the model and the other arrays.
pub(crate) fn saved(backend: &dyn Backend) -> (Gaussians, Vec<Tensor>) {
    let save = |array: StateArray| backend.save(&array.name).expect("an array of the state");
    let arrays = backend.state().into_iter().map(save).collect();
    (backend.download().expect("a model"), arrays)
}

/// The bits of an image.
pub(crate) fn bits(image: &Rendering) -> Vec<u32> {
    let all = image.rgb.iter().chain(&image.alpha).chain(&image.depth);
    all.map(|v| v.to_bits()).collect()
}

/// Converts numbers to `f64`.
pub(crate) fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}
