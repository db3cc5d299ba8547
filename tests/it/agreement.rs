//! Every backend against the native one: images, gradients, losses, and training step by step.
//!
//! Two backends in `f32` are nearer to each other than to the float64 reference, so that errors too
//! small for `extremes` show here; and sums in any order, which `extremes` leaves out, are among them.

use densify::backend::cpu::ModelGradient;
use densify::backend::{Backend, Rendering, StepInput, StepOutput};
use densify::camera::Camera;
use densify::dataset::images::Image8;
use densify::gaussians::Gaussians;
use densify::verify::compare::{Limits, Table, compare_images, relative_error};
use densify::verify::reference::{CLASSES, Model, Rules, View, render};
use densify::verify::{Setup, Subject, scenes};
use densify_policies::policy::{Cadence, LossTerms, Needs, NoiseTerm, Signal, SignalSet};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::subject::{GREY, RATES, class, make, make_with, others, step_input, wide};

/// How far two backends may differ where no decision is close.
const LIMITS: Limits = Limits { interior: 2e-5, ..Limits::CPU };

/// Scenes: ordinary, each degree, many rows, sizes that are no multiple of a tile, and extremes.
fn all_scenes() -> Vec<(String, Gaussians, Camera)> {
    let mut all = Vec::new();
    for (rows, degree, width, height) in
        [(60, 0, 64, 64), (300, 1, 61, 35), (300, 2, 16, 16), (900, 3, 70, 50), (5, 3, 1, 33)]
    {
        let camera = scenes::camera(width, height, 100 + u64::from(degree));
        let model = scenes::cloud(rows, degree, &camera, 7 + u64::from(degree));
        all.push((format!("{rows} rows, degree {degree}, {width}x{height}"), model, camera));
    }
    let camera = scenes::camera(64, 48, 5);
    all.push(("extremes".into(), extremes(&camera), camera));
    all
}

/// Needles, huge and tiny rows, saturated opacities, and rows that hold what no row may.
fn extremes(camera: &Camera) -> Gaussians {
    let mut model = scenes::cloud(120, 2, camera, 77);
    for row in 0..model.len() {
        match row % 12 {
            0 => model.log_scales[row] = [-7.0, -0.5, -7.0],
            1 => model.log_scales[row] = [1.5, 1.0, 2.0],
            2 => model.log_scales[row] = [-13.0; 3],
            3 => model.opacity_logits[row] = 40.0,
            4 => model.opacity_logits[row] = -60.0,
            5 => model.means[row][1] = f32::NAN,
            6 => model.log_scales[row][2] = f32::INFINITY,
            7 => model.quats[row] = [0.0; 4],
            8 => model.sh[27 * row] = 1e20,
            9 => model.means[row] = scenes::world(camera, [0.1, 0.0, -3.0]),
            10 => model.log_scales[row] = [-30.0, 90.0, -30.0],
            _ => model.quats[row] = model.quats[row].map(|x| x * 1e-3),
        }
    }
    model
}

fn compare(table: &mut Table, what: &str, a: &Rendering, b: &Rendering, boundary: &[bool]) {
    let deepest = b.depth.iter().fold(1.0_f32, |most, d| most.max(*d));
    for (array, found, expected, limits) in [
        ("rgb", &a.rgb, &b.rgb, LIMITS),
        ("alpha", &a.alpha, &b.alpha, LIMITS),
        ("depth", &a.depth, &b.depth, LIMITS.scaled(f64::from(deepest))),
    ] {
        table.image(what, array, compare_images(found, &wide(expected), boundary, limits), limits);
    }
}

