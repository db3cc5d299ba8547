//! The WGSL kernels of the GPU backend: one file per stage, with the same name as the native backend's, and
//! the table of the texts that make up each shader module.

mod accumulation;

pub use accumulation::Accumulation;

macro_rules! shader {
    ($name:literal) => {
        include_str!(concat!($name, ".wgsl"))
    };
}

const VIEW: &str = shader!("shared/view");
const GAUSSIAN: &str = shader!("shared/gaussian");
const RANDOM: &str = shader!("shared/random");
const QUADS: &str = shader!("shared/quads");
const BATCH: &str = shader!("shared/batch");
const SLOTS: &str = shader!("shared/slots");
const SUBGROUPS: &str = shader!("shared/subgroups");
const ATOMICS: &str = shader!("shared/atomics");
const BACKWARD: &str = shader!("shared/backward");
const BLENDED: &str = shader!("shared/blended");
const RECORD: &str = shader!("shared/record");
const STEPS: &str = shader!("shared/steps");

/// The devices that have a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum On {
    /// Devices that accumulate gradients in slots.
    Slots,
    /// Devices that accumulate gradients by atomics.
    Atomics,
    /// All devices; the invocations of a tile share splats through subgroups where these are available.
    Tiles,
    /// All devices.
    All,
}

/// A shader module.
#[derive(Debug)]
pub struct Stage {
    /// Name of the WGSL file, and of the native backend's file for the same stage.
    pub name: &'static str,
    on: On,
    texts: &'static [&'static str],
}

const fn stage(name: &'static str, on: On, texts: &'static [&'static str]) -> Stage {
    Stage { name, on, texts }
}

/// All stages. [`Stage::text`] adds the texts that depend on the device.
pub const STAGES: &[Stage] = &[
    stage("project", On::All, &[VIEW, GAUSSIAN, shader!("project")]),
    stage("tiles", On::All, &[VIEW, shader!("tiles")]),
    stage("rasterize", On::Tiles, &[VIEW, QUADS, shader!("rasterize")]),
    stage("exposure", On::All, &[VIEW, shader!("exposure")]),
    stage("loss", On::All, &[VIEW, shader!("loss")]),
    stage("rasterize_bwd", On::Slots, &[VIEW, RECORD, QUADS, BACKWARD, shader!("rasterize_bwd")]),
    stage(
        "rasterize_bwd_atomic",
        On::Atomics,
        &[VIEW, RECORD, QUADS, BACKWARD, shader!("rasterize_bwd_atomic")],
    ),
    stage("project_bwd", On::All, &[VIEW, RECORD, GAUSSIAN, shader!("project_bwd")]),
    stage("mask", On::All, &[VIEW, STEPS, shader!("mask")]),
    stage("adam", On::All, &[VIEW, RANDOM, STEPS, shader!("adam")]),
    stage("signals", On::All, &[VIEW, RECORD, shader!("signals")]),
    stage("apply", On::All, &[VIEW, RANDOM, shader!("apply")]),
    stage("candidates", On::All, &[VIEW, RANDOM, shader!("candidates")]),
    stage("observe", On::Slots, &[VIEW, QUADS, BLENDED, shader!("observe")]),
    stage("observe_atomic", On::Atomics, &[VIEW, QUADS, BLENDED, shader!("observe_atomic")]),
    stage("audit", On::All, &[VIEW, shader!("audit")]),
];

impl Stage {
    /// The WGSL of the module for a device with this accumulation; `None` if the device does not have the stage.
    pub fn text(&self, accumulation: Accumulation) -> Option<String> {
        let more: &[&str] = match (self.on, accumulation) {
            (On::All, _) => &[],
            (On::Tiles, Accumulation::Slots) => &[BATCH],
            (On::Tiles, _) => &[SUBGROUPS],
            (On::Slots, Accumulation::Slots) => &[BATCH, SLOTS],
            (On::Atomics, Accumulation::SubgroupCas) => {
                &[SUBGROUPS, ATOMICS, shader!("shared/sums_cas")]
            }
            (On::Atomics, Accumulation::SubgroupAtomics) => {
                &[SUBGROUPS, ATOMICS, shader!("shared/sums_f32")]
            }
            (On::Slots, _) | (On::Atomics, Accumulation::Slots) => return None,
        };
        Some([self.texts, more].concat().concat())
    }
}
