//! The knobs. `densify trade` measures what they cost and gain; docs/tradeoffs.md has the figures.

use super::Class::{Bounded, Exact};
use super::{Domain, Knob, number};
use densify_render::BackendKind::Gpu;
use densify_render::{Accumulation, MomentStorage, ParameterStorage};

/// All knobs: the exact ones, then the bounded ones.
pub static KNOBS: &[Knob] = &[
    Knob {
        name: "pairs_per_row",
        default: "auto",
        domain: Domain::Choice(&["auto", "4", "2", "1"]),
        unit: "pairs",
        only_on: None,
        class: Exact,
        effect: "tile pairs per Gaussian (CPU: 2 in 5 with gradients); auto: 16, on a GPU 4 for large models, with --memory 4 to 16",
        levels: &["4", "2", "1"],
        set: |knobs, value| knobs.pairs_per_row = value.parse().ok(),
    },
    Knob {
        name: "alpha_min",
        default: "1/255",
        domain: Domain::Number { least: 1.0 / 1024.0, most: 1.0 / 32.0 },
        unit: "",
        only_on: None,
        class: Bounded,
        effect: "alpha below this is not blended; a larger value shrinks splats, which leaves fewer pairs",
        levels: &["1/1024", "1/128", "1/64", "1/32"],
        set: |knobs, value| knobs.shortcuts.alpha_min = real(value) as f32,
    },
    Knob {
        name: "transmittance_stop",
        default: "1e-4",
        domain: Domain::Number { least: 1e-5, most: 1e-2 },
        unit: "",
        only_on: None,
        class: Bounded,
        effect: "blending of a pixel stops before its transmittance falls below this; a larger value stops it sooner",
        levels: &["1e-5", "1e-3", "1e-2"],
        set: |knobs, value| knobs.shortcuts.transmittance_min = real(value) as f32,
    },
    Knob {
        name: "accumulation",
        default: "auto",
        domain: Domain::Choice(&["auto", "slots", "cas", "atomics"]),
        unit: "",
        only_on: Some(Gpu),
        class: Bounded,
        effect: "order of adding gradients; slots: fixed; cas, atomics: any, so that runs differ slightly",
        levels: &["slots", "cas", "atomics"],
        set: |knobs, value| knobs.accumulation = Accumulation::from_name(value),
    },
    Knob {
        name: "param_storage",
        default: "f32",
        domain: Domain::Choice(&["f32", "f16"]),
        unit: "",
        only_on: None,
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
        default: "auto",
        domain: Domain::Choice(&["auto", "f32", "both8"]),
        unit: "",
        only_on: None,
        class: Bounded,
        effect: "both8: each of the optimiser's two moments in one byte; auto: both8 on a GPU, else f32",
        levels: &["both8"],
        set: |knobs, value| {
            knobs.storage.moments = match value {
                "both8" => MomentStorage::Both8,
                _ => MomentStorage::F32,
            }
        },
    },
];

/// Parses a number in the table's spelling.
fn real(value: &str) -> f64 {
    number(value).unwrap_or_default()
}
