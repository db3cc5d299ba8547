//! Tiles with so many splats that some drivers do not go through all of them: llvmpipe ends all loops of an
//! invocation after 65,535 rounds together, without a word. What comes then must be an error, not a model.

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::render::gpu::GpuDevice;
use densify::render::{Accumulation, ImageGradient, Shortcuts};
use densify::run::failure::Failure;

use crate::subject::{GREY, class, make_with, ways};
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::{Differentiable, Setup, Subject, scenes};

/// Rows one behind the other, each of which all pixels of one tile take; what is behind all is still seen.
fn pile(rows: usize, camera: &Camera) -> Gaussians {
    let mut model = Gaussians::default();
    let opacity = 5.0 / rows as f32;
    for i in 0..rows {
        let z = 2.0 + i as f64 / rows as f64;
        let mean = scenes::world(camera, [0.01, -0.02, z]);
        let logit = (opacity / (1.0 - opacity)).ln();
        scenes::push(&mut model, mean, [20.0; 3], [1.0, 0.0, 0.0, 0.0], logit, |k| 0.1 * k as f32);
    }
    model
}

fn name(device: &GpuDevice) -> String {
    format!("{}, {}", device.adapter().name, device.accumulation())
}

/// A backend that blends faint rows too.
fn faint(subject: &Subject, model: &Gaussians) -> Box<dyn Differentiable> {
    let shortcuts = Shortcuts { alpha_min: 1e-6, ..Shortcuts::default() };
    make_with(subject, model, Setup { shortcuts, ..Setup::default() })
}

fn backend(model: &Gaussians, device: &GpuDevice) -> Box<dyn Differentiable> {
    faint(&Subject::Gpu(device.clone()), model)
}

/// Holds that a driver that breaks off is found out, and that llvmpipe, which does, is.
fn is_broken_off<T>(result: &Result<T, Failure>, device: &GpuDevice, more: bool) -> bool {
    let Err(error) = result else {
        let breaks_off = device.adapter().name.contains("llvmpipe");
        assert!(!breaks_off, "{} has gone through all of them", name(device));
        return false;
    };
    let told = error.to_string();
    for word in [&*device.adapter().name, "ends loops before they", "--backend cpu"] {
        assert!(told.contains(word), "{word} is not in {told}");
    }
    assert_eq!(told.contains("--knob accumulation=slots"), more, "{told}");
    true
}

#[test]
fn a_list_too_long_to_be_drawn_is_an_error() {
    let camera = scenes::camera(16, 16, 71);
    let model = pile(300_000, &camera);
    let expected = faint(&Subject::NATIVE, &model).render(&camera, GREY, 0).expect("a small image");
    for device in ways() {
        let found = backend(&model, device).render(&camera, GREY, 0).map_err(Failure::from);
        let more = device.accumulation() != Accumulation::Slots;
        if !is_broken_off(&found, device, more) {
            let mut table = Table::new(&format!("300,000 rows in a tile, {}", name(device)));
            let found = found.expect("it has gone through all").rgb;
            let error = found.iter().zip(&expected.rgb).map(|(a, b)| (a - b).abs());
            table.check("image", "rgb", error.fold(0.0, f32::max).into(), 1e-3);
            table.finish();
        }
    }
}

#[test]
fn a_list_too_long_to_be_differentiated_is_an_error() {
    let camera = scenes::camera(16, 16, 72);
    let model = pile(30_000, &camera);
    let upstream = ImageGradient {
        rgb: (0..3 * 256).map(|i| (i % 7) as f32 - 2.5).collect(),
        alpha: vec![0.5; 256],
        depth: vec![-0.25; 256],
    };
    let (_, expected) = faint(&Subject::NATIVE, &model)
        .differentiate(&camera, GREY, 0, &upstream)
        .expect("a small image");
    for device in ways() {
        let found = backend(&model, device).differentiate(&camera, GREY, 0, &upstream);
        let found = found.map_err(Failure::from);
        if device.accumulation() != Accumulation::Slots && is_broken_off(&found, device, true) {
            continue;
        }
        let mut table = Table::new(&format!("30,000 rows in a tile, {}", name(device)));
        let (_, found) = found.expect("slots go through so many");
        for name in ["means", "opacity_logits", "sh"] {
            let expected = class(&expected, name).iter().copied().map(f64::from);
            let expected: Vec<f64> = expected.collect();
            let error = relative_error(class(&found, name), &expected);
            table.check("gradient", name, error, 1e-3);
        }
        table.finish();
    }
}
