//! Policy declarations other than signals: loss terms, noise on the means, masks and optimiser cadence. Each is
//! compared with its formula, computed here in f64.

#![expect(clippy::float_cmp, reason = "unchanged values must match bit for bit")]

use std::ops::Range;

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::core::image::Image8;
use densify::render::ImageGradient;
use densify::render::cpu::ModelGradient;
use densify::render::{Backend, StepInput};
use densify::selftest::{Differentiable, Setup, Subject, scenes};
use densify_policies::adc::clone_at;
use densify_policies::plan::{EditPlan, OpacityRule, Seed, Update};
use densify_policies::policy::{Cadence, LossTerms, MaskTerm, Needs, NoiseTerm, Signal, SignalSet};
use glam::DVec3;

use crate::subject::{
    RATES, class, make, make_with, normalised, on_each, repeatable, step_input, turned_away,
};

const BACKGROUND: [f32; 3] = [0.1, 0.3, 0.2];
const EVERY: Cadence = Cadence { all: 1, sh_rest: 1 };

fn view(number: u32) -> Camera {
    let first = scenes::camera(41, 33, 81);
    let shift = DVec3::new(0.1 * f64::from(number), -0.05 * f64::from(number), 0.0);
    scenes::rounded(&Camera { translation: first.translation + shift, ..first })
}

fn target(camera: &Camera, seed: u64) -> Image8 {
    scenes::noisy((camera.width, camera.height), 0.0, seed).1
}

fn model(rows: usize) -> Gaussians {
    normalised(scenes::cloud(rows, 1, &view(0), 82))
}

fn backend(subject: &Subject, model: &Gaussians, needs: Needs) -> Box<dyn Differentiable> {
    make_with(subject, model, Setup { needs, ..Setup::default() })
}

/// Trains one step with the loss terms and noise of `needs`.
fn step(backend: &mut dyn Backend, camera: &Camera, step: u32, needs: &Needs, cadence: Cadence) {
    let target = target(camera, step.into());
    let sh_degree = backend.sh_degree();
    let input = StepInput {
        background: BACKGROUND,
        loss_terms: needs.loss_terms,
        noise: needs.noise,
        cadence,
        seed: 5,
        ..step_input(step, camera, &target, sh_degree)
    };
    backend.train_step(&input).expect("a small image is rendered");
}

/// Identical Gaussians, every second one rotated by 90°.
fn identical_gaussians(rows: usize) -> Gaussians {
    let mut model = Gaussians { sh_degree: 0, ..Gaussians::default() };
    let half = std::f32::consts::FRAC_1_SQRT_2;
    for row in 0..rows {
        let quat = if row % 2 == 0 { [1.0, 0.0, 0.0, 0.0] } else { [half, 0.0, 0.0, half] };
        scenes::push(&mut model, [0.5; 3], [0.1, 0.2, 0.4], quat, -4.0, |_| 0.1);
    }
    model
}

