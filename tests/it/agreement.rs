//! Compares every backend with the native one: losses, and training step by step. Unlike `extremes`, this includes
//! backends that add gradients in an arbitrary order. `oracle` checks images and gradients.

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::render::{Backend, StepInput, StepOutput};
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::{Setup, Subject, scenes};
use densify_policies::policy::{
    Cadence, LossTerms, MaskTerm, Needs, NoiseTerm, PixelLoss, Signal, SignalKind, SignalSet,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::subject::{BLUE, RATES, make_with, others, step_input, wide};

#[test]
fn loss_and_gradient_match_the_native_backend() {
    let empty = Gaussians::default();
    let make = |subject: &Subject, pixel_loss| {
        let needs = Needs { pixel_loss, ..Needs::default() };
        make_with(subject, &empty, Setup { needs, ..Setup::default() })
    };
    let terms = |subject| [PixelLoss::L1, PixelLoss::Huber].map(|pixel_loss| (subject, pixel_loss));
    for (subject, pixel_loss) in others().iter().flat_map(terms) {
        let name = subject.name();
        let mut table = Table::new(&format!("loss with {pixel_loss:?}, {name} against native"));
        let mut native = make(&Subject::NATIVE, pixel_loss);
        let mut backend = make(subject, pixel_loss);
        // Includes widths with every possible remainder in the last SIMD vector.
        let sizes = [(64, 48), (37, 29), (1, 1), (17, 3)].into_iter();
        for (seed, (width, height)) in (0..).zip(sizes.chain((33..49).map(|width| (width, 19)))) {
            for (with_alpha, with_mask) in [(false, false), (true, false), (false, true)] {
                let (_, mut target) = scenes::noisy((width, height), 0.0, seed);
                let plane = target.rgb[..(width * height) as usize].to_vec();
                target.alpha = with_alpha.then(|| plane.clone());
                target.mask = with_mask.then_some(plane);
                let mut rng = ChaCha8Rng::seed_from_u64(90 + seed);
                // Half of the values almost equal the target, where SSIM suffers from cancellation.
                let mut value = |(i, near): (usize, &u8)| match i % 2 {
                    0 => f32::from(*near) / 255.0 + 1e-4,
                    _ => rng.random_range(0.0..1.0),
                };
                let rgb: Vec<f32> = target.rgb.iter().enumerate().map(&mut value).collect();
                let rendering = scenes::opaque(&rgb, &target);
                let (expected, expected_gradient) =
                    native.loss(&rendering, &target, BLUE).expect("a loss");
                let (found, gradient) = backend.loss(&rendering, &target, BLUE).expect("a loss");
                let case = format!("{width}x{height}, alpha {with_alpha}, mask {with_mask}");
                for (name, found, expected) in [
                    ("loss", found.loss, expected.loss),
                    ("l1", found.l1, expected.l1),
                    ("ssim", found.ssim, expected.ssim),
                ] {
                    table.check(&case, name, f64::from((found - expected).abs()), 2e-6);
                }
                table.check(
                    &case,
                    "gradient",
                    relative_error(&gradient, &wide(&expected_gradient)),
                    2e-5,
                );
            }
        }
        table.finish();
    }
}

fn step(
    backend: &mut dyn Backend,
    camera: &Camera,
    number: u32,
    needs: &Needs,
    cadence: Cadence,
) -> StepOutput {
    let target = scenes::target(camera);
    let degree = (number / 2).min(3) as u8;
    let input = StepInput {
        cadence,
        loss_terms: needs.loss_terms,
        noise: needs.noise,
        seed: 11,
        ..step_input(number, camera, &target, degree)
    };
    backend.train_step(&input).expect("a small image is rendered")
}

fn columns(backend: &mut dyn Backend, needs: &Needs) -> Vec<(Signal, Vec<f32>)> {
    let signals = backend.take_signals(needs.signals).expect("signals");
    // Minima are compared as reciprocals, because the minima of unseen Gaussians are infinite.
    let comparable = |s: Signal, x: f32| if s.kind() == SignalKind::Minimum { 1.0 / x } else { x };
    let column = |s: Signal| -> Vec<f32> {
        signals.get(s).expect("a requested signal").iter().map(|&x| comparable(s, x)).collect()
    };
    needs.signals.iter().map(|s| (s, column(s))).collect()
}

/// Checks the share of parameters that differ by more than a fraction of a step.
fn compare_models(table: &mut Table, case: &str, found: &Gaussians, expected: &Gaussians) {
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
        assert_eq!(found.len(), expected.len(), "{case}: {class}");
        // Where a gradient is only rounding error, Adam's first steps may go a full step either way. Few entries
        // are affected.
        let differing = found.iter().zip(expected).filter(|(a, b)| {
            let difference = (**a - **b).abs();
            difference.is_nan() || difference > 0.02 * rate + 1e-6 * b.abs()
        });
        let share = differing.count() as f64 / expected.len().max(1) as f64;
        table.check(case, class, share, 0.01);
    }
}

