//! What a checkpoint holds of a backend is all that its future depends on.

use densify::backend::{Backend, StepInput, Storage, Tensor, Values};
use densify_policies::policy::{
    Cadence, CandidateRequest, DepthMode, ErrorMode, LossTerms, Needs, Signal, SignalSet,
};

use crate::subject::{make, make_with, repeatable, saved, step_input, storages};
use densify::camera::Camera;
use densify::gaussians::Gaussians;
use densify::verify::{Differentiable, Setup, Subject, scenes};

const CADENCE: Cadence = Cadence { all: 2, sh_rest: 3 };
/// Steps before the state is taken: no optimiser step is due, and all have sums that wait.
const BEFORE: u32 = 7;

fn needs() -> Needs {
    let signals = [Signal::VisibleCount, Signal::ScreenGradient, Signal::WeightMax, Signal::Age];
    Needs {
        signals: SignalSet::from(signals),
        cadence: CADENCE,
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

fn backend(
    subject: &Subject,
    (storage, frozen): (Storage, usize),
    model: &Gaussians,
) -> Box<dyn Differentiable> {
    make_with(subject, model, Setup { storage, frozen, needs: needs(), ..Setup::default() })
}

fn step(backend: &mut dyn Backend, camera: &Camera, number: u32) {
    let target = scenes::target(camera);
    let degree = (number / 2).min(3) as u8;
    let input = StepInput {
        cadence: CADENCE,
        loss_terms: LossTerms { opacity: 0.01, scale: 0.0 },
        ..step_input(number, camera, &target, degree)
    };
    backend.train_step(&input).expect("a small image is rendered");
}

/// Four more steps, with a new epoch among them, and everything that can be seen of the backend.
fn future(backend: &mut dyn Backend) -> impl PartialEq + std::fmt::Debug + use<> {
    let camera = scenes::camera(48, 40, 51);
    for i in BEFORE + 1..BEFORE + 5 {
        if i == BEFORE + 3 {
            backend.begin_epoch();
        }
        step(backend, &camera, i);
    }
    let signals = backend.take_signals(needs().signals).expect("signals");
    let candidates = backend.candidates().to_vec();
    let bits = |s: Signal| -> Vec<u32> {
        signals.get(s).expect("it was asked for").iter().map(|v| v.to_bits()).collect()
    };
    let columns: Vec<_> = needs().signals.iter().map(|s| (s, bits(s))).collect();
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
fn a_backend_that_took_back_its_state_has_the_same_future() {
    let camera = scenes::camera(48, 40, 51);
    let model = scenes::cloud(200, 3, &camera, 52);
    let stored = storages().map(|storage| (Subject::NATIVE, (storage, 0)));
    // With frozen rows too: a task of the native backend, and a part of another.
    let all = repeatable()
        .into_iter()
        .flat_map(|subject| [0, 141].map(|frozen| (subject.clone(), (Storage::default(), frozen))));
    for (subject, setup) in all.chain(stored) {
        let mut whole = backend(&subject, setup, &model);
        whole.begin_epoch();
        for i in 1..=BEFORE {
            step(&mut *whole, &camera, i);
        }
        let (model, state) = saved(&*whole);
        let ages = state.iter().find_map(Tensor::ages).expect("ages of the rows");
        let signals = whole.take_signals(SignalSet::from([Signal::Age])).expect("signals");
        let counted: Vec<f32> = ages.into_iter().map(|age| age as f32).collect();
        assert_eq!(signals.get(Signal::Age), Some(&*counted), "{}", subject.name());
        whole.give_back(signals);
        let expected = future(&mut *whole);

        let without = |left_out: &str| {
            let mut backend = backend(&subject, setup, &model);
            for tensor in state.iter().filter(|t| t.name != left_out) {
                backend.restore(tensor.clone()).expect("it is this backend's");
            }
            future(&mut *backend)
        };
        let name = format!("{}, {setup:?}", subject.name());
        assert!(without("") == expected, "{name}");
        // None of it is idle.
        let told: Vec<&Tensor> = state.iter().filter(|t| !is_zero(t)).collect();
        assert!(told.len() > 8, "{name}: only {} arrays say anything", told.len());
        for tensor in told {
            assert!(without(&tensor.name) != expected, "{name}: {}", tensor.name);
        }

        let mut other = make(&subject, &model);
        let waiting = state
            .iter()
            .find(|t| t.name.contains("waiting") || t.name.contains("summed"))
            .expect("sums that wait");
        assert!(other.restore(waiting.clone()).is_err(), "a run without sums took them");
    }
}