#[test]
fn noise_has_the_declared_covariance() {
    on_each(repeatable(), |subject| {
        let rows = 20_000;
        let model = identical_gaussians(rows);
        let noise = NoiseTerm { strength: 7.0, sharpness: 100.0, opacity: 0.005 };
        let run = |subject: &Subject, at: u32| {
            let needs = Needs { noise: Some(noise), ..Needs::default() };
            let mut backend = backend(subject, &model, needs.clone());
            step(&mut *backend, &turned_away(&view(0)), at, &needs, EVERY);
            backend.download().expect("a model")
        };
        let moved = run(subject, 3);
        if let Subject::Native { instructions, .. } = *subject {
            let single_threaded = Subject::Native { instructions, threads: Some(1) };
            assert!(moved == run(&single_threaded, 3), "noise depends on the threads");
        }
        assert!(moved.means != run(subject, 4).means, "noise does not depend on the step");
        assert_eq!((&moved.log_scales, &moved.sh), (&model.log_scales, &model.sh));
        // The opacity is σ(−4) = 0.017986, which scales the noise by σ(−100·0.012986).
        let opacity = 1.0 / (1.0 + 4.0_f64.exp());
        let share = 1.0 / (1.0 + (100.0 * (opacity - 0.005)).exp());
        let factor = 7.0 * f64::from(RATES.noise) * share;
        // The noise has the standard deviation Σ·factor. Rotated Gaussians have x and y swapped.
        for (parity, variances) in [(0, [0.01, 0.04, 0.16]), (1, [0.04, 0.01, 0.16])] {
            let of_parity = moved.means.iter().skip(parity).step_by(2);
            let deltas: Vec<[f64; 3]> =
                of_parity.map(|mean| mean.map(|x| f64::from(x) - 0.5)).collect();
            let n = deltas.len() as f64;
            for i in 0..3 {
                for j in 0..3 {
                    let deviation = |k: usize| factor * variances[k];
                    let found = deltas.iter().map(|d| d[i] * d[j]).sum::<f64>() / n;
                    let expected = if i == j { deviation(i).powi(2) } else { 0.0 };
                    // The bound is five standard errors.
                    let error = if i == j { 2.0_f64 } else { 1.0 };
                    let bound = 5.0 * (error / n).sqrt() * deviation(i) * deviation(j);
                    assert!(
                        (found - expected).abs() < bound,
                        "{parity} {i} {j}: {found} {expected}"
                    );
                }
                let mean = deltas.iter().map(|d| d[i]).sum::<f64>() / n;
                assert!(mean.abs() < 5.0 * factor * variances[i] / n.sqrt(), "{i}: {mean}");
            }
        }
    });
}

/// The gradient of the image loss, without a step.
fn gradient(subject: &Subject, model: &Gaussians, camera: &Camera, seed: u64) -> ModelGradient {
    let mut backend = make(subject, model);
    let rendering = backend.render(camera, BACKGROUND, 1).expect("a small image is rendered");
    let outcome = backend.loss(&rendering, &target(camera, seed), BACKGROUND);
    let (_, rgb) = outcome.expect("a loss");
    let zeros = vec![0.0; rendering.alpha.len()];
    let upstream = ImageGradient { rgb, alpha: zeros.clone(), depth: zeros };
    backend.differentiate(camera, BACKGROUND, 1, &upstream).expect("a small image is rendered").1
}

/// Values of a model by class, in the order of [`class`].
fn values<'a>(model: &'a Gaussians, class: &str) -> &'a [f32] {
    match class {
        "means" => model.means.as_flattened(),
        "log_scales" => model.log_scales.as_flattened(),
        "opacity_logits" => &model.opacity_logits,
        _ => &model.sh,
    }
}

/// Adam of one class in f64, with gradients summed between its steps.
struct Adam {
    class: &'static str,
    rate: f64,
    /// The range of values of a row that belong to this class.
    values: Range<usize>,
    /// The number of values of a row.
    width: usize,
    steps: i32,
    sums: Vec<f64>,
    moments: [Vec<f64>; 2],
}

impl Adam {
    fn new(
        class: &'static str,
        rate: f32,
        values: Range<usize>,
        width: usize,
        rows: usize,
    ) -> Self {
        let zeros = vec![0.0; width * rows];
        let moments = [zeros.clone(), zeros.clone()];
        Self { class, rate: rate.into(), values, width, steps: 0, sums: zeros, moments }
    }

