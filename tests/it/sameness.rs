//! What must not change a single bit of a repeatable backend: threads, the room for tile lists, the order of
//! the rows, running twice, rows that are not seen. Sums in any order stay near to those.

use densify::backend::cpu::{InstructionSet, ModelGradient};
use densify::backend::{Rendering, StepOutput};
use densify::camera::Camera;
use densify::gaussians::Gaussians;
use densify::verify::compare::{Table, relative_error};
use densify::verify::reference::CLASSES;
use densify::verify::{Differentiable, Setup, Subject, scenes};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use crate::subject::{
    GREY, atomics, class, devices, make, make_with, repeatable, step_input, wide,
};

/// An image with its gradients, and a model after some steps with what each of them said.
type Run = (Vec<u32>, Gaussians, Vec<StepOutput>);

fn differentiate(
    backend: &mut dyn Differentiable,
    camera: &Camera,
    sh_degree: u8,
) -> (Rendering, ModelGradient) {
    let upstream = scenes::narrowed(&scenes::upstream(camera, 12));
    let outcome = backend.differentiate(camera, GREY, sh_degree, &upstream);
    outcome.expect("a small image is rendered")
}

/// The statistics of rows that are numbers.
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

/// Trains after a look.
fn run(backend: &mut dyn Differentiable, camera: &Camera) -> Run {
    let degree = backend.sh_degree();
    let seen = bits(&differentiate(backend, camera, degree));
    let (_, target) = scenes::noisy((camera.width, camera.height), 0.0, 3);
    let step = |n| backend.train_step(&step_input(n, camera, &target, degree));
    let outputs: Vec<_> = (1..=4).map(step).collect::<Result<_, _>>().expect("small images");
    (seen, backend.download().expect("a model"), outputs)
}

/// The same but for the number of bands.
fn without_bands((seen, model, outputs): Run) -> Run {
    (seen, model, outputs.into_iter().map(|output| StepOutput { bands: 1, ..output }).collect())
}

