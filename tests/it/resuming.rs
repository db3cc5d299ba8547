//! A checkpoint contains all backend state that future steps depend on.

use densify::render::{Backend, StepInput, Storage, Tensor, Values};
use densify_policies::policy::{
    Cadence, CandidateRequest, DepthMode, ErrorMode, ErrorScore, LossTerms, MaskTerm, Needs,
    Signal, SignalSet,
};

use crate::subject::{devices, make, make_with, repeatable, saved, step_input, storages};
use densify::core::budget::RowBudget;
use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::selftest::{Differentiable, Setup, Subject, scenes};

/// Steps before saving. With accumulation, no update is due at this step, so all classes have pending gradients.
const BEFORE: u32 = 7;

/// All signals except `Mask`, and gradients that are summed over several steps.
fn with_accumulation() -> Needs {
    let signals = Signal::ALL.into_iter().filter(|signal| *signal != Signal::Mask).collect();
    Needs {
        signals,
        cadence: Cadence { all: 2, sh_rest: 3 },
        candidates: Some(CandidateRequest {
            from: 0,
            until: 100,
            rows_per_candidate: 20,
            capacity: 100,
            error: ErrorMode::L1Dssim,
            depth: DepthMode::MaxWeight,
            spaced: true,
            min_alpha: 0.1,
        }),
        ..Needs::default()
    }
}

/// All signals and masks, which cannot be combined with accumulation.
fn with_masks() -> Needs {
    Needs {
        signals: Signal::ALL.into(),
        error_score: ErrorScore { edge: 1.0, footprint: 0.5, ..ErrorScore::default() },
        mask: Some(MaskTerm { start: 1.0, rate: 0.01, weight: 5e-4, threshold: 0.01 }),
        ..Needs::default()
    }
}

fn backend(
    subject: &Subject,
    (storage, frozen, needs): (Storage, usize, fn() -> Needs),
    model: &Gaussians,
) -> Box<dyn Differentiable> {
    let budget = RowBudget { total: model.len(), frozen };
    make_with(subject, model, Setup { storage, budget, needs: needs(), ..Setup::default() })
}

fn step(backend: &mut dyn Backend, needs: &Needs, camera: &Camera, number: u32) {
    let target = scenes::target(camera);
    let degree = (number / 2).min(3) as u8;
    let input = StepInput {
        cadence: needs.cadence,
        loss_terms: LossTerms { opacity: 0.01, scale: 0.0 },
        ..step_input(number, camera, &target, degree)
    };
    backend.train_step(&input).expect("a small image is rendered");
}

/// Takes four more steps, including a new epoch, and returns the observable state of the backend.
fn future(backend: &mut dyn Backend, needs: &Needs) -> impl PartialEq + std::fmt::Debug + use<> {
    let camera = scenes::camera(48, 40, 51);
    for i in BEFORE + 1..BEFORE + 5 {
        if i == BEFORE + 3 {
            backend.begin_epoch();
        }
        step(backend, needs, &camera, i);
    }
    let signals = backend.take_signals(needs.signals).expect("signals");
    let candidates = backend.candidates().to_vec();
    let bits = |s: Signal| -> Vec<u32> {
        signals.get(s).expect("a requested signal").iter().map(|v| v.to_bits()).collect()
    };
    let columns: Vec<_> = needs.signals.iter().map(|s| (s, bits(s))).collect();
    (backend.download().expect("the model"), columns, candidates)
}

fn is_zero(tensor: &Tensor) -> bool {
    match &tensor.values {
        Values::F32(values) => values.iter().all(|v| v.to_bits() == 0),
        Values::U16(values) => values.iter().all(|&v| v == 0),
        Values::U8(values) => values.iter().all(|&v| v == 0),
    }
}

#[test]
fn a_restored_backend_continues_identically() {
    let camera = scenes::camera(48, 40, 51);
    let model = scenes::cloud(200, 3, &camera, 52);
    let with_accumulation: fn() -> Needs = with_accumulation;
    let stored = storages().map(|storage| (Subject::NATIVE, (storage, 0, with_accumulation)));
    // 141 frozen rows are one task of the native backend and part of another.
    let all = repeatable().into_iter().flat_map(|subject| {
        let setups = [(0, with_accumulation), (141, with_masks)];
        setups.map(|(frozen, needs)| (subject.clone(), (Storage::default(), frozen, needs)))
    });
    let on_devices = devices().iter().cloned().map(Subject::Gpu);
    let [.., smallest] = storages();
    let stored_on_devices = on_devices.map(|subject| (subject, (smallest, 0, with_accumulation)));
    for (subject, setup) in all.chain(stored).chain(stored_on_devices) {
        let needs = setup.2();
        let mut whole = backend(&subject, setup, &model);
        whole.begin_epoch();
        for i in 1..=BEFORE {
            step(&mut *whole, &needs, &camera, i);
        }
        let (model, state) = saved(&*whole);
        let ages = state.iter().find_map(Tensor::ages).expect("ages of the rows");
        let signals = whole.take_signals(SignalSet::from([Signal::Age])).expect("signals");
        let counted: Vec<f32> = ages.into_iter().map(|age| age as f32).collect();
        assert_eq!(signals.get(Signal::Age), Some(&*counted), "{}", subject.name());
        whole.give_back(signals);
        let expected = future(&mut *whole, &needs);

        let without = |left_out: &str| {
            let mut backend = backend(&subject, setup, &model);
            for tensor in state.iter().filter(|t| t.name != left_out) {
                backend.restore(tensor.clone()).expect("an array of this backend");
            }
            future(&mut *backend, &needs)
        };
        let masks = if needs.mask.is_some() { ", with masks" } else { "" };
        let name = format!("{}, {:?}, {} frozen{masks}", subject.name(), setup.0, setup.1);
        assert!(without("") == expected, "{name}");
        // Leaving out any non-zero array must make a difference.
        let nonzero: Vec<&Tensor> = state.iter().filter(|t| !is_zero(t)).collect();
        assert!(nonzero.len() > 8, "{name}: only {} non-zero arrays", nonzero.len());
        for tensor in nonzero {
            assert!(without(&tensor.name) != expected, "{name}: {}", tensor.name);
        }

        let mut other = make(&subject, &model);
        let is_of_needs = |name: &str| match needs.mask {
            Some(_) => name.contains("mask"),
            None => name.contains("waiting") || name.contains("summed"),
        };
        let special =
            state.iter().find(|t| is_of_needs(&t.name)).expect("an array that the needs add");
        assert!(
            other.restore(special.clone()).is_err(),
            "{name}: a backend without these needs accepted it"
        );
    }
}
