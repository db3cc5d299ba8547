//! Training quality if parameters and moments are stored in fewer bits. Related tests: `sameness` for reproducibility,
//! `resuming` for checkpoints, `quarantine` for non-finite values, and `cli/memory.rs` for memory.

use densify::core::gaussians::Gaussians;
use densify::render::{Storage, Tensor, Values};
use densify::selftest::{Setup, Subject, scenes};

use crate::subject::{
    BLUE, all, devices, make, make_with, photograph, saved, step_input, storages,
};

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
    let loss_on = |subject: &Subject, storage: Storage, steps: u32| {
        let setup = Setup { storage, ..Setup::default() };
        let mut backend = make_with(subject, &model, setup);
        let mut step = |number| {
            let output = backend.train_step(&step_input(number, &camera, &target, 2));
            f64::from(output.expect("a small image").loss)
        };
        let losses: Vec<f64> = (1..=steps).map(&mut step).collect();
        losses[losses.len() - 20..].iter().sum::<f64>() / 20.0
    };
    let loss = |storage, steps| loss_on(&Subject::NATIVE, storage, steps);
    let [plain, others @ ..] = storages();
    let (first, reference) = (loss(plain, 20), loss(plain, 400));
    assert!(reference < 0.2 * first, "{first} -> {reference}");
    for storage in others {
        let found = loss(storage, 400);
        assert!(found <= 1.5 * reference, "{storage:?}: {first} -> {found}, not {reference}");
    }
    let devices = devices().iter().cloned().map(Subject::Gpu);
    for subject in devices.filter(|subject| !subject.name().contains("SwiftShader")) {
        let found = loss_on(&subject, others[2], 400);
        assert!(
            found <= 1.5 * reference,
            "{}: {first} -> {found}, not {reference}",
            subject.name()
        );
    }
}

/// The bytes of an array whose name ends like this, and its bytes per row.
fn bytes_of(state: &[Tensor], name: &str) -> (Vec<u8>, usize) {
    let tensor = state.iter().find(|tensor| tensor.name.ends_with(name)).expect("an array");
    let Values::U8(bytes) = &tensor.values else { panic!("{name} has no bytes") };
    (bytes.clone(), tensor.shape[1])
}

/// Both backends round with the same random numbers: after a step, whose gradients differ in the last bits only, nearly
/// all stored numbers are equal. With independent numbers, about half of the second moments would differ.
#[test]
fn numbers_are_rounded_alike_on_all_backends() {
    let camera = scenes::camera(64, 48, 11);
    let model = scenes::cloud(300, 3, &camera, 12);
    let target = scenes::target(&camera);
    let [.., smallest] = storages();
    let after_step = |subject: &Subject| {
        let setup = Setup { storage: smallest, ..Setup::default() };
        let mut backend = make_with(subject, &model, setup);
        let [was, is] = [0, 1].map(|number| {
            if number > 0 {
                let input = step_input(number, &camera, &target, 3);
                backend.train_step(&input).expect("a small image");
            }
            backend.download().expect("a model")
        });
        (was, is, saved(&*backend).1)
    };
    let bounded = |model: &Gaussians| {
        let scales = model.log_scales.as_flattened();
        let all = [scales, model.quats.as_flattened(), &*model.opacity_logits, &*model.sh];
        all.concat()
    };
    let (native_start, native_model, native) = after_step(&Subject::NATIVE);
    let expected = ["first", "second"].map(|which| bytes_of(&native, which).0);
    let expected_model = bounded(&native_model);
    // Arrays on a device: their first parameters, and numbers of parameters.
    let parts = [("rows", 0, 11), ("sh0", 11, 3), ("sh1", 14, 9), ("sh2", 23, 15), ("sh3", 38, 21)];
    for subject in all().iter().filter(|subject| matches!(subject, Subject::Gpu(_))) {
        let (start, found_model, found) = after_step(subject);
        assert!(start == native_start, "{}: rounded to other numbers", subject.name());
        let (mut equal, mut changed) = ([0; 2], 0);
        for (name, first, count) in parts {
            let (bytes, width) = bytes_of(&found, &format!("moments {name}"));
            for row in 0..model.len() {
                for number in 0..count {
                    let at = row * width + 2 * number;
                    let of_cpu = expected.each_ref().map(|all| all[59 * row + first + number]);
                    changed += usize::from(of_cpu[1] != 0);
                    for which in 0..2 {
                        equal[which] += usize::from(bytes[at + which] == of_cpu[which]);
                    }
                }
            }
        }
        let most = 59 * model.len();
        assert!(changed > most / 3, "only {changed} moments have changed");
        assert!(equal.iter().all(|&n| n > most / 100 * 99), "{}: {equal:?}", subject.name());
        let found_model = bounded(&found_model);
        let pairs = || found_model.iter().zip(&expected_model);
        let same = pairs().filter(|(a, b)| a.to_bits() == b.to_bits()).count();
        assert!(same > found_model.len() / 100 * 98, "{}: {same} parameters", subject.name());
    }
}
