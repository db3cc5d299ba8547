//! Optional signals and features need memory only if a policy declares them.

use std::iter;

use densify::render::Setup;
use densify::render::cpu::CpuBackend;
use densify::render::gpu::GpuDevice;
use densify_policies::policy::{
    AuxRequest, Cadence, ErrorScore, LossTerms, MaskTerm, Needs, NoiseTerm, Signal,
};

use crate::subject::devices;

#[test]
fn undeclared_features_need_no_memory() {
    let none = Needs::default;
    let mask = MaskTerm { start: 1.0, rate: 0.01, weight: 5e-4, threshold: 0.01 };
    let needs = |signals: &[Signal]| Needs { signals: signals.iter().copied().collect(), ..none() };
    let edges = ErrorScore { edge: 1.0, ..ErrorScore::default() };
    let declared = [
        Needs { mask: Some(mask), ..none() },
        Needs { cadence: Cadence { all: 2, sh_rest: 2 }, ..none() },
        Needs { aux: Some(AuxRequest { points: 3, ..AuxRequest::default() }), ..none() },
        needs(&[Signal::WeightMaxRoot]),
        needs(&[Signal::Support]),
        needs(&[Signal::DepthMin]),
        needs(&[Signal::DominantPixels]),
        needs(&[Signal::ErrorScore]),
    ];
    // Weighting by edges needs additional sums.
    let with_edges = Needs { error_score: edges, ..needs(&[Signal::ErrorScore]) };
    let promise = |device: Option<&GpuDevice>, needs: &Needs| {
        let needs = needs.clone();
        let setup = Setup { largest_image: (41, 33), needs, ..Setup::new(20) };
        let ledger = match device {
            Some(device) => device.memory_plan(1, &setup),
            None => CpuBackend::memory_plan(1, &setup, 2),
        };
        ledger.total()
    };
    let all = devices().iter().map(|device| ("GPU", Some(device)));
    for (name, device) in iter::once(("native", None)).chain(all) {
        let undeclared = promise(device, &none());
        for needs in &declared {
            assert!(promise(device, needs) > undeclared, "{name}: {needs:?}");
        }
        let error = promise(device, &needs(&[Signal::ErrorScore]));
        assert!(promise(device, &with_edges) > error, "{name}: edges");
        // Noise, loss terms and the weights of an error score that is not requested need no memory.
        let free = Needs {
            noise: Some(NoiseTerm { strength: 1.0, sharpness: 100.0, opacity: 0.005 }),
            loss_terms: LossTerms { opacity: 0.01, scale: 0.01 },
            error_score: edges,
            ..none()
        };
        assert_eq!(promise(device, &free), undeclared, "{name}: {free:?} needs memory");
    }
}