    /// Compares a step with the expected one; returns the largest error as a multiple of the learning rate.
    fn check(
        &mut self,
        before: &Gaussians,
        after: &Gaussians,
        gradient: &ModelGradient,
        due: bool,
    ) -> f64 {
        let (before, after) = (values(before, self.class), values(after, self.class));
        for (sum, g) in self.sums.iter_mut().zip(class(gradient, self.class)) {
            *sum += f64::from(*g);
        }
        let indices: Vec<usize> =
            (0..before.len()).filter(|i| self.values.contains(&(i % self.width))).collect();
        if !due {
            let is_unchanged = indices.iter().all(|&i| before[i].to_bits() == after[i].to_bits());
            assert!(is_unchanged, "{}", self.class);
            return 0.0;
        }
        self.steps += 1;
        let largest = indices.iter().map(|&i| self.sums[i].abs()).fold(0.0, f64::max);
        let mut worst: f64 = 0.0;
        for i in indices {
            let g = std::mem::take(&mut self.sums[i]);
            let [m, v] = &mut self.moments;
            m[i] = 0.9 * m[i] + 0.1 * g;
            v[i] = 0.999 * v[i] + 0.001 * g * g;
            let m_hat = m[i] / (1.0 - 0.9_f64.powi(self.steps));
            let v_hat = v[i] / (1.0 - 0.999_f64.powi(self.steps));
            // The sign of a nearly cancelled sum is determined by rounding.
            if g.abs() > 1e-3 * largest {
                let expected = self.rate * m_hat / v_hat.sqrt();
                let found = f64::from(before[i]) - f64::from(after[i]);
                worst = worst.max((found - expected).abs() / self.rate);
            }
        }
        worst
    }
}

/// Includes the loss terms, which affect Gaussians outside all views, too.
#[test]
fn steps_use_the_gradients_accumulated_since_the_last_step() {
    const ROWS: usize = 40;
    let none = LossTerms::default();
    let pulling = LossTerms { opacity: 0.01, scale: 0.02 };
    let cases = [(2, 1, none), (1, 3, none), (2, 4, none), (20, 16, none), (1, 1, pulling)];
    on_each(repeatable(), |subject| {
        for (all, sh_rest, loss_terms) in cases {
            let longest = Cadence { all, sh_rest };
            // In one case the cadence changes, with intervals below the declared ones.
            let cadence_at = |step: u32| match all {
                20 if step < 5 => Cadence { all: 1, sh_rest: 2 },
                20 => Cadence { all: 2, sh_rest: 3 },
                _ => longest,
            };
            let needs = Needs { cadence: longest, loss_terms, ..Needs::default() };
            let mut backend = backend(subject, &model(ROWS), needs.clone());
            let mut classes = [
                Adam::new("means", RATES.mean, 0..3, 3, ROWS),
                Adam::new("log_scales", RATES.log_scale, 0..3, 3, ROWS),
                Adam::new("opacity_logits", RATES.opacity, 0..1, 1, ROWS),
                Adam::new("sh", RATES.sh_dc, 0..3, 12, ROWS),
                Adam::new("sh", RATES.sh_rest, 3..12, 12, ROWS),
            ];
            let steps = if loss_terms == none { 8 } else { 30 };
            for number in 1..=steps {
                let is_away = loss_terms != none && number % 2 == 0;
                let camera = if is_away { turned_away(&view(0)) } else { view(number % 3) };
                let before = backend.download().expect("a model");
                let mut gradient = gradient(subject, &before, &camera, number.into());
                for row in 0..ROWS {
                    let opacity = 1.0 / (1.0 + (-before.opacity_logits[row]).exp());
                    gradient.opacity_logits[row] +=
                        loss_terms.opacity / ROWS as f32 * opacity * (1.0 - opacity);
                    for (g, scale) in
                        gradient.log_scales[row].iter_mut().zip(before.log_scales[row])
                    {
                        *g += loss_terms.scale / (3 * ROWS) as f32 * scale.exp();
                    }
                }
                step(&mut *backend, &camera, number, &needs, cadence_at(number));
                let after = backend.download().expect("a model");
                let [main, rest] = cadence_at(number).steps_at(number);
                for (i, class) in classes.iter_mut().enumerate() {
                    let due = if i == 4 { rest } else { main };
                    let error = class.check(&before, &after, &gradient, due);
                    let case = format!("{longest:?}, step {number}, {}", class.class);
                    assert!(error < 0.01, "{case}: {error} learning rates");
                }
            }
        }
    });
}

