//! The cache of photographs on the device.

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::core::image::Image8;
use densify::render::gpu::{GpuBackend, GpuDevice};
use densify::render::{Backend, KeptPhotographs, Setup, StepInput};

use crate::subject::{devices, step_input};
use densify::selftest::scenes;

/// A view of the given size with a random image.
fn view(size: (u32, u32), seed: u64) -> (Camera, Image8) {
    (scenes::camera(size.0, size.1, 60), scenes::noisy(size, 0.0, seed).1)
}

fn backend(device: &GpuDevice, model: &Gaussians, count: usize, with_masks: bool) -> GpuBackend {
    let options = Setup {
        photographs: KeptPhotographs { count, with_masks },
        largest_image: (41, 30),
        ..Setup::new(model.len())
    };
    GpuBackend::new(model, &options, device).expect("a small model fits")
}

fn step(backend: &mut GpuBackend, step: u32, view: usize, (camera, target): &(Camera, Image8)) {
    let input = StepInput { view, ..step_input(step, camera, target, 0) };
    backend.train_step(&input).expect("a small image is rendered");
}

#[test]
fn caching_photographs_changes_only_the_memory() {
    let mut views = [view((41, 27), 1), view((30, 30), 2), view((41, 30), 3), view((17, 5), 4)];
    let plane =
        |seed, size| scenes::noisy(size, 0.0, seed).1.rgb[..(size.0 * size.1) as usize].to_vec();
    views[1].1.alpha = Some(plane(5, (30, 30)));
    views[2].1.mask = Some(plane(6, (41, 30)));
    views[3].1.mask = Some(plane(7, (17, 5)));
    let coarse = [view((20, 13), 9), view((15, 15), 10), view((20, 15), 11), view((8, 2), 12)];
    let model = scenes::cloud(60, 0, &views[0].0, 8);
    for device in devices() {
        let run = |count, with_masks| {
            let mut backend = backend(device, &model, count, with_masks);
            for number in 0..12 {
                let view = number * 7 % 4;
                // Image sizes grow, as in coarse-to-fine training.
                let images = if number < 6 { &coarse } else { &views };
                step(&mut backend, number as u32 + 1, view, &images[view]);
            }
            assert_eq!(backend.allocated_bytes(), backend.planned_bytes());
            (backend.download().expect("a model"), backend.allocated_bytes())
        };
        let (expected, uncached) = run(0, false);
        // A photograph takes 4 bytes for each of its 41·30 = 1,230 pixels, and a mask one, rounded up to a word.
        for (count, with_masks, bytes) in [
            (1, false, 4 * 1230),
            (4, false, 4 * 4 * 1230),
            (3, true, 3 * (4 * 1230 + 1232)),
            (9, true, 9 * (4 * 1230 + 1232)),
        ] {
            let (found, taken) = run(count, with_masks);
            assert!(found == expected, "{count} cached, with masks: {with_masks}");
            assert_eq!(taken - uncached, u64::next_multiple_of(bytes, 16), "{count}, {with_masks}");
        }
    }
}

/// Passing a different image for the same view shows whether the first one was cached.
#[test]
fn cached_photographs_are_not_uploaded_again() {
    let (camera, first) = view((41, 30), 1);
    let (_, second) = view((41, 30), 2);
    let model = scenes::cloud(40, 0, &camera, 9);
    let (first, second) = ((camera, first), (camera, second));
    for device in devices() {
        let run = |count, order: [&(Camera, Image8); 3]| {
            let mut backend = backend(device, &model, count, false);
            for (number, view) in (1..).zip(order) {
                // The cache has no room for the view of the third step.
                step(&mut backend, number, usize::from(number == 3), view);
            }
            backend.download().expect("a model")
        };
        let expected = run(0, [&first, &first, &second]);
        assert!(run(1, [&first, &second, &second]) == expected);
        assert!(run(0, [&first, &second, &second]) != expected);
        assert!(run(1, [&first, &second, &first]) != expected);
    }
}
