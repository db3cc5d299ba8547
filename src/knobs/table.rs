//! The knobs. `densify trade` measures what they cost and gain; docs/tradeoffs.md has the figures.

use super::Class::{Bounded, Exact, Heuristic};
use super::{Domain, Knob, number};
use crate::backend::Accumulation;
use crate::backend::{MomentStorage, ParameterStorage};

/// All knobs: exact ones, then bounded ones, then heuristic ones.
pub static KNOBS: &[Knob] = &[
    Knob {
        name: "pairs_per_row",
        default: "auto",
        domain: Domain::Choice(&["auto", "4", "2", "1"]),
        unit: "pairs",
        class: Exact,
        effect: "tile_cap per Gaussian, with gradients for 2 in 5; auto: 16, or 4 to 16 with --memory, and for all",
        levels: &["4", "2", "1"],
        set: |knobs, value| knobs.pairs_per_row = value.parse().ok(),
    },
    Knob {
        name: "alpha_min",
        default: "1/255",
        domain: Domain::Number { least: 1.0 / 1024.0, most: 1.0 / 32.0 },
        unit: "",
        class: Bounded,
        effect: "alpha below this is not blended; a larger one shrinks splats, so that fewer pairs are left",
        levels: &["1/1024", "1/128", "1/64", "1/32"],
        set: |knobs, value| knobs.shortcuts.alpha_min = real(value) as f32,
    },
    Knob {
        name: "transmittance_stop",
        default: "1e-4",
        domain: Domain::Number { least: 1e-5, most: 1e-2 },
        unit: "",
        class: Bounded,
        effect: "a pixel stops before its transmittance falls below this; a larger one stops sooner",
        levels: &["1e-5", "1e-3", "1e-2"],
        set: |knobs, value| knobs.shortcuts.transmittance_min = real(value) as f32,
    },
    Knob {
        name: "accumulation",
        default: "auto",
        domain: Domain::Choice(&["auto", "slots", "cas", "atomics"]),
        unit: "",
        class: Bounded,
        effect: "how gradients are added up: slots in one order; cas and atomics in any, so that runs differ slightly",
        levels: &["slots", "cas", "atomics"],
        set: |knobs, value| knobs.accumulation = Accumulation::of_name(value),
    },
    Knob {
        name: "ssim_every",
        default: "1",
        domain: Domain::Choice(&["1", "2", "5", "10"]),
        unit: "iterations",
        class: Heuristic,
        effect: "SSIM in every so many-th step with as many times its weight, L1 in all; saves most of the loss",
        levels: &["2", "5", "10"],
        set: |knobs, value| knobs.savings.ssim_every = value.parse().unwrap_or(1),
    },
    Knob {
        name: "coarse_until",
        default: "0",
        domain: Domain::Number { least: 0.0, most: 0.9 },
        unit: "of the run",
        class: Heuristic,
        effect: "share of the run, from its start, that is trained on images of half the size",
        levels: &["0.2", "0.4", "0.6"],
        set: |knobs, value| knobs.savings.coarse_until = real(value),
    },
    Knob {
        name: "budget_share",
        default: "1",
        domain: Domain::Number { least: 0.05, most: 1.0 },
        unit: "of the budget",
        class: Heuristic,
        effect: "Gaussians may grow up to this share of the budget; the rest is neither touched nor computed",
        levels: &["0.25", "0.5", "0.75"],
        set: |knobs, value| knobs.savings.budget_share = real(value),
    },
    Knob {
        name: "param_storage",
        default: "f32",
        domain: Domain::Choice(&["f32", "f16"]),
        unit: "",
        class: Bounded,
        effect: "f16: parameters other than means in 2 bytes, rounded at random; 112 bytes less per Gaussian of degree 3",
        levels: &["f16"],
        set: |knobs, value| {
            knobs.storage.parameters = match value {
                "f16" => ParameterStorage::F16,
                _ => ParameterStorage::F32,
            }
        },
    },
    Knob {
        name: "moment_storage",
        default: "f32",
        domain: Domain::Choice(&["f32", "both8"]),
        unit: "",
        class: Bounded,
        effect: "both8: both moments of the optimiser in a byte each",
        levels: &["both8"],
        set: |knobs, value| {
            knobs.storage.moments = match value {
                "both8" => MomentStorage::Both8,
                _ => MomentStorage::F32,
            }
        },
    },
];

/// The number that a value in the table's spelling is.
fn real(value: &str) -> f64 {
    number(value).unwrap_or_default()
}
