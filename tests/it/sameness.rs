//! What must not change a single bit: threads, the room for tile lists, the order of the rows,
//! running twice.

use densify::backend::cpu::ModelGradient;
use densify::backend::{Backend, Rendering, StepInput, StepOutput};
use densify::camera::Camera;
use densify::dataset::images::Image8;
use densify::gaussians::Gaussians;
use densify_policies::policy::Cadence;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::subject::{self, RATES, Resources};
use densify::verify::reference::CLASSES;
use densify::verify::scenes;

const GREY: [f32; 3] = [0.3, 0.4, 0.6];

fn run(model: &Gaussians, camera: &Camera, resources: Resources) -> (Rendering, ModelGradient) {
    let mut backend = subject::backend(model, resources);
    let upstream = scenes::upstream(camera, 12);
    subject::differentiate(&mut backend, camera, GREY, model.sh_degree, &upstream)
}

/// The bits of an image and of every gradient and statistic.
fn bits((image, gradient): &(Rendering, ModelGradient)) -> Vec<u32> {
    let classes = CLASSES.map(|class| subject::class(gradient, class));
    let images: [&[f32]; 3] = [&image.rgb, &image.alpha, &image.depth];
    let screen: [&[f32]; 5] = [
        gradient.mean2d.as_flattened(),
        gradient.mean2d_abs.as_flattened(),
        gradient.colour.as_flattened(),
        &gradient.max_weight,
        &gradient.sum_weight,
    ];
    let all = images.into_iter().chain(classes).chain(screen);
    let counts = gradient.pixel_count.iter().copied();
    all.flatten().map(|v| v.to_bits()).chain(counts).collect()
}

fn target(camera: &Camera, seed: u64) -> Image8 {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = 3 * (camera.width * camera.height) as usize;
    let rgb = (0..n).map(|_| rng.random()).collect();
    Image8 { width: camera.width, height: camera.height, rgb, alpha: None, mask: None }
}

/// The model after some steps, and the scalars of each.
fn train(model: &Gaussians, camera: &Camera, resources: Resources) -> (Gaussians, Vec<StepOutput>) {
    let mut backend = subject::backend(model, resources);
    let target = target(camera, 3);
    let outputs = (1..=4)
        .map(|step| {
            let input = StepInput {
                step,
                view: 0,
                camera,
                target: &target,
                background: GREY,
                sh_degree: model.sh_degree,
                rates: RATES,
                cadence: Cadence::default(),
                seed: 1,
                ssim_weight: 1.0,
            };
            backend.train_step(&input).expect("a small image is rendered")
        })
        .collect();
    (backend.download().expect("a model"), outputs)
}

#[test]
fn threads_change_nothing() {
    let camera = scenes::camera(150, 90, 31);
    let model = scenes::cloud(700, 2, &camera, 41);
    let with = |threads| Resources { threads: Some(threads), ..Resources::default() };
    let (image, trained) = (run(&model, &camera, with(1)), train(&model, &camera, with(1)));
    for threads in [1, 2, 5] {
        assert!(bits(&run(&model, &camera, with(threads))) == bits(&image), "{threads} threads");
        assert!(train(&model, &camera, with(threads)) == trained, "{threads} threads, training");
    }
}

#[test]
fn bands_change_nothing() {
    let camera = scenes::camera(140, 120, 32);
    let model = scenes::cloud(150, 1, &camera, 42);
    let capped = |cap| Resources { tile_cap: Some(cap), ..Resources::default() };
    let (image, (trained, steps)) =
        (run(&model, &camera, capped(1 << 20)), train(&model, &camera, capped(1 << 20)));
    assert_eq!(steps[0].bands, 1);
    for cap in [1, 500, 1500] {
        assert!(bits(&run(&model, &camera, capped(cap))) == bits(&image), "cap {cap}");
        let (banded, banded_steps) = train(&model, &camera, capped(cap));
        assert!(banded_steps[0].bands > 1, "cap {cap}: {} entries fit", steps[0].entries);
        assert!(banded == trained, "cap {cap}, training");
        for (banded, step) in banded_steps.iter().zip(&steps) {
            assert_eq!(StepOutput { bands: 1, ..*banded }, *step, "cap {cap}");
        }
    }
}

