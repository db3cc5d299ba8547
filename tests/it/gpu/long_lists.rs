//! Tiles with more splats than some drivers process: llvmpipe silently ends the loops of an invocation after 65,535
//! iterations in total. The backend must report an error instead of a wrong model.

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::render::gpu::GpuDevice;
use densify::render::{Accumulation, ImageGradient, Shortcuts};
use densify::run::failure::Failure;

use crate::subject::{BLUE, class, devices_by_accumulation, make_with};
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::{Differentiable, Setup, Subject, scenes};

/// Gaussians in a line, each covering all pixels of a tile; the last one is still visible.
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

/// A backend that also blends faint Gaussians.
fn faint(subject: &Subject, model: &Gaussians) -> Box<dyn Differentiable> {
    let shortcuts = Shortcuts { alpha_min: 1e-6, ..Shortcuts::default() };
    make_with(subject, model, Setup { shortcuts, ..Setup::default() })
}

fn backend(model: &Gaussians, device: &GpuDevice) -> Box<dyn Differentiable> {
    faint(&Subject::Gpu(device.clone()), model)
}

/// Returns true if the driver ended its loops early. Checks that llvmpipe does, and that the message says so and, if
/// `suggests_slots`, suggests accumulation in slots.
fn ended_early<T>(result: &Result<T, Failure>, device: &GpuDevice, suggests_slots: bool) -> bool {
    let Err(error) = result else {
        let is_llvmpipe = device.adapter().name.contains("llvmpipe");
        assert!(!is_llvmpipe, "{} processed the whole list", name(device));
        return false;
    };
    let message = error.to_string();
    for word in [&*device.adapter().name, "ends loops before they", "--backend cpu"] {
        assert!(message.contains(word), "{word} is not in {message}");
    }
    assert_eq!(message.contains("--knob accumulation=slots"), suggests_slots, "{message}");
    true
}

#[test]
fn a_list_too_long_to_render_is_an_error() {
    let camera = scenes::camera(16, 16, 71);
    let model = pile(300_000, &camera);
    let expected = faint(&Subject::NATIVE, &model).render(&camera, BLUE, 0).expect("a small image");
    for device in devices_by_accumulation() {
        let found = backend(&model, device).render(&camera, BLUE, 0).map_err(Failure::from);
        let suggests_slots = device.accumulation() != Accumulation::Slots;
        if !ended_early(&found, device, suggests_slots) {
            let mut table = Table::new(&format!("300,000 rows in a tile, {}", name(device)));
            let found = found.expect("a complete rendering").rgb;
            let error = found.iter().zip(&expected.rgb).map(|(a, b)| (a - b).abs());
            table.check("image", "rgb", error.fold(0.0, f32::max).into(), 1e-3);
            table.finish();
        }
    }
}

#[test]
fn a_list_too_long_to_differentiate_is_an_error() {
    let camera = scenes::camera(16, 16, 72);
    let model = pile(30_000, &camera);
    let upstream = ImageGradient {
        rgb: (0..3 * 256).map(|i| (i % 7) as f32 - 2.5).collect(),
        alpha: vec![0.5; 256],
        depth: vec![-0.25; 256],
    };
    let (_, expected) = faint(&Subject::NATIVE, &model)
        .differentiate(&camera, BLUE, 0, &upstream)
        .expect("a small image");
    for device in devices_by_accumulation() {
        let found = backend(&model, device).differentiate(&camera, BLUE, 0, &upstream);
        let found = found.map_err(Failure::from);
        if device.accumulation() != Accumulation::Slots && ended_early(&found, device, true) {
            continue;
        }
        let mut table = Table::new(&format!("30,000 rows in a tile, {}", name(device)));
        let (_, found) = found.expect("accumulation in slots");
        for name in ["means", "opacity_logits", "sh"] {
            let expected = class(&expected, name).iter().copied().map(f64::from);
            let expected: Vec<f64> = expected.collect();
            let error = relative_error(class(&found, name), &expected);
            table.check("gradient", name, error, 1e-3);
        }
        table.finish();
    }
}