/// A mask scales opacity and scales and gets the corresponding gradient. Gaussians whose mask falls to the threshold
/// become transparent. Masks move with their rows.
#[test]
fn masks_follow_their_gradient_and_hide_gaussians() {
    const ROWS: usize = 40;
    let mask = MaskTerm { start: 1.0, rate: 0.02, weight: 1e-3, threshold: 0.72 };
    let signals = SignalSet::from([Signal::Mask]);
    let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
    on_each(repeatable(), |subject| {
        let needs = Needs { mask: Some(mask), signals, ..Needs::default() };
        let mut backend = backend(subject, &model(ROWS), needs.clone());
        let values = |backend: &mut dyn Differentiable| -> Vec<f64> {
            let signals = backend.take_signals(signals).expect("signals can be taken");
            let masks = signals.get(Signal::Mask).expect("a declared signal");
            masks.iter().map(|&value| f64::from(value)).collect()
        };
        let mut expected = [[1.0_f64, 0.0, 0.0]; ROWS];
        for number in 1..=5 {
            let camera = view(number % 3);
            let before = backend.download().expect("a model");
            let gradient = gradient(subject, &before, &camera, number.into());
            step(&mut *backend, &camera, number, &needs, EVERY);
            let found = values(&mut *backend);
            let after = backend.download().expect("a model");
            for (row, [m, first, second]) in expected.iter_mut().enumerate() {
                let opacity = sigmoid(f64::from(before.opacity_logits[row]));
                let by_scales: f64 = gradient.log_scales[row].map(f64::from).iter().sum();
                let by_factor = f64::from(gradient.opacity_logits[row]) / (1.0 - opacity);
                let slope = sigmoid(*m) * sigmoid(-*m);
                let g = (by_factor + by_scales + 1e-3 / ROWS as f64) * slope;
                *first = 0.9 * *first + 0.1 * g;
                *second = 0.999 * *second + 0.001 * g * g;
                let age = number as i32;
                let first_hat = *first / (1.0 - 0.9_f64.powi(age));
                let second_hat = *second / (1.0 - 0.999_f64.powi(age));
                *m -= 0.02 * first_hat / second_hat.sqrt();
                // The tolerance is a hundredth of a step.
                let error = (found[row] - sigmoid(*m)).abs();
                assert!(error < 0.01 * 0.02, "step {number}, row {row}: {} {m}", found[row]);
                let is_transparent = after.opacity_logits[row] < -9.0;
                let is_close = (sigmoid(*m) - 0.72).abs() < 1e-4;
                assert!(is_close || is_transparent == (sigmoid(*m) <= 0.72), "row {row}: {m}");
            }
        }
        let masks = values(&mut *backend);
        let fallen = masks.iter().filter(|&&mask| mask <= 0.72).count();
        assert!((1..ROWS - 1).contains(&fallen), "{fallen} of {ROWS} fell to the threshold");
        let mut plan = EditPlan::new(ROWS, ROWS);
        plan.prune_all([0, 1]);
        plan.grow(5, clone_at([0.1; 3])).expect("room in the budget");
        plan.append(Seed::round([0.5; 3], [0.5; 3], 0.1, 0.1)).expect("room in the budget");
        backend.apply(&plan.compile(), 5, 5).expect("a plan is applied");
        // The child follows its parent with the same mask; the seed is last, with a new mask.
        let edited = values(&mut *backend);
        assert_eq!(edited[..4], masks[2..6]);
        assert_eq!(edited[4..ROWS - 1], masks[5..]);
        assert!((edited[ROWS - 1] - sigmoid(1.0)).abs() < 1e-6);
    });
}

