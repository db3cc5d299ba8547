//! Non-finite rows: every one is found and stays non-finite, and other rows are not affected. Case 25 of the
//! [selftest](densify::selftest) covers gradients whose square overflows.

use densify::core::gaussians::{Gaussians, ModelArray};
use densify::render::{Backend, MomentStorage, NonFinite, NumberKind, Storage, Values};
use densify::selftest::values::{POISON, SLOTS, remove, slot_mut};
use densify::selftest::{Setup, Subject, scenes};
use densify_policies::plan::EditPlan;

use crate::subject::{make, make_with, on_each, repeatable, step_input, storages};

/// The row to poison in tests of a single row.
const POISONED: usize = 11;

/// The expected finding for a row whose parameter number `slot` is not finite.
fn unsound(row: usize, slot: usize) -> NonFinite {
    let array = match slot {
        0..3 => ModelArray::Means,
        3..6 => ModelArray::LogScales,
        6..10 => ModelArray::Quats,
        10 => ModelArray::OpacityLogits,
        _ => ModelArray::Sh,
    };
    NonFinite { row: row as u32, array, kind: NumberKind::Parameter }
}

/// Poisons parameter i of row i.
fn every_non_finite_parameter_is_found(subject: &Subject, storage: Storage) {
    let model = scenes::cloud(SLOTS + 3, 3, &scenes::camera(33, 30, 71), 72);
    let audit = |model: &Gaussians| {
        let setup = Setup { storage, ..Setup::default() };
        make_with(subject, model, setup).audit().expect("an audit")
    };
    assert!(audit(&model).is_empty());
    for value in POISON {
        let mut poisoned = model.clone();
        // Too large for f16, but finite, so it must not be reported.
        *slot_mut(&mut poisoned, SLOTS + 1, 20) = -1e30;
        (0..SLOTS).for_each(|slot| *slot_mut(&mut poisoned, slot, slot) = value);
        let expected: Vec<NonFinite> = (0..SLOTS).map(|slot| unsound(slot, slot)).collect();
        assert_eq!(audit(&poisoned), expected, "{value}, {storage:?}");
    }
}

/// Poisons moment i of row i in each array of moments.
fn every_non_finite_moment_is_found(subject: &Subject) {
    let model = scenes::cloud(SLOTS + 3, 3, &scenes::camera(33, 30, 71), 72);
    let mut backend = make(subject, &model);
    let names: Vec<String> = backend.state().into_iter().map(|array| array.name).collect();
    let mut checked = 0;
    for name in names.iter().filter(|name| name.contains("first") || name.contains("second")) {
        let sound = backend.save(name).expect("moments");
        let mut poisoned = sound.clone();
        let numbers = sound.shape[1];
        let Values::F32(values) = &mut poisoned.values else {
            panic!("{name} is not an f32 array")
        };
        (0..numbers).for_each(|row| values[row * numbers + row] = POISON[row % 4]);
        backend.restore(poisoned).expect("a restored array");
        let found = backend.audit().expect("an audit");
        let rows: Vec<usize> = found.iter().map(|u| u.row as usize).collect();
        assert_eq!(rows, (0..numbers).collect::<Vec<_>>(), "{name}");
        assert!(found.iter().all(|u| u.kind == NumberKind::Moment), "{name}");
        backend.restore(sound).expect("a restored array");
        assert!(backend.audit().expect("an audit").is_empty(), "{name}");
        checked += numbers;
    }
    assert!(checked >= 2 * SLOTS, "{checked} moments of a row");
}

/// Sets the code of NaN for second moment i of row i in each array of moments in bytes on a GPU. The first two bytes of
/// each word are those of the first of its two numbers.
fn every_non_finite_second_moment_in_bytes_is_found(subject: &Subject) {
    let model = scenes::cloud(SLOTS + 3, 3, &scenes::camera(33, 30, 71), 72);
    let storage = Storage { moments: MomentStorage::Both8, ..Storage::default() };
    let mut backend = make_with(subject, &model, Setup { storage, ..Setup::default() });
    let names: Vec<String> = backend.state().into_iter().map(|array| array.name).collect();
    let mut seen = 0;
    for name in names.iter().filter(|name| name.starts_with("device.moments")) {
        let sound = backend.save(name).expect("moments");
        let mut poisoned = sound.clone();
        let (bytes, numbers) = (sound.shape[1], sound.shape[1] / 2);
        let Values::U8(codes) = &mut poisoned.values else { panic!("{name} has no bytes") };
        (0..numbers).for_each(|row| codes[row * bytes + 2 * row + 1] = 0xff);
        backend.restore(poisoned).expect("a restored array");
        let found = backend.audit().expect("an audit");
        let rows: Vec<usize> = found.iter().map(|u| u.row as usize).collect();
        assert_eq!(rows, (0..numbers).collect::<Vec<_>>(), "{name}");
        assert!(found.iter().all(|u| u.kind == NumberKind::Moment), "{name}");
        backend.restore(sound).expect("a restored array");
        assert!(backend.audit().expect("an audit").is_empty(), "{name}");
        seen += numbers;
    }
    assert!(seen >= SLOTS, "{seen} moments of a row");
}

#[test]
fn every_non_finite_value_is_found() {
    on_each(repeatable(), |subject| {
        every_non_finite_parameter_is_found(subject, Storage::default());
        every_non_finite_moment_is_found(subject);
        if let Subject::Gpu(_) = subject {
            let [.., smallest] = storages();
            every_non_finite_parameter_is_found(subject, smallest);
            every_non_finite_second_moment_in_bytes_is_found(subject);
        }
    });
    for storage in storages() {
        every_non_finite_parameter_is_found(&Subject::NATIVE, storage);
    }
}

/// Training keeps a poisoned parameter, other rows train as if its row did not exist, and removing the row makes the
/// model finite again.
#[test]
fn non_finite_rows_do_not_affect_others() {
    let camera = scenes::camera(33, 30, 73);
    let model = scenes::cloud(24, 3, &camera, 74);
    let target = scenes::target(&camera);
    let train = |backend: &mut dyn Backend| {
        for step in 1..=3 {
            let output = backend.train_step(&step_input(step, &camera, &target, 3));
            assert!(output.expect("a small image is rendered").loss.is_finite(), "step {step}");
        }
        backend.download().expect("a model")
    };
    on_each(repeatable(), |subject| {
        let without = train(&mut *make(subject, &remove(&model, POISONED)));
        // One parameter of each class, and one of a higher SH band.
        for slot in [1, 4, 8, 10, 12, 40] {
            let mut poisoned = model.clone();
            *slot_mut(&mut poisoned, POISONED, slot) = f32::NAN;
            let mut backend = make(subject, &poisoned);
            let others = remove(&train(&mut *backend), POISONED);
            let found = backend.audit().expect("an audit");
            assert_eq!(found, [unsound(POISONED, slot)]);
            assert!(others == without, "{slot}: other rows differ");

            let mut plan = EditPlan::new(24, backend.budget());
            plan.prune(POISONED as u32).expect("a row");
            backend.apply(&plan.compile(), 0, 3).expect("an edit");
            assert!(backend.audit().expect("an audit").is_empty() && backend.rows() == 23);
        }
    });
}