#[test]
fn threads_change_nothing() {
    let camera = scenes::camera(150, 90, 31);
    let model = scenes::cloud(700, 2, &camera, 41);
    for instructions in InstructionSet::available() {
        let with = |threads| {
            let threads = Some(threads);
            run(&mut *make(&Subject::Native { instructions, threads }, &model), &camera)
        };
        let expected = with(1);
        for threads in [2, 5] {
            assert!(with(threads) == expected, "{threads} threads, {instructions}");
        }
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

/// Records that do not fit are made in parts: within a band, and within a tile.
#[test]
fn room_for_records_changes_nothing() {
    let camera = scenes::camera(140, 120, 32);
    let model = scenes::cloud(150, 1, &camera, 42);
    let with = |tile_cap, record_cap| {
        let setup = Setup { tile_cap: Some(tile_cap), record_cap, ..Setup::default() };
        run(&mut *make_with(&Subject::NATIVE, &model, setup), &camera)
    };
    let whole = with(1 << 20, None);
    assert!(whole.2[0].entries > 1_500 && whole.2[0].bands == 1, "{:?}", whole.2[0]);
    for (tile_cap, record_cap) in [(1 << 20, 1_500), (1 << 20, 100), (1 << 20, 7), (500, 100)] {
        let some = with(tile_cap, Some(record_cap));
        assert!(without_bands(some) == whole, "{tile_cap} pairs, {record_cap} records");
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
            // Another view in between, of another size, leaves nothing behind.
            let _ = differentiate(&mut *backend, &other, 1);
            let second = differentiate(&mut *backend, &camera, 3);
            assert!(bits(&first) == bits(&second), "{name}");
            let rendered = backend.render(&camera, GREY, 3).expect("a small image is rendered");
            assert!(rendered == first.0, "{name}: render and differentiate draw different images");
            assert!(run(&mut *backend, &camera).0 == bits(&first), "{name}, training");
        }
    }
}

fn permuted(model: &Gaussians, order: &[usize]) -> Gaussians {
    Gaussians {
        sh_degree: model.sh_degree,
        means: order.iter().map(|&r| model.means[r]).collect(),
        log_scales: order.iter().map(|&r| model.log_scales[r]).collect(),
        quats: order.iter().map(|&r| model.quats[r]).collect(),
        opacity_logits: order.iter().map(|&r| model.opacity_logits[r]).collect(),
        sh: order.iter().flat_map(|&r| model.sh_of(r).to_vec()).collect(),
    }
}

#[test]
fn the_order_of_the_rows_changes_nothing_where_depths_differ() {
    let camera = scenes::camera(70, 40, 35);
    let model = scenes::cloud(90, 1, &camera, 44);
    let mut order: Vec<usize> = (0..model.len()).collect();
    order.shuffle(&mut ChaCha8Rng::seed_from_u64(9));
    for subject in repeatable() {
        let look = |model: &Gaussians| differentiate(&mut *make(&subject, model), &camera, 1);
        let (image, gradient) = look(&model);
        let (shuffled_image, shuffled) = look(&permuted(&model, &order));
        let name = subject.name();
        assert!(image == shuffled_image, "{name}: the image depends on the order of the rows");
        for what in CLASSES {
            let (from, to) = (class(&gradient, what), class(&shuffled, what));
            let n = from.len() / model.len();
            for (new, &old) in order.iter().enumerate() {
                let (old_row, new_row) =
                    (&from[old * n..(old + 1) * n], &to[new * n..(new + 1) * n]);
                assert!(old_row == new_row, "{name}: {what} of {old}");
            }
        }
    }
}

/// Case 15 of the [selftest](densify::verify) holds the same against the reference.
#[test]
fn equal_depths_are_drawn_in_row_order() {
    let camera = scenes::camera(40, 40, 36);
    let mut model = scenes::cloud(1000, 0, &camera, 45);
    let place = scenes::world(&camera, [0.0, 0.0, 3.0]);
    model.means.fill(place);
    let with = |threads| {
        let subject =
            Subject::Native { instructions: InstructionSet::Best, threads: Some(threads) };
        bits(&differentiate(&mut *make(&subject, &model), &camera, 0))
    };
    let expected = with(1);
    for threads in [1, 2, 3, 8, 64] {
        assert!((0..2).all(|_| with(threads) == expected), "{threads} threads");
    }
}

#[test]
fn a_row_that_is_not_seen_changes_nothing() {
    let camera = scenes::camera(50, 44, 37);
    let model = scenes::cloud(40, 1, &camera, 46);
    for subject in repeatable() {
        let look = |model: &Gaussians| differentiate(&mut *make(&subject, model), &camera, 1);
        let (image, _) = look(&model);
        let unseen: [(&str, [f64; 3], f32); 3] = [
            ("behind", [0.0, 0.0, -1.0], 1.0),
            ("beside", [50.0, 0.0, 2.0], 1.0),
            ("transparent", [0.0, 0.0, 2.0], -6.0),
        ];
        for (what, local, logit) in unseen {
            let mut more = model.clone();
            let mean = scenes::world(&camera, local);
            scenes::push(&mut more, mean, [0.1; 3], [1.0, 0.0, 0.0, 0.0], logit, |_| 0.3);
            let (with, gradient) = look(&more);
            assert!(with == image, "{what}, {}", subject.name());
            let last = more.len() - 1;
            assert_eq!(gradient.pixel_count[last], 0, "{what}");
            assert_eq!(gradient.means[last].map(f32::to_bits), [0; 3], "{what}");
        }
    }
}

/// Sums start at 0 with every pass, go on over bands, and start again where a pass is taken again because
/// its bands did not do.
#[test]
fn atomic_sums_are_those_of_slots_with_any_cap() {
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
                let what = format!("cap {tile_cap:?}, pass {pass}");
                for name in CLASSES {
                    let error = relative_error(class(&found, name), &wide(class(&expected, name)));
                    table.check(&what, name, error, 2e-5);
                }
                for (found, expected) in statistics(&found).into_iter().zip(statistics(&expected)) {
                    table.check(&what, "statistics", relative_error(found, &wide(expected)), 2e-5);
                }
            }
        }
        table.finish();
    }
}