#[test]
fn accumulated_gradients_move_with_their_rows() {
    on_each(repeatable(), |subject| {
        let cadence = Cadence { all: 2, sh_rest: 2 };
        let model = model(20);
        let run = |edit: fn(&mut EditPlan)| {
            let needs = Needs { cadence, ..Needs::default() };
            let mut backend = backend(subject, &model, needs.clone());
            step(&mut *backend, &view(0), 1, &needs, cadence);
            let mut plan = EditPlan::new(20, 20);
            edit(&mut plan);
            backend.apply(&plan.compile(), 5, 1).expect("a plan is applied");
            // No Gaussian is visible, so only accumulated gradients take effect.
            step(&mut *backend, &turned_away(&view(0)), 2, &needs, cadence);
            backend.download().expect("a model")
        };
        // The rows after row 4 move up.
        let (plain, edited) = (run(|_| {}), run(|plan| plan.prune(4).expect("an unedited row")));
        assert!(plain.means[19] != model.means[19] && plain.sh_of(19) != model.sh_of(19));
        assert_eq!((plain.means[19], plain.sh_of(19)), (edited.means[18], edited.sh_of(18)));
        assert_eq!(plain.means[..4], edited.means[..4]);
        assert_eq!(plain.means[5..], edited.means[4..]);
        // Clamping opacities discards their accumulated gradients along with their moments.
        let bounded = run(|plan| plan.clamp_opacity(0.999).expect("the bound is sound"));
        assert_eq!(bounded.opacity_logits, model.opacity_logits);
        assert_eq!(bounded.means, plain.means);
    });
}

#[test]
fn resetting_moments_restarts_bias_correction() {
    on_each(repeatable(), |subject| {
        let cadence = Cadence { all: 1, sh_rest: 2 };
        let needs = Needs { cadence, detailed_edits: true, ..Needs::default() };
        let mut backend = backend(subject, &model(20), needs.clone());
        for number in 1..=6 {
            step(&mut *backend, &view(number % 3), number, &needs, cadence);
        }
        let mut plan = EditPlan::new(20, 20).allowing(&needs);
        let opacity = OpacityRule::Same;
        let update = Update { opacity, keep_moments: false, ..Update::NONE };
        plan.update(11, update).expect("an unedited row");
        backend.apply(&plan.compile(), 5, 6).expect("a plan is applied");
        let before = backend.download().expect("a model");
        step(&mut *backend, &view(0), 7, &needs, cadence);
        step(&mut *backend, &view(1), 8, &needs, cadence);
        let after = backend.download().expect("a model");
        // Adam's first step has the length of the learning rate, and bands 1–3 of the row have stepped once.
        let moved = |row: usize| -> Vec<f32> {
            let pairs = after.sh_of(row).iter().zip(before.sh_of(row));
            pairs.skip(3).map(|(a, b)| (a - b).abs() / RATES.sh_rest).collect()
        };
        assert!(moved(11).iter().all(|rates| (rates - 1.0).abs() < 1e-2), "{:?}", moved(11));
        assert!(moved(12).iter().any(|rates| (rates - 1.0).abs() > 0.1), "{:?}", moved(12));
    });
}

#[test]
fn state_signals_match_the_model() {
    on_each(repeatable(), |subject| {
        let model = model(20);
        let wanted = [Signal::Opacity, Signal::ScaleMax, Signal::ScaleProduct];
        let needs = Needs { signals: SignalSet::from(wanted), ..Needs::default() };
        let mut backend = backend(subject, &model, needs.clone());
        let signals = backend.take_signals(needs.signals).expect("signals can be taken");
        let column = |signal| signals.get(signal).expect("a requested signal");
        for row in 0..20 {
            let scales = model.log_scales[row].map(|x| f64::from(x).exp());
            let largest = scales.into_iter().fold(0.0, f64::max);
            let expected = [
                1.0 / (1.0 + (-f64::from(model.opacity_logits[row])).exp()),
                largest,
                scales.into_iter().product(),
            ];
            for (signal, expected) in wanted.into_iter().zip(expected) {
                let found = f64::from(column(signal)[row]);
                assert!((found / expected - 1.0).abs() < 1e-5, "{signal:?}: {found} {expected}");
            }
        }
    });
}
