//! Edits: the same plan on both backends, with every kind of operation in it.

use densify::backend::Backend;
use densify::backend::cpu::{CpuBackend, CpuOptions};
use densify::backend::gpu::{GpuBackend, GpuOptions};
use densify::gaussians::Gaussians;
use densify_policies::plan::{
    EditPlan, Offspring, OpacityRule, ParentFate, Placement, Reset, RowOps, ScaleRule, Seed, Update,
};
use densify_policies::policy::{Cadence, Needs, Signal, SignalSet};

use super::subjects;
use super::training::step;
use densify::verify::compare::{Table, relative_error};
use densify::verify::scenes;

const ROWS: usize = 90;
const BUDGET: usize = 140;

fn plan() -> RowOps {
    let mut plan = EditPlan::new(ROWS, BUDGET);
    for row in (0..ROWS as u32).step_by(4) {
        plan.prune(row).expect("a live row");
    }
    let placements = [
        Placement::Offset([0.1, -0.2, 0.05]),
        Placement::Sampled,
        Placement::LongAxis { sigmas: 0.7 },
    ];
    let opacities = [
        OpacityRule::Same,
        OpacityRule::Set(0.3),
        OpacityRule::Scaled(0.6),
        OpacityRule::Conserved,
    ];
    for (i, row) in (1..ROWS as u32).step_by(4).enumerate() {
        let offspring = Offspring {
            children: 1 + (i % 3) as u32,
            parent: if i % 2 == 0 { ParentFate::BecomesChild } else { ParentFate::Stays },
            placement: placements[i % 3],
            scale: if i % 5 == 0 {
                ScaleRule::LongAxis { long: 0.5, other: 0.9 }
            } else {
                ScaleRule::Uniform(1.0 / 1.6)
            },
            opacity: opacities[i % 4],
        };
        // A refusal is a value; both backends see what was accepted.
        let _ = plan.grow(row, offspring);
    }
    for (i, row) in (2..ROWS as u32).step_by(8).enumerate() {
        let opacity = opacities[i % 3];
        let update = Update { opacity, scale: ScaleRule::Uniform(0.9), keep_moments: i % 2 == 0 };
        plan.update(row, update).expect("a live row");
    }
    for i in 0..5 {
        let seed = Seed {
            position: [0.1 * i as f32, 0.2, 2.0],
            colour: [0.2, 0.4, 0.9],
            scale: 0.05,
            opacity: 0.2,
        };
        let _ = plan.append(seed);
    }
    plan.clamp_opacity(0.8).expect("a bound in range");
    plan.reset(Reset::Signals);
    plan.compile()
}

fn flat(model: &Gaussians) -> [(&'static str, Vec<f32>); 5] {
    [
        ("means", model.means.as_flattened().to_vec()),
        ("log_scales", model.log_scales.as_flattened().to_vec()),
        ("quats", model.quats.as_flattened().to_vec()),
        ("opacity", model.opacity_logits.clone()),
        ("sh", model.sh.clone()),
    ]
}

#[test]
fn an_edit_does_what_it_does_natively() {
    let camera = scenes::camera(40, 40, 71);
    let model = scenes::cloud(ROWS, 1, &camera, 72);
    let signals =
        SignalSet::from([Signal::VisibleCount, Signal::WeightMax, Signal::Age, Signal::PixelCount]);
    let needs = Needs { signals, cadence: Cadence { all: 1, sh_rest: 3 }, ..Needs::default() };
    for device in subjects() {
        let mut table = Table::new("edits, GPU against CPU");
        let cpu = CpuOptions { needs: needs.clone(), ..CpuOptions::new(BUDGET) };
        let gpu = GpuOptions { needs: needs.clone(), ..GpuOptions::new(BUDGET) };
        let mut cpu = CpuBackend::new(&model, &cpu).expect("a small model fits");
        let mut gpu = GpuBackend::new(&model, &gpu, device).expect("a small model fits");
        let both: [&mut dyn Backend; 2] = [&mut cpu, &mut gpu];
        let [expected, found] = both.map(|backend| {
            for n in 1..=2 {
                step(backend, &camera, n, needs.cadence);
            }
            let ops = plan();
            backend.apply(&ops, 5, 2).expect("a plan is applied");
            assert_eq!(backend.rows(), ops.rows_after);
            let edited = backend.download().expect("a model");
            let signals = backend.take_signals(needs.signals).expect("signals");
            // Moments and ages show in the next steps.
            for n in 3..=4 {
                step(backend, &camera, n, needs.cadence);
            }
            (edited, signals, backend.download().expect("a model"))
        });
        for ((what, a), (_, b)) in flat(&found.0).iter().zip(flat(&expected.0)) {
            let wide: Vec<f64> = b.iter().copied().map(f64::from).collect();
            // The two steps before differ by rounding, Adam's by up to its step.
            table.check("edited", what, relative_error(a, &wide), 2e-3);
        }
        for ((what, a), (_, b)) in flat(&found.2).iter().zip(flat(&expected.2)) {
            let wide: Vec<f64> = b.iter().copied().map(f64::from).collect();
            table.check("and trained on", what, relative_error(a, &wide), 4e-3);
        }
        for signal in needs.signals.iter() {
            let of = |s: &densify_policies::policy::Signals| s.get(signal).expect("there").to_vec();
            let wide: Vec<f64> = of(&expected.1).into_iter().map(f64::from).collect();
            let error = relative_error(&of(&found.1), &wide);
            table.check("signals", &format!("{signal:?}"), error, 1e-3);
        }
        table.finish();
    }
}
