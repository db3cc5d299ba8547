//! Frozen rows: whatever a step or a plan does to the others, these keep their bits.

use densify::backend::{Backend, StepInput, Storage};
use densify::camera::Camera;
use densify::gaussians::Gaussians;
use densify::verify::{Setup, Subject, scenes};
use densify_policies::adc::split_by;
use densify_policies::plan::{Decay, EditPlan};
use densify_policies::policy::{Cadence, LossTerms, MaskTerm, Needs, NoiseTerm};

use crate::subject::{all, make_with, on_each, repeatable, saved, step_input, storages};

const ROWS: usize = 59;
/// A block of the native backend, and a part of another.
const FROZEN: usize = 21;

fn view() -> Camera {
    scenes::camera(41, 33, 81)
}

/// Quaternions have any length, and some sizes and opacities are beyond what a step confines them to.
fn model() -> Gaussians {
    let mut model = scenes::cloud(ROWS, 1, &view(), 82);
    for row in [3, 18] {
        model.log_scales[row] = [-15.0, 2.5, -14.0];
        model.opacity_logits[row] = 15.5;
    }
    model
}

fn setup(frozen: usize, storage: Storage, needs: Needs) -> Setup {
    Setup { budget: 2 * ROWS, frozen, storage, needs, ..Setup::default() }
}

fn step(backend: &mut dyn Backend, number: u32, needs: &Needs) {
    let target = scenes::target(&view());
    let camera = view();
    let input = StepInput {
        loss_terms: needs.loss_terms,
        noise: needs.noise,
        cadence: needs.cadence,
        ..step_input(number, &camera, &target, 1)
    };
    backend.train_step(&input).expect("a small image is rendered");
}

/// The bits of every parameter, row by row.
fn bits(model: &Gaussians, rows: std::ops::Range<usize>) -> Vec<Vec<u32>> {
    let row = |row: usize| {
        let values = model.means[row].iter().chain(&model.log_scales[row]);
        let values = values.chain(&model.quats[row]).chain([&model.opacity_logits[row]]);
        values.chain(model.sh_of(row)).map(|value| value.to_bits()).collect()
    };
    rows.map(row).collect()
}

#[test]
fn nothing_changes_them() {
    let mask = MaskTerm { start: 1.0, rate: 0.2, weight: 1.0, threshold: 0.72 };
    let all_of_it = Needs {
        loss_terms: LossTerms { opacity: 0.1, scale: 0.1 },
        noise: Some(NoiseTerm { strength: 50.0, sharpness: 1.0, opacity: 0.9 }),
        mask: Some(mask),
        cadence: Cadence { all: 2, sh_rest: 3 },
        ..Needs::default()
    };
    on_each(all(), |subject| {
        let storages = storages();
        let storages = match subject {
            Subject::Native { .. } => &storages[..],
            Subject::Gpu(_) => &storages[..1],
        };
        for &storage in storages {
            for needs in [&Needs::default(), &all_of_it] {
                let setup = setup(FROZEN, storage, needs.clone());
                let mut backend = make_with(subject, &model(), setup);
                let before = backend.download().expect("a model");
                for number in 1..=6 {
                    step(&mut *backend, number, needs);
                }
                let rows = backend.rows() - FROZEN;
                let mut plan = EditPlan::new(rows, 2 * ROWS - FROZEN);
                plan.prune_all([0, 2, 3]);
                plan.grow(1, split_by(1.6)).expect("there is room");
                plan.decay(Decay { opacity: 0.01, scale: 0.1, seen_only: false }).expect("sound");
                plan.clamp_opacity(0.02).expect("a sound bound");
                backend.apply(&plan.compile().behind(FROZEN), 5, 6).expect("a plan is applied");
                step(&mut *backend, 7, needs);
                let after = backend.download().expect("a model");
                assert_eq!(after.len(), ROWS - 2);
                let [was, is] = [&before, &after].map(|model| bits(model, 0..FROZEN));
                assert!(was == is, "{storage:?}");
                let [was, is] = [&before, &after].map(|model| bits(model, FROZEN..ROWS - 2));
                assert!(was.iter().zip(&is).all(|(was, is)| was != is), "{storage:?}: they rest");
            }
        }
    });
}

/// Rows step as they do where none is frozen, as long as all are where they would be.
#[test]
fn the_others_step_as_ever() {
    on_each(repeatable(), |subject| {
        let [free, frozen] = [0, FROZEN].map(|frozen| {
            let setup = setup(frozen, Storage::default(), Needs::default());
            let mut backend = make_with(subject, &model(), setup);
            step(&mut *backend, 1, &Needs::default());
            let (model, _) = saved(&*backend);
            bits(&model, FROZEN..ROWS)
        });
        assert!(free == frozen);
    });
}