/// The statistics of each row, row after row.
fn statistics(gradient: &ModelGradient) -> [(&'static str, &[f32]); 5] {
    [
        ("mean2d", gradient.mean2d.as_flattened()),
        ("mean2d_abs", gradient.mean2d_abs.as_flattened()),
        ("colour", gradient.colour.as_flattened()),
        ("max_weight", &gradient.max_weight),
        ("sum_weight", &gradient.sum_weight),
    ]
}

#[test]
fn images_and_gradients_are_those_of_the_native_backend() {
    let expected: Vec<_> = all_scenes()
        .into_iter()
        .map(|(what, model, camera)| {
            let degree = model.sh_degree;
            let view = View { camera: &camera, background: GREY.map(f64::from), sh_degree: degree };
            let boundary = render(&Model::of(&model), view, &Rules::STANDARD).boundary;
            let upstream = scenes::narrowed(&scenes::upstream(&camera, 9).ignoring(&boundary));
            let outcome = make(&Subject::NATIVE, &model)
                .differentiate(&camera, GREY, degree, &upstream)
                .expect("a small image is rendered");
            (what, model, camera, boundary, upstream, outcome)
        })
        .collect();
    for subject in others() {
        let mut table = Table::new(&format!("{} against native", subject.name()));
        for (what, model, camera, boundary, upstream, (image, gradient)) in &expected {
            let outcome =
                make(&subject, model).differentiate(camera, GREY, model.sh_degree, upstream);
            let (found_image, found) = outcome.expect("a small image is rendered");
            compare(&mut table, what, &found_image, image, boundary);
            for name in CLASSES {
                let error = relative_error(class(&found, name), &wide(class(gradient, name)));
                table.check(what, name, error, 1e-4);
            }
            // Pixels with a close decision count here, each by a step at most.
            let close = boundary.iter().filter(|b| **b).count() as f64;
            for ((name, found), (_, expected)) in
                statistics(&found).into_iter().zip(statistics(gradient))
            {
                let flips = if name == "sum_weight" { close * Limits::CPU.step } else { 0.0 };
                table.check(what, name, relative_error(found, &wide(expected)), 2e-4 + flips);
            }
            assert_eq!(found.visible, gradient.visible, "{what}");
            let pixels = found.pixel_count.iter().zip(&gradient.pixel_count);
            let most = pixels.map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
            table.check(what, "pixel_count", f64::from(most), close);
        }
        table.finish();
    }
}

fn photograph(width: u32, height: u32, seed: u64, with_alpha: bool, with_mask: bool) -> Image8 {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut bytes = |n: u32| -> Vec<u8> { (0..n).map(|_| rng.random()).collect() };
    let pixels = width * height;
    Image8 {
        width,
        height,
        rgb: bytes(3 * pixels),
        alpha: with_alpha.then(|| bytes(pixels)),
        mask: with_mask.then(|| bytes(pixels)),
    }
}

#[test]
fn the_loss_and_its_gradient_are_those_of_the_native_backend() {
    let empty = Gaussians::default();
    let mut native = make(&Subject::NATIVE, &empty);
    for subject in others() {
        let mut table = Table::new(&format!("loss, {} against native", subject.name()));
        let mut backend = make(&subject, &empty);
        // Widths that leave every number of pixels for the last vector, among others.
        let sizes = [(64, 48), (37, 29), (1, 1), (17, 3)].into_iter();
        for (seed, (width, height)) in (0..).zip(sizes.chain((33..49).map(|width| (width, 19)))) {
            for (with_alpha, with_mask) in [(false, false), (true, false), (false, true)] {
                let target = photograph(width, height, seed, with_alpha, with_mask);
                let mut rng = ChaCha8Rng::seed_from_u64(90 + seed);
                // Half of it equal to the target but for little, where SSIM cancels.
                let mut value = |(i, near): (usize, &u8)| match i % 2 {
                    0 => f32::from(*near) / 255.0 + 1e-4,
                    _ => rng.random_range(0.0..1.0),
                };
                let rgb: Vec<f32> = target.rgb.iter().enumerate().map(&mut value).collect();
                let rendering = scenes::opaque(&rgb, &target);
                let (expected, by) = native.loss(&rendering, &target, GREY).expect("a loss");
                let (found, measured) = backend.loss(&rendering, &target, GREY).expect("a loss");
                let what = format!("{width}x{height}, alpha {with_alpha}, mask {with_mask}");
                for (name, found, expected) in [
                    ("loss", found.loss, expected.loss),
                    ("l1", found.l1, expected.l1),
                    ("ssim", found.ssim, expected.ssim),
                ] {
                    table.check(&what, name, f64::from((found - expected).abs()), 2e-6);
                }
                table.check(&what, "gradient", relative_error(&measured, &wide(&by)), 2e-5);
            }
        }
        table.finish();
    }
}

fn step(backend: &mut dyn Backend, camera: &Camera, number: u32, cadence: Cadence) -> StepOutput {
    let target = scenes::target(camera);
    let degree = (number / 2).min(3) as u8;
    let input = StepInput { cadence, seed: 11, ..step_input(number, camera, &target, degree) };
    backend.train_step(&input).expect("a small image is rendered")
}

fn columns(backend: &mut dyn Backend, needs: &Needs) -> Vec<(Signal, Vec<f32>)> {
    let signals = backend.take_signals(needs.signals).expect("signals");
    let of = |s: Signal| signals.get(s).expect("it was asked for").to_vec();
    needs.signals.iter().map(|s| (s, of(s))).collect()
}

/// Counts the parameters that differ by more than a fraction of a step.
fn compare_models(table: &mut Table, what: &str, found: &Gaussians, expected: &Gaussians) {
    let pairs: [(&str, &[f32], &[f32], f32); 5] = [
        ("means", found.means.as_flattened(), expected.means.as_flattened(), RATES.mean),
        (
            "log_scales",
            found.log_scales.as_flattened(),
            expected.log_scales.as_flattened(),
            RATES.log_scale,
        ),
        ("quats", found.quats.as_flattened(), expected.quats.as_flattened(), RATES.quat),
        ("opacity", &found.opacity_logits, &expected.opacity_logits, RATES.opacity),
        ("sh", &found.sh, &expected.sh, RATES.sh_dc),
    ];
    for (class, found, expected, rate) in pairs {
        assert_eq!(found.len(), expected.len(), "{what}: {class}");
        // Where a gradient is all rounding, Adam's first steps go either way by a step each; such
        // entries are few.
        let off = found.iter().zip(expected).filter(|(a, b)| {
            let difference = (**a - **b).abs();
            difference.is_nan() || difference > 0.02 * rate + 1e-6 * b.abs()
        });
        let share = off.count() as f64 / expected.len().max(1) as f64;
        table.check(what, class, share, 0.01);
    }
}

/// What policies ask for, each with the cadence of its steps.
fn asked_for() -> [(&'static str, Needs, Cadence); 8] {
    let all = SignalSet::from(Signal::ALL);
    let absolute = SignalSet::from([Signal::ScreenGradientAbs]);
    let pixels = SignalSet::from([Signal::PixelCount, Signal::WeightMax, Signal::ScreenGradient]);
    let some = SignalSet::from([Signal::ScreenGradient, Signal::WeightMax, Signal::Age]);
    let noise = NoiseTerm { strength: 5e3, sharpness: 100.0, opacity: 0.3 };
    let loss_terms = LossTerms { opacity: 0.01, scale: 0.02 };
    let [plain, third, other] =
        [(1, 1), (1, 3), (2, 4)].map(|(all, sh_rest)| Cadence { all, sh_rest });
    [
        ("plain", Needs::default(), plain),
        ("all signals", Needs { signals: all, ..Needs::default() }, plain),
        ("absolute gradients", Needs { signals: absolute, ..Needs::default() }, plain),
        ("pixels and weights", Needs { signals: pixels, ..Needs::default() }, plain),
        // Half of the rows are nearer.
        (
            "near views weigh less",
            Needs { signals: all, full_depth: 3.5, ..Needs::default() },
            plain,
        ),
        (
            "terms and noise",
            Needs { signals: some, loss_terms, noise: Some(noise), ..Needs::default() },
            plain,
        ),
        ("bands 1-3 every third step", Needs { cadence: third, ..Needs::default() }, third),
        ("every other step", Needs { cadence: other, ..Needs::default() }, other),
    ]
}

#[test]
fn steps_are_those_of_the_native_backend() {
    let camera = scenes::camera(48, 40, 51);
    let model = scenes::cloud(200, 3, &camera, 52);
    for subject in others() {
        let mut table = Table::new(&format!("training, {} against native", subject.name()));
        for (what, needs, cadence) in &asked_for() {
            let with = |subject: &Subject| {
                make_with(subject, &model, Setup { needs: needs.clone(), ..Setup::default() })
            };
            let (mut native, mut backend) = (with(&Subject::NATIVE), with(&subject));
            for n in 1..=6 {
                if n == 4 {
                    native.begin_epoch();
                    backend.begin_epoch();
                }
                let expected = step(&mut *native, &camera, n, *cadence);
                let found = step(&mut *backend, &camera, n, *cadence);
                let off = f64::from((found.loss - expected.loss).abs());
                table.check(what, "loss", off, 1e-4);
                assert_eq!(found.visible, expected.visible, "{what}, step {n}");
                let entries = (found.entries as f64 / expected.entries as f64 - 1.0).abs();
                table.check(what, "entries", entries, 0.02);
            }
            native.measure_weights(&camera, 3).expect("weights");
            backend.measure_weights(&camera, 3).expect("weights");
            let (found, expected) = (backend.download(), native.download());
            compare_models(&mut table, what, &found.expect("a model"), &expected.expect("a model"));
            for ((signal, found), (_, expected)) in
                columns(&mut *backend, needs).into_iter().zip(columns(&mut *native, needs))
            {
                let error = relative_error(&found, &wide(&expected));
                table.check(what, &format!("{signal:?}"), error, 0.02);
            }
        }
        table.finish();
    }
}