/// Typical needs of policies, each with its update cadence.
fn policy_needs() -> [(&'static str, Needs, Cadence); 8] {
    let all = SignalSet::from(Signal::ALL);
    let absolute = SignalSet::from([Signal::ScreenGradientAbs]);
    let pixels = SignalSet::from([Signal::PixelCount, Signal::WeightMax, Signal::ScreenGradient]);
    let some = SignalSet::from([Signal::ScreenGradient, Signal::WeightMax, Signal::Age]);
    let noise = NoiseTerm { strength: 5e3, sharpness: 100.0, opacity: 0.3 };
    let loss_terms = LossTerms { opacity: 0.01, scale: 0.02 };
    // Some masks reach the threshold within the six steps.
    let mask = MaskTerm { start: 1.0, rate: 0.01, weight: 1e-3, threshold: 0.725 };
    let [plain, third, other] =
        [(1, 1), (1, 3), (2, 4)].map(|(all, sh_rest)| Cadence { all, sh_rest });
    [
        ("plain", Needs::default(), plain),
        (
            "all signals and masks",
            Needs { signals: all, mask: Some(mask), ..Needs::default() },
            plain,
        ),
        ("absolute gradients", Needs { signals: absolute, ..Needs::default() }, plain),
        ("pixels and weights", Needs { signals: pixels, ..Needs::default() }, plain),
        (
            "terms and noise",
            Needs { signals: some, loss_terms, noise: Some(noise), ..Needs::default() },
            plain,
        ),
        (
            "Huber's function at the pixel",
            Needs { pixel_loss: PixelLoss::Huber, ..Needs::default() },
            plain,
        ),
        ("bands 1-3 every third step", Needs { cadence: third, ..Needs::default() }, third),
        ("every other step", Needs { cadence: other, ..Needs::default() }, other),
    ]
}

#[test]
fn training_steps_match_the_native_backend() {
    let camera = scenes::camera(48, 40, 51);
    let model = scenes::cloud(200, 3, &camera, 52);
    for subject in others() {
        let mut table = Table::new(&format!("training, {} against native", subject.name()));
        for (case, needs, cadence) in &policy_needs() {
            let start = |subject: &Subject| {
                make_with(subject, &model, Setup { needs: needs.clone(), ..Setup::default() })
            };
            let (mut native, mut backend) = (start(&Subject::NATIVE), start(&subject));
            for n in 1..=6 {
                if n == 4 {
                    native.begin_epoch();
                    backend.begin_epoch();
                }
                let expected = step(&mut *native, &camera, n, needs, *cadence);
                let found = step(&mut *backend, &camera, n, needs, *cadence);
                let error = f64::from((found.loss - expected.loss).abs());
                table.check(case, "loss", error, 1e-4);
                assert_eq!(found.visible, expected.visible, "{case}, step {n}");
                let entries = (found.entries as f64 / expected.entries as f64 - 1.0).abs();
                table.check(case, "entries", entries, 0.02);
            }
            let (found, expected) = (backend.download(), native.download());
            compare_models(&mut table, case, &found.expect("a model"), &expected.expect("a model"));
            for ((signal, found), (_, expected)) in
                columns(&mut *backend, needs).into_iter().zip(columns(&mut *native, needs))
            {
                let error = relative_error(&found, &wide(&expected));
                table.check(case, &format!("{signal:?}"), error, 0.02);
            }
        }
        table.finish();
    }
}
