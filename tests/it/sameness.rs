//! Bit-exactness of deterministic backends: results do not depend on threads, on the room for tile lists and gradient
//! records, or on earlier runs. `properties` covers row order and hidden rows. Atomic accumulation gives close results.

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::render::cpu::{InstructionSet, ModelGradient};
use densify::render::{Rendering, StepOutput, Storage};
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::reference::CLASSES;
use densify::selftest::{Differentiable, Setup, Subject, scenes};
use densify_policies::plan::EditPlan;

use crate::subject::{
    BLUE, atomics, class, devices, make, make_with, repeatable, saved, step_input, storages, wide,
};

/// The bits of an image and its gradients, the model after some steps, and the outputs of these steps.
type Run = (Vec<u32>, Gaussians, Vec<StepOutput>);

fn differentiate(
    backend: &mut dyn Differentiable,
    camera: &Camera,
    sh_degree: u8,
) -> (Rendering, ModelGradient) {
    let upstream = scenes::narrowed(&scenes::upstream(camera, 12));
    let outcome = backend.differentiate(camera, BLUE, sh_degree, &upstream);
    outcome.expect("a small image is rendered")
}

/// The numeric statistics of rows.
fn statistics(gradient: &ModelGradient) -> [&[f32]; 5] {
    [
        gradient.mean2d.as_flattened(),
        gradient.mean2d_abs.as_flattened(),
        gradient.colour.as_flattened(),
        &gradient.max_weight,
        &gradient.sum_weight,
    ]
}

/// The bits of an image and of every gradient and statistic.
fn bits((image, gradient): &(Rendering, ModelGradient)) -> Vec<u32> {
    let classes = CLASSES.map(|name| class(gradient, name));
    let images: [&[f32]; 3] = [&image.rgb, &image.alpha, &image.depth];
    let all = images.into_iter().chain(classes).chain(statistics(gradient));
    let counts = gradient.pixel_count.iter().copied();
    all.flatten().map(|v| v.to_bits()).chain(counts).collect()
}

/// Renders once, then trains.
fn run(backend: &mut dyn Differentiable, camera: &Camera) -> Run {
    let degree = backend.sh_degree();
    let bits = bits(&differentiate(backend, camera, degree));
    let (_, target) = scenes::noisy((camera.width, camera.height), 0.0, 3);
    let step = |n| backend.train_step(&step_input(n, camera, &target, degree));
    let outputs: Vec<_> = (1..=4).map(step).collect::<Result<_, _>>().expect("small images");
    (bits, backend.download().expect("a model"), outputs)
}

/// Clears the number of bands, which may differ.
fn without_bands((bits, model, outputs): Run) -> Run {
    (bits, model, outputs.into_iter().map(|output| StepOutput { bands: 1, ..output }).collect())
}

/// Covers all kinds of parameter storage and equal depths.
#[test]
fn threads_change_nothing() {
    let camera = scenes::camera(150, 90, 31);
    let mut model = scenes::cloud(700, 2, &camera, 41);
    model.means[..300].fill(scenes::world(&camera, [0.0, 0.0, 3.0]));
    let stored = storages().map(|storage| (InstructionSet::Best, storage));
    let all = InstructionSet::available().into_iter().map(|set| (set, Storage::default()));
    for (instructions, storage) in all.chain(stored) {
        let with = |threads| {
            let setup = Setup { storage, ..Setup::default() };
            let subject = Subject::Native { instructions, threads: Some(threads) };
            run(&mut *make_with(&subject, &model, setup), &camera)
        };
        let expected = with(1);
        for threads in [2, 5] {
            assert!(with(threads) == expected, "{threads} threads, {instructions}, {storage:?}");
        }
    }
}

#[test]
fn a_differentiation_does_not_change_training() {
    let camera = scenes::camera(60, 50, 33);
    let model = scenes::cloud(80, 1, &camera, 43);
    for subject in repeatable() {
        let trained = |differentiated: bool| {
            let mut backend = make(&subject, &model);
            if differentiated {
                differentiate(&mut *backend, &camera, 1);
            }
            let (_, target) = scenes::noisy((camera.width, camera.height), 0.0, 3);
            let outputs: Vec<_> =
                (1..=3).map(|n| backend.train_step(&step_input(n, &camera, &target, 1))).collect();
            assert!(outputs.iter().all(Result::is_ok), "{subject:?}: {outputs:?}");
            backend.download().expect("a model")
        };
        let expected = trained(false);
        assert!(expected != model, "{subject:?}: nothing was trained");
        assert!(trained(true) == expected, "{subject:?}");
    }
}

