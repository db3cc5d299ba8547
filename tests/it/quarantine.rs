//! Rows that hold a number that is not finite: every one is found, none is lost sight of, and no other row
//! notices.

use densify::backend::{Attribute, Backend, Kept, Unsound, Values};
use densify::camera::Camera;
use densify::verify::values::{POISON, SLOTS, remove, slot_of};
use densify_policies::plan::EditPlan;

use crate::subject::{make, on_each, repeatable, step_input};
use densify::verify::{Subject, scenes};

/// The row that is poisoned where it is one.
const POISONED: usize = 11;
/// A slot of each class.
const CLASSES: [(usize, Attribute); 6] = [
    (1, Attribute::Mean),
    (4, Attribute::LogScale),
    (8, Attribute::Quat),
    (10, Attribute::Opacity),
    (12, Attribute::Sh),
    (40, Attribute::Sh),
];

fn audit(backend: &mut dyn Backend) -> Vec<Unsound> {
    backend.audit().expect("an audit")
}

fn train(backend: &mut dyn Backend, camera: &Camera, steps: u32) {
    let target = scenes::target(camera);
    for step in 1..=steps {
        let input = step_input(step, camera, &target, 3);
        let output = backend.train_step(&input).expect("a small image is rendered");
        assert!(output.loss.is_finite(), "step {step}");
    }
}

/// Row i has its number i poisoned; then the same with moments.
fn every_number_that_is_none_is_found_on(subject: &Subject) {
    let camera = scenes::camera(33, 30, 71);
    let model = scenes::cloud(SLOTS + 3, 3, &camera, 72);
    let mut clean = make(subject, &model);
    assert!(audit(&mut *clean).is_empty());
    for value in POISON {
        let mut poisoned = model.clone();
        for slot in 0..SLOTS {
            *slot_of(&mut poisoned, slot, slot) = value;
        }
        let expected: Vec<Unsound> = (0..SLOTS)
            .map(|slot| {
                let attribute = match slot {
                    0..3 => Attribute::Mean,
                    3..6 => Attribute::LogScale,
                    6..10 => Attribute::Quat,
                    10 => Attribute::Opacity,
                    _ => Attribute::Sh,
                };
                Unsound { row: slot as u32, attribute, kept: Kept::Parameter }
            })
            .collect();
        assert_eq!(audit(&mut *make(subject, &poisoned)), expected, "{value}");
    }
    let names = clean.state();
    let names = names.iter().map(|array| &array.name);
    let moments = names.filter(|name| name.contains("first") || name.contains("second"));
    let mut seen = 0;
    for name in moments {
        let sound = clean.save(name).expect("moments");
        let mut poisoned = sound.clone();
        let numbers = sound.shape[1];
        let Values::F32(values) = &mut poisoned.values else { panic!("{name} holds no numbers") };
        for row in 0..numbers {
            values[row * numbers + row] = POISON[row % 4];
        }
        clean.restore(poisoned).expect("they are taken back");
        let found = audit(&mut *clean);
        let rows: Vec<usize> = found.iter().map(|u| u.row as usize).collect();
        assert_eq!(rows, (0..numbers).collect::<Vec<_>>(), "{name}");
        assert!(found.iter().all(|u| u.kept == Kept::Moment), "{name}");
        clean.restore(sound).expect("they are taken back");
        assert!(audit(&mut *clean).is_empty(), "{name}");
        seen += numbers;
    }
    assert!(seen >= 2 * SLOTS, "{seen} moments of a row");
}

/// A poisoned parameter stays so in training, the other rows train as if there were no such row, and
/// the model is sound when it is gone.
fn the_others_train_as_if_it_were_not_there_on(subject: &Subject) {
    let camera = scenes::camera(33, 30, 73);
    let model = scenes::cloud(24, 3, &camera, 74);
    let mut without = make(subject, &remove(&model, POISONED));
    train(&mut *without, &camera, 3);
    let without = without.download().expect("a model");
    for (slot, attribute) in CLASSES {
        let mut poisoned = model.clone();
        *slot_of(&mut poisoned, POISONED, slot) = f32::NAN;
        let mut backend = make(subject, &poisoned);
        train(&mut *backend, &camera, 3);
        let expected = Unsound { row: POISONED as u32, attribute, kept: Kept::Parameter };
        assert_eq!(audit(&mut *backend), [expected]);
        let with = backend.download().expect("a model");
        let others = remove(&with, POISONED);
        assert!(others == without, "{attribute}: other rows differ");

        let mut plan = EditPlan::new(24, backend.budget());
        plan.prune(POISONED as u32).expect("a row");
        backend.apply(&plan.compile(), 0, 3).expect("an edit");
        assert!(audit(&mut *backend).is_empty() && backend.rows() == 23);
    }
}

/// A gradient that is none shows in a moment, and after the next step in its parameter: nothing that
/// brings parameters back to where they are safe makes a number of it.
fn a_poisoned_moment_poisons_its_parameter_on(subject: &Subject) {
    let camera = scenes::camera(33, 30, 75);
    let model = scenes::cloud(24, 3, &camera, 76);
    for (slot, attribute) in CLASSES {
        let mut backend = make(subject, &model);
        let names = backend.state();
        // Classes may share an array or not; the numbers of a row have the same order everywhere.
        let mut place = slot;
        let names = names.iter().map(|array| &array.name);
        let of_first = names.filter(|name| name.contains("first"));
        for name in of_first {
            let mut moments = backend.save(name).expect("moments");
            let numbers = moments.shape[1];
            // Twelve numbers of the geometry are eleven and one of padding.
            let size = if numbers == 12 { 11 } else { numbers };
            if place < size {
                let Values::F32(values) = &mut moments.values else { panic!("{name}") };
                values[POISONED * numbers + place] = f32::NAN;
                backend.restore(moments).expect("they are taken back");
                break;
            }
            place -= size;
        }
        let found = |kept| [Unsound { row: POISONED as u32, attribute, kept }];
        assert_eq!(audit(&mut *backend), found(Kept::Moment));
        train(&mut *backend, &camera, 2);
        assert_eq!(audit(&mut *backend), found(Kept::Parameter));
    }
}

#[test]
fn every_number_that_is_none_is_found() {
    on_each(repeatable(), every_number_that_is_none_is_found_on);
}

#[test]
fn the_others_train_as_if_it_were_not_there() {
    on_each(repeatable(), the_others_train_as_if_it_were_not_there_on);
}

#[test]
fn a_poisoned_moment_poisons_its_parameter() {
    on_each(repeatable(), a_poisoned_moment_poisons_its_parameter_on);
}
