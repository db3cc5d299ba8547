//! Frozen rows: steps and plans never change a bit of their parameters, and they need no memory for training.

use densify::core::budget::RowBudget;
use densify::core::camera::Camera;
use densify::core::gaussians::{Gaussians, ModelArray};
use densify::render::{Backend, NonFinite, NumberKind, StepInput, Storage, Values};
use densify::selftest::{Setup, Subject, scenes};
use densify_policies::adc::split_by;
use densify_policies::plan::{Decay, EditPlan};
use densify_policies::policy::{Cadence, LossTerms, MaskTerm, Needs, NoiseTerm, Signal, SignalSet};

use crate::subject::{all, make_with, on_each, repeatable, saved, step_input, storages};

const ROWS: usize = 190;
/// Rows per task of the native backend, which allocates memory for whole tasks.
const TASK: usize = 128;
/// One task and, of the next, a block of 16 rows and part of another block.
const FROZEN: usize = TASK + 21;

fn view() -> Camera {
    scenes::camera(41, 33, 81)
}

/// Includes quaternions of any length, and sizes and opacities outside the range to which training steps clamp them.
fn model() -> Gaussians {
    let mut model = scenes::cloud(ROWS, 1, &view(), 82);
    for row in [3, 18] {
        model.log_scales[row] = [-15.0, 2.5, -14.0];
        model.opacity_logits[row] = 15.5;
    }
    model
}