#[test]
fn bands_change_nothing() {
    let camera = scenes::camera(140, 120, 32);
    let model = scenes::cloud(150, 1, &camera, 42);
    for subject in repeatable() {
        let capped = |cap| {
            let setup = Setup { tile_cap: Some(cap), ..Setup::default() };
            run(&mut *make_with(&subject, &model, setup), &camera)
        };
        let whole = capped(1 << 20);
        assert_eq!(whole.2[0].bands, 1);
        for cap in [1, 500, 1500] {
            let banded = capped(cap);
            assert!(banded.2[0].bands > 1, "cap {cap}: {} entries fit", whole.2[0].entries);
            assert!(without_bands(banded) == whole, "cap {cap}, {}", subject.name());
        }
    }
}

/// If there is room for fewer gradient records than entries, a band or even a tile is processed in parts.
#[test]
fn room_for_records_changes_nothing() {
    let camera = scenes::camera(140, 120, 32);
    let model = scenes::cloud(150, 1, &camera, 42);
    let with = |tile_cap, record_cap| {
        let setup = Setup { tile_cap: Some(tile_cap), record_cap, ..Setup::default() };
        run(&mut *make_with(&Subject::NATIVE, &model, setup), &camera)
    };
    let whole = with(1 << 20, usize::MAX);
    assert!(whole.2[0].entries > 1_500 && whole.2[0].bands == 1, "{:?}", whole.2[0]);
    for (tile_cap, record_cap) in [(1 << 20, 1_500), (1 << 20, 100), (1 << 20, 7), (500, 100)] {
        let limited = with(tile_cap, record_cap);
        assert!(without_bands(limited) == whole, "{tile_cap} pairs, {record_cap} records");
    }
}

#[test]
fn running_twice_changes_nothing() {
    let camera = scenes::camera(60, 50, 33);
    let other = scenes::camera(90, 20, 34);
    let model = scenes::cloud(60, 3, &camera, 43);
    for subject in repeatable() {
        for tile_cap in [None, Some(100)] {
            let name = subject.name();
            let setup = Setup { tile_cap, ..Setup::default() };
            let mut backend = make_with(&subject, &model, setup);
            let first = differentiate(&mut *backend, &camera, 3);
            // A view of another size in between must have no effect.
            let _ = differentiate(&mut *backend, &other, 1);
            let second = differentiate(&mut *backend, &camera, 3);
            assert!(bits(&first) == bits(&second), "{name}");
            let rendered = backend.render(&camera, BLUE, 3).expect("a small image is rendered");
            assert!(rendered == first.0, "{name}: render and differentiate draw different images");
            assert!(run(&mut *backend, &camera).0 == bits(&first), "{name}, training");
        }
    }
}

/// With room for few gradient records, those of removed rows must not be mistaken for those of remaining rows.
#[test]
fn removed_rows_leave_no_records() {
    let camera = scenes::camera(64, 48, 11);
    let model = scenes::cloud(400, 2, &camera, 12);
    let with = |record_cap| {
        let setup = Setup { record_cap, ..Setup::default() };
        let mut backend = make_with(&Subject::NATIVE, &model, setup);
        run(&mut *backend, &camera);
        let mut plan = EditPlan::new(model.len(), model.len());
        plan.prune_all(10..model.len() as u32);
        backend.apply(&plan.compile(), 7, 4).expect("an edit");
        run(&mut *backend, &camera);
        saved(&*backend)
    };
    // Enough records for the ten remaining rows, but not for the slots of the removed ones.
    assert!(with(200) == with(1 << 20));
}

/// Gradient sums start at 0 in each pass, continue over its bands, and restart if a pass is repeated with more bands.
#[test]
fn atomic_accumulation_matches_slots_at_any_cap() {
    let camera = scenes::camera(70, 90, 32);
    let model = scenes::cloud(150, 1, &camera, 42);
    let Some(slots) = devices().first() else { return };
    let slots = Subject::Gpu(slots.clone());
    let (_, expected) = differentiate(&mut *make(&slots, &model), &camera, 1);
    for subject in atomics().iter().cloned().map(Subject::Gpu) {
        let mut table = Table::new(&format!("passes, {}", subject.name()));
        for tile_cap in [None, Some(500), Some(1)] {
            let setup = Setup { tile_cap, ..Setup::default() };
            let mut backend = make_with(&subject, &model, setup);
            for pass in 1..=3 {
                let (_, found) = differentiate(&mut *backend, &camera, 1);
                let case = format!("cap {tile_cap:?}, pass {pass}");
                for name in CLASSES {
                    let error = relative_error(class(&found, name), &wide(class(&expected, name)));
                    table.check(&case, name, error, 2e-5);
                }
                for (found, expected) in statistics(&found).into_iter().zip(statistics(&expected)) {
                    table.check(&case, "statistics", relative_error(found, &wide(expected)), 2e-5);
                }
            }
        }
        table.finish();
    }
}