/// Records that do not fit are made in parts: within a band, and within a tile.
#[test]
fn room_for_records_changes_nothing() {
    let camera = scenes::camera(140, 120, 32);
    let model = scenes::cloud(150, 1, &camera, 42);
    let whole = Resources { tile_cap: Some(1 << 20), ..Resources::default() };
    let (image, trained) = (run(&model, &camera, whole), train(&model, &camera, whole));
    assert!(trained.1[0].entries > 1_500 && trained.1[0].bands == 1, "{:?}", trained.1[0]);
    for (tile_cap, record_cap) in [(1 << 20, 1_500), (1 << 20, 100), (1 << 20, 7), (500, 100)] {
        let some = Resources { tile_cap: Some(tile_cap), record_cap: Some(record_cap), ..whole };
        assert!(bits(&run(&model, &camera, some)) == bits(&image), "{some:?}");
        assert!(train(&model, &camera, some).0 == trained.0, "{some:?}, training");
    }
}

#[test]
fn running_twice_changes_nothing() {
    let camera = scenes::camera(60, 50, 33);
    let other = scenes::camera(90, 20, 34);
    let model = scenes::cloud(60, 3, &camera, 43);
    let mut backend = subject::backend(&model, Resources::default());
    let upstream = scenes::upstream(&camera, 12);
    let first = subject::differentiate(&mut backend, &camera, GREY, 3, &upstream);
    // Another view in between, of another size, leaves nothing behind.
    let _ = subject::differentiate(&mut backend, &other, GREY, 1, &scenes::upstream(&other, 1));
    let second = subject::differentiate(&mut backend, &camera, GREY, 3, &upstream);
    assert!(bits(&first) == bits(&second));
    let rendered = backend.render(&camera, GREY, 3).expect("a small image is rendered");
    assert!(rendered == first.0, "render and differentiate draw different images");
}

fn permuted(model: &Gaussians, order: &[usize]) -> Gaussians {
    let pick = |row: &usize| *row;
    Gaussians {
        sh_degree: model.sh_degree,
        means: order.iter().map(|r| model.means[pick(r)]).collect(),
        log_scales: order.iter().map(|r| model.log_scales[pick(r)]).collect(),
        quats: order.iter().map(|r| model.quats[pick(r)]).collect(),
        opacity_logits: order.iter().map(|r| model.opacity_logits[pick(r)]).collect(),
        sh: order.iter().flat_map(|r| model.sh_of(pick(r)).to_vec()).collect(),
    }
}

#[test]
fn the_order_of_the_rows_changes_nothing_where_depths_differ() {
    let camera = scenes::camera(70, 40, 35);
    let model = scenes::cloud(90, 1, &camera, 44);
    let mut order: Vec<usize> = (0..model.len()).collect();
    order.shuffle(&mut ChaCha8Rng::seed_from_u64(9));
    let (image, gradient) = run(&model, &camera, Resources::default());
    let (shuffled_image, shuffled) = run(&permuted(&model, &order), &camera, Resources::default());
    assert!(image == shuffled_image, "the image depends on the order of the rows");
    for class in CLASSES {
        let (from, to) = (subject::class(&gradient, class), subject::class(&shuffled, class));
        let n = from.len() / model.len();
        for (new, &old) in order.iter().enumerate() {
            assert!(from[old * n..(old + 1) * n] == to[new * n..(new + 1) * n], "{class} of {old}");
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
    let with = |threads| Resources { threads: Some(threads), ..Resources::default() };
    let image = bits(&run(&model, &camera, with(1)));
    for threads in [1, 2, 3, 8, 64] {
        for _ in 0..4 {
            assert!(bits(&run(&model, &camera, with(threads))) == image, "{threads} threads");
        }
    }
}

#[test]
fn a_row_that_is_not_seen_changes_nothing() {
    let camera = scenes::camera(50, 44, 37);
    let model = scenes::cloud(40, 1, &camera, 46);
    let (image, _) = run(&model, &camera, Resources::default());
    let colour = |_| 0.3;
    let unseen: [(&str, [f64; 3], f32); 3] = [
        ("behind", [0.0, 0.0, -1.0], 1.0),
        ("beside", [50.0, 0.0, 2.0], 1.0),
        ("transparent", [0.0, 0.0, 2.0], -6.0),
    ];
    for (what, local, logit) in unseen {
        let mut more = model.clone();
        let mean = scenes::world(&camera, local);
        scenes::push(&mut more, mean, [0.1; 3], [1.0, 0.0, 0.0, 0.0], logit, colour);
        let (with, gradient) = run(&more, &camera, Resources::default());
        assert!(with == image, "{what}");
        let last = more.len() - 1;
        assert_eq!(gradient.pixel_count[last], 0, "{what}");
        assert_eq!(gradient.means[last].map(f32::to_bits), [0; 3], "{what}");
    }
}
