//! Parameters and moments in fewer bits: training is as good. That it repeats at any number of threads is
//! in `sameness`, that it goes on to the same bits in `resuming`, that the audit sees what is no number in
//! `quarantine`, and what a row takes in `cli/memory.rs`.

use densify::render::Storage;
use densify::selftest::{Setup, Subject, scenes};

use crate::subject::{GREY, make, make_with, photograph, step_input, storages};

/// The loss falls as it does with f32, to a twentieth. At its end it wanders with the rounding. That
/// small steps are not lost, as they would be by rounding to the nearest, follows from what
/// `cpu/narrow/tests.rs` holds number by number: that rounding is fair, and draws are independent.
#[test]
fn training_is_as_good() {
    let camera = scenes::camera(64, 48, 11);
    let truth = scenes::cloud(400, 2, &camera, 12);
    let mut model = truth.clone();
    for (i, x) in model.sh.iter_mut().enumerate() {
        *x += 0.2 * (i as f32 * 1.7).sin();
    }
    for (i, scale) in model.log_scales.iter_mut().flatten().enumerate() {
        *scale += 0.1 * (i as f32 * 2.3).sin();
    }
    let image = make(&Subject::NATIVE, &truth).render(&camera, GREY, 2).expect("a small image");
    let target = photograph(&image);
    // The mean of the last twenty steps.
    let loss = |storage: Storage, steps: u32| {
        let setup = Setup { storage, ..Setup::default() };
        let mut backend = make_with(&Subject::NATIVE, &model, setup);
        let mut step = |number| {
            let output = backend.train_step(&step_input(number, &camera, &target, 2));
            f64::from(output.expect("a small image").loss)
        };
        let losses: Vec<f64> = (1..=steps).map(&mut step).collect();
        losses[losses.len() - 20..].iter().sum::<f64>() / 20.0
    };
    let [plain, others @ ..] = storages();
    let (first, reference) = (loss(plain, 20), loss(plain, 400));
    assert!(reference < 0.2 * first, "{first} -> {reference}");
    for storage in others {
        let found = loss(storage, 400);
        assert!(found <= 1.5 * reference, "{storage:?}: {first} -> {found}, not {reference}");
    }
}