fn setup(frozen: usize, storage: Storage, needs: Needs) -> Setup {
    let budget = RowBudget { total: 2 * ROWS, frozen };
    Setup { budget, storage, needs, ..Setup::default() }
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

/// Needs that allocate all optional memory per row.
fn all_needs() -> Needs {
    let mask = MaskTerm { start: 1.0, rate: 0.2, weight: 1.0, threshold: 0.72 };
    let signals = [Signal::VisibleCount, Signal::ScreenGradient, Signal::Age, Signal::Mask];
    Needs {
        signals: SignalSet::from(signals),
        loss_terms: LossTerms { opacity: 0.1, scale: 0.1 },
        noise: Some(NoiseTerm { strength: 50.0, sharpness: 1.0, opacity: 0.9 }),
        mask: Some(mask),
        cadence: Cadence { all: 2, sh_rest: 3 },
        ..Needs::default()
    }
}

#[test]
fn frozen_rows_never_change() {
    let everything = all_needs();
    on_each(all(), |subject| {
        let stored = match (subject, storages()) {
            (Subject::Native { .. }, all) => all.to_vec(),
            (Subject::Gpu(_), [plain, .., smallest]) => vec![plain, smallest],
        };
        for storage in stored {
            for needs in [&Needs::default(), &everything] {
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
                backend
                    .apply(&plan.compile().after_frozen(FROZEN), 5, 6)
                    .expect("a plan is applied");
                step(&mut *backend, 7, needs);
                let after = backend.download().expect("a model");
                assert_eq!(after.len(), ROWS - 2);
                let [was, is] = [&before, &after].map(|model| bits(model, 0..FROZEN));
                assert!(was == is, "{storage:?}");
                let [was, is] = [&before, &after].map(|model| bits(model, FROZEN..ROWS - 2));
                assert!(
                    was.iter().zip(&is).all(|(was, is)| was != is),
                    "{storage:?}: other rows did not change"
                );
            }
        }
    });
}

/// Other rows, their moments, ages and signals change as if no row were frozen. The moments, ages and signals of frozen
/// rows stay 0.
#[test]
fn other_rows_train_as_usual() {
    // Loss terms and masks are off: they are averaged over the rows that train, so freezing rows changes them.
    let needs = Needs { loss_terms: LossTerms::default(), noise: None, mask: None, ..all_needs() };
    // Some rows are invisible and do not decay.
    let mut model = model();
    let behind = (view().centre() - 2.0 * view().forward()).as_vec3().to_array();
    (0..ROWS).step_by(3).for_each(|row| model.means[row] = behind);
    on_each(repeatable(), |subject| {
        let [free, frozen] = [0, FROZEN].map(|frozen| {
            let setup = setup(frozen, Storage::default(), needs.clone());
            let mut backend = make_with(subject, &model, setup);
            for number in 1..=2 {
                step(&mut *backend, number, &needs);
            }
            let mut plan = EditPlan::new(ROWS - frozen, 2 * ROWS - frozen).allowing(&needs);
            plan.decay(Decay { opacity: 0.01, scale: 0.1, seen_only: true }).expect("sound");
            backend.apply(&plan.compile().after_frozen(frozen), 5, 2).expect("a plan is applied");
            let (model, state) = saved(&*backend);
            let signals = backend.take_signals(needs.signals).expect("signals");
            let column =
                |signal| signals.get(signal).expect("a requested signal")[FROZEN..].to_vec();
            let columns = [Signal::VisibleCount, Signal::ScreenGradient, Signal::Age].map(column);
            assert!(columns.iter().all(|column| column.iter().any(|value| *value > 0.0)));
            (bits(&model, FROZEN..ROWS), state, columns)
        });
        assert!(free.0 == frozen.0 && free.2 == frozen.2);
        assert_eq!(free.1.len(), frozen.1.len());
        for (free, frozen) in free.1.iter().zip(&frozen.1) {
            assert_eq!((&free.name, &free.shape), (&frozen.name, &frozen.shape));
            let [free_rows, frozen_rows] = [free, frozen].map(|tensor| by_rows(&tensor.values));
            // Arrays of missing SH bands are empty.
            if free.shape[0] == ROWS && !free_rows.is_empty() {
                assert!(free_rows[FROZEN..] == frozen_rows[FROZEN..], "{}", free.name);
                let is_zero = |row: &Vec<u32>| row.iter().all(|value| *value == 0);
                assert!(frozen_rows[..FROZEN].iter().all(is_zero), "{}", free.name);
            }
        }
    });
}

/// The bits of an array, row by row.
fn by_rows(values: &Values) -> Vec<Vec<u32>> {
    let all: Vec<u32> = match values {
        Values::F32(values) => values.iter().map(|value| value.to_bits()).collect(),
        Values::U16(values) => values.iter().map(|&value| value.into()).collect(),
        Values::U8(values) => values.iter().map(|&value| value.into()).collect(),
    };
    let width = (all.len() / ROWS).max(1);
    all.chunks(width).map(<[u32]>::to_vec).collect()
}

/// Freezing rows saves their training memory in the ledger.
#[test]
fn frozen_rows_have_no_memory_for_training() {
    let total = |subject: &Subject, frozen: usize| {
        make_with(subject, &model(), setup(frozen, Storage::default(), all_needs()))
            .ledger()
            .total()
    };
    // f32 numbers per row: two moments and a summed gradient for each of the 23 parameters of degree 1, two signal
    // sums, and a mask with two moments. The ages of a row and of its SH bands 1–3 are added below: two bytes each, or
    // one word for both on a GPU.
    let numbers = 3 * 23 + 2 + 3;
    let native = |frozen: usize| total(&Subject::NATIVE, frozen);
    assert_eq!(native(0) - native(TASK), (TASK * (4 * numbers + 2 * 2)) as u64);
    assert_eq!(native(TASK), native(FROZEN), "memory is saved for whole tasks only");
    on_each(all(), |subject| {
        let Subject::Gpu(_) = subject else { return };
        // In addition: one number of padding in each of the three arrays of moments and summed gradients, and the word of
        // ages.
        let bytes = 4 * (numbers + 3 + 1);
        // The sizes of buffers are rounded up to 16 bytes.
        let rounding = 16 * 16;
        let saved = total(subject, 0) - total(subject, FROZEN);
        assert!(
            saved.abs_diff((FROZEN * bytes) as u64) < rounding,
            "{saved} of {}",
            FROZEN * bytes
        );
    });
}

#[test]
fn non_finite_rows_are_found_among_frozen_and_other_rows() {
    on_each(repeatable(), |subject| {
        let setup = setup(FROZEN, Storage::default(), Needs::default());
        let mut broken = model();
        broken.opacity_logits[5] = f32::NAN;
        broken.means[FROZEN + 2][1] = f32::INFINITY;
        let mut backend = make_with(subject, &broken, setup);
        let names: Vec<String> = backend.state().into_iter().map(|array| array.name).collect();
        let first = names.iter().find(|name| name.contains("first")).expect("moments");
        let mut moments = backend.save(first).expect("moments");
        let width = moments.shape[1];
        let Values::F32(values) = &mut moments.values else {
            panic!("{first} is not an f32 array")
        };
        values[(FROZEN + 7) * width] = f32::NAN;
        backend.restore(moments).expect("they are taken back");
        let unsound = |row: usize, array, kind| NonFinite { row: row as u32, array, kind };
        assert_eq!(
            backend.audit().expect("an audit"),
            [
                unsound(5, ModelArray::OpacityLogits, NumberKind::Parameter),
                unsound(FROZEN + 2, ModelArray::Means, NumberKind::Parameter),
                unsound(FROZEN + 7, ModelArray::Means, NumberKind::Moment),
            ]
        );
    });
}
