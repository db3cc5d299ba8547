//! Training quality if parameters and moments are stored in fewer bits. Related tests: `sameness` for reproducibility,
//! `resuming` for checkpoints, `quarantine` for non-finite values, and `cli/memory.rs` for memory.

use densify::render::Storage;
use densify::selftest::{Setup, Subject, scenes};

use crate::subject::{BLUE, make, make_with, photograph, step_input, storages};

/// The loss falls to a twentieth, as with f32, and then fluctuates with the rounding. Stochastic rounding keeps small
/// steps that rounding to nearest would lose; `cpu/narrow/tests.rs` checks it number by number.
#[test]
fn narrow_storage_trains_as_well_as_f32() {
    let camera = scenes::camera(64, 48, 11);
    let truth = scenes::cloud(400, 2, &camera, 12);
    let mut model = truth.clone();
    for (i, x) in model.sh.iter_mut().enumerate() {
        *x += 0.2 * (i as f32 * 1.7).sin();
    }
    for (i, scale) in model.log_scales.iter_mut().flatten().enumerate() {
        *scale += 0.1 * (i as f32 * 2.3).sin();
    }
    let image = make(&Subject::NATIVE, &truth).render(&camera, BLUE, 2).expect("a small image");
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
