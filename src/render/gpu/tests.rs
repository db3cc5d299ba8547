//! Compares steps of the GPU backend with the native backend where sorts and prefix sums have several blocks.

use densify_policies::policy::{Cadence, LossTerms};
use densify_policies::rng::{PolicyRng, Purpose};
use glam::{DMat3, DVec3};

use super::adapter::adapters;
use super::*;
use crate::cpu::CpuBackend;
use crate::{AdapterChoice, AdapterKind, LearningRates};
use densify_core::image::Image8;

const ROWS: u32 = 5_000;
const BACKGROUND: [f32; 3] = [0.2, 0.1, 0.3];

/// Rows of which a part is on screen, many with equal depths.
fn model() -> Gaussians {
    let rng = PolicyRng::new(5, 1);
    let mut model = Gaussians::zeros(ROWS as usize, 1);
    for row in 0..ROWS {
        let draw = |counter| rng.normal3(row, Purpose::Noise, counter);
        let i = row as usize;
        let [x, y, z] = draw(0);
        model.means[i] = [0.8 * x, 0.6 * y, if row % 5 == 0 { 0.25 } else { z }];
        model.log_scales[i] = draw(1).map(|s| 0.4 * s - 3.5);
        let [x, y, z] = draw(2);
        model.quats[i] = [1.0, 0.5 * x, 0.5 * y, 0.5 * z];
        model.opacity_logits[i] = draw(3)[0];
        for (k, sh) in model.sh[12 * i..12 * (i + 1)].iter_mut().enumerate() {
            *sh = 0.3 * draw(4 + k as u32)[0];
        }
    }
    model
}

fn step(backend: &mut dyn Backend, camera: &Camera, target: &Image8) -> StepOutput {
    let rates = LearningRates { log_scale: 0.01, opacity: 0.05, sh_dc: 0.02, ..Default::default() };
    let input = StepInput {
        step: 1,
        view: 0,
        camera,
        target,
        background: BACKGROUND,
        exposure: None,
        pose: false,
        vignette: None,
        depth: None,
        distortion: 0.0,
        sh_degree: 1,
        rates,
        loss_terms: LossTerms::default(),
        noise: None,
        cadence: Cadence::default(),
        seed: 1,
    };
    backend.train_step(&input).expect("a step")
}

/// One and two digits of tiles, one and several bands, on every software driver but the slow one.
#[test]
fn steps_with_many_blocks_agree_with_the_native_backend() {
    let drivers: Vec<_> = adapters()
        .into_iter()
        .filter(|a| a.kind == AdapterKind::Software && !a.name.contains("SwiftShader"))
        .collect();
    let is_required = std::env::var_os("DENSIFY_REQUIRE_GPU").is_some();
    assert!(!(drivers.is_empty() && is_required), "there is no software driver");
    let model = model();
    for (width, height) in [(200, 150), (480, 320)] {
        let focal = f64::from(width);
        let camera = Camera::centred(
            (width, height),
            (focal, focal),
            DMat3::IDENTITY,
            DVec3::new(0.0, 0.0, -2.5),
        );
        let rgb = (0..3 * width * height).map(|i| (i * 31 % 253) as u8).collect();
        let target = Image8 { width, height, rgb, alpha: None, mask: None };
        let mut options = Setup { threads: Some(1), ..Setup::new(model.len()) };
        let mut cpu = CpuBackend::new(&model, &options).expect("a backend");
        let expected = step(&mut cpu, &camera, &target);
        let trained = cpu.download().expect("a model");
        options.largest_image = (width, height);
        for (driver, tile_cap) in
            drivers.iter().flat_map(|d| [None, Some(5_000)].map(|cap| (d, cap)))
        {
            for accumulation in driver.accumulations.iter().copied() {
                let choice = AdapterChoice {
                    name: Some(driver.name.clone()),
                    accumulation: Some(accumulation),
                };
                let device = GpuDevice::open(&choice).expect("a driver");
                let options = Setup { tile_cap, ..options.clone() };
                let mut gpu = GpuBackend::new(&model, &options, &device).expect("a backend");
                let found = step(&mut gpu, &camera, &target);
                let case = format!("{accumulation}, {width} px, at most {tile_cap:?} pairs");
                // A row at the edge of visibility may round to either side.
                assert!(expected.visible > 2_500 && expected.visible < model.len(), "{expected:?}");
                assert!(found.visible.abs_diff(expected.visible) <= 2, "{case}: {found:?}");
                // Blocks of tiles bound large footprints less closely than the native backend does.
                let more = found.entries as f64 / expected.entries as f64;
                assert!((0.98..1.1).contains(&more), "{case}: {found:?}, {expected:?}");
                assert_eq!(found.bands > 1, tile_cap.is_some(), "{case}");
                assert!((found.loss - expected.loss).abs() < 1e-5, "{case}: {found:?}");
                let stepped = gpu.download().expect("a model");
                // The first step of Adam moves each number by its rate times the gradient's sign.
                let flat = |m: &Gaussians| {
                    let scales = m.log_scales.as_flattened().iter();
                    scales.chain(&m.opacity_logits).chain(&m.sh).copied().collect::<Vec<f32>>()
                };
                let (a, b) = (flat(&stepped), flat(&trained));
                let off = a.iter().zip(&b).filter(|(a, b)| (*a - *b).abs() > 1e-4).count();
                assert!(off * 500 < a.len(), "{case}: {off} of {} numbers differ", a.len());
            }
        }
    }
}
