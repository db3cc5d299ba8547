//! Optimiser, signals and what policies add: step by step against the native backend, and twice on
//! the same device.

use densify::backend::cpu::{CpuBackend, CpuOptions};
use densify::backend::gpu::{GpuBackend, GpuOptions};
use densify::backend::{Backend, StepInput, StepOutput};
use densify::camera::Camera;
use densify::gaussians::Gaussians;
use densify_policies::policy::{Cadence, LossTerms, Needs, NoiseTerm, Signal, SignalSet};

use super::{backend_for, name, options, subjects, ways};
use crate::subject::RATES;
use densify::verify::compare::{Table, relative_error};
use densify::verify::scenes;

const GREY: [f32; 3] = [0.3, 0.4, 0.6];

pub(super) fn step(
    backend: &mut dyn Backend,
    camera: &Camera,
    step: u32,
    cadence: Cadence,
) -> StepOutput {
    let input = StepInput {
        step,
        view: 0,
        camera,
        target: &scenes::target(camera),
        background: GREY,
        sh_degree: (step / 2).min(3) as u8,
        rates: RATES,
        cadence,
        seed: 11,
        ssim_weight: 1.0,
    };
    backend.train_step(&input).expect("a small image is rendered")
}

fn columns(backend: &mut dyn Backend, needs: &Needs) -> Vec<(Signal, Vec<f32>)> {
    let signals = backend.take_signals(needs.signals).expect("signals");
    let of = |s: Signal| signals.get(s).expect("it was asked for").to_vec();
    needs.signals.iter().map(|s| (s, of(s))).collect()
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}

/// Largest change of any parameter of a class per step, so that differences can be held to it.
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

#[test]
fn steps_are_those_of_the_native_backend() {
    let camera = scenes::camera(48, 40, 51);
    let model = scenes::cloud(200, 3, &camera, 52);
    let all = SignalSet::from(Signal::ALL);
    // Half of the rows are nearer.
    let full_depth = 3.5;
    let some = SignalSet::from([Signal::ScreenGradient, Signal::WeightMax, Signal::Age]);
    let absolute = SignalSet::from([Signal::ScreenGradientAbs]);
    let pixels = SignalSet::from([Signal::PixelCount, Signal::WeightMax, Signal::ScreenGradient]);
    let noise = NoiseTerm { strength: 5e3, sharpness: 100.0, opacity: 0.3 };
    let runs = [
        ("plain", Needs::default(), Cadence::default()),
        ("all signals", Needs { signals: all, ..Needs::default() }, Cadence::default()),
        ("absolute gradients", Needs { signals: absolute, ..Needs::default() }, Cadence::default()),
        ("pixels and weights", Needs { signals: pixels, ..Needs::default() }, Cadence::default()),
        (
            "near views weigh less",
            Needs { signals: all, full_depth, ..Needs::default() },
            Cadence::default(),
        ),
        (
            "terms and noise",
            Needs {
                signals: some,
                loss_terms: LossTerms { opacity: 0.01, scale: 0.02 },
                noise: Some(noise),
                ..Needs::default()
            },
            Cadence::default(),
        ),
        (
            "bands 1-3 every third step",
            Needs { cadence: Cadence { all: 1, sh_rest: 3 }, ..Needs::default() },
            Cadence { all: 1, sh_rest: 3 },
        ),
        (
            "every other step",
            Needs { cadence: Cadence { all: 2, sh_rest: 4 }, ..Needs::default() },
            Cadence { all: 2, sh_rest: 4 },
        ),
    ];
    for device in ways() {
        let mut table = Table::new(&format!("training, {} against CPU", name(device)));
        for (what, needs, cadence) in &runs {
            let cpu_options = CpuOptions { needs: needs.clone(), ..CpuOptions::new(model.len()) };
            let mut cpu = CpuBackend::new(&model, &cpu_options).expect("a small model fits");
            let mut gpu = backend_for(&model, device, needs);
            for n in 1..=6 {
                if n == 4 {
                    cpu.begin_epoch();
                    gpu.begin_epoch();
                }
                let expected = step(&mut cpu, &camera, n, *cadence);
                let found = step(&mut gpu, &camera, n, *cadence);
                let off = f64::from((found.loss - expected.loss).abs());
                table.check(what, "loss", off, 1e-4);
                assert_eq!(found.visible, expected.visible, "{what}, step {n}");
                let entries = (found.entries as f64 / expected.entries as f64 - 1.0).abs();
                table.check(what, "entries", entries, 0.02);
            }
            cpu.measure_weights(&camera, 3).expect("weights");
            gpu.measure_weights(&camera, 3).expect("weights");
            let (found, expected) = (gpu.download(), cpu.download());
            compare_models(&mut table, what, &found.expect("a model"), &expected.expect("a model"));
            for ((signal, found), (_, expected)) in
                columns(&mut gpu, needs).into_iter().zip(columns(&mut cpu, needs))
            {
                let error = relative_error(&found, &wide(&expected));
                table.check(what, &format!("{signal:?}"), error, 0.02);
            }
        }
        table.finish();
    }
}

#[test]
fn in_slots_a_device_gives_the_same_bytes_with_any_cap() {
    let camera = scenes::camera(60, 50, 61);
    let model = scenes::cloud(150, 2, &camera, 62);
    for device in subjects() {
        let run = |cap: Option<usize>| {
            let options = GpuOptions { tile_cap: cap, ..options(&model) };
            let mut gpu = GpuBackend::new(&model, &options, device).expect("a small model fits");
            let outputs: Vec<StepOutput> = (1..=4)
                .map(|n| StepOutput { bands: 0, ..step(&mut gpu, &camera, n, Cadence::default()) })
                .collect();
            (gpu.download().expect("a model"), outputs)
        };
        let first = run(None);
        assert!(run(None) == first, "running twice");
        assert!(run(Some(1)) == first, "bands");
    }
}
