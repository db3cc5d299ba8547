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
const LIST_ROWS: &str = shader!("shared/list_rows");
const LIST_SLOTS: &str = shader!("shared/list_slots");
const QUADS: &str = shader!("shared/quads");
const BATCH: &str = shader!("shared/batch");
const SLOTS: &str = shader!("shared/slots");
const SUBGROUPS: &str = shader!("shared/subgroups");
const ATOMICS: &str = shader!("shared/atomics");
const BACKWARD: &str = shader!("shared/backward");
const BLENDED: &str = shader!("shared/blended");
const RECORD: &str = shader!("shared/record");
const STEPS: &str = shader!("shared/steps");

/// The choices that the text of a module depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Formats {
    /// How gradients are accumulated.
    pub accumulation: Accumulation,
    /// True if the moments of the optimiser are stored in a byte each.
    pub moments_in_bytes: bool,
}

impl Formats {
    /// All combinations.
    pub fn all() -> impl Iterator<Item = Self> {
        let of_kind = |accumulation| {
            [false, true].map(|moments_in_bytes| Self { accumulation, moments_in_bytes })
        };
        Accumulation::ALL.into_iter().flat_map(of_kind)
    }
}

/// The devices that have a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum On {
    /// Devices that accumulate gradients in slots.
    Slots,
    /// Devices that accumulate gradients by atomics.
    Atomics,
    /// All devices; the invocations of a tile share splats through subgroups where these are available.
    Tiles,
    /// All devices; steps or clears moments.
    Moments,
    /// All devices; reads the tile lists.
    Lists,
    /// All devices; writes the tile lists.
    Emits,
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
    stage("tiles", On::Emits, &[VIEW, shader!("tiles")]),
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
    stage("adam", On::Moments, &[VIEW, RANDOM, STEPS, shader!("adam")]),
    stage("signals", On::All, &[VIEW, RECORD, shader!("signals")]),
    stage("apply", On::Moments, &[VIEW, RANDOM, STEPS, shader!("apply")]),
    stage("candidates", On::Lists, &[VIEW, RANDOM, shader!("candidates")]),
    stage("observe", On::Slots, &[VIEW, QUADS, BLENDED, shader!("observe")]),
    stage("observe_atomic", On::Atomics, &[VIEW, QUADS, BLENDED, shader!("observe_atomic")]),
    stage("audit", On::All, &[VIEW, shader!("audit")]),
];

impl Stage {
    /// The WGSL of the module; `None` if devices with this accumulation do not have the stage.
    pub fn text(&self, formats: Formats) -> Option<String> {
        let Formats { accumulation, moments_in_bytes } = formats;
        let more: &[&str] = match (self.on, accumulation) {
            (On::All, _) => &[],
            (On::Moments, _) if moments_in_bytes => {
                &[shader!("shared/rounding"), shader!("shared/moments_both8")]
            }
            (On::Moments, _) => &[shader!("shared/moments_f32")],
            (On::Lists, Accumulation::Slots) => &[LIST_SLOTS],
            (On::Lists, _) => &[LIST_ROWS],
            (On::Emits, Accumulation::Slots) => &[shader!("shared/emit_slots")],
            (On::Emits, _) => &[shader!("shared/emit_rows")],
            (On::Tiles, Accumulation::Slots) => &[LIST_SLOTS, BATCH],
            (On::Tiles, _) => &[LIST_ROWS, SUBGROUPS],
            (On::Slots, Accumulation::Slots) => &[LIST_SLOTS, BATCH, SLOTS],
            (On::Atomics, Accumulation::SubgroupCas) => {
                &[LIST_ROWS, SUBGROUPS, ATOMICS, shader!("shared/sums_cas")]
            }
            (On::Atomics, Accumulation::SubgroupAtomics) => {
                &[LIST_ROWS, SUBGROUPS, ATOMICS, shader!("shared/sums_f32")]
            }
            (On::Slots, _) | (On::Atomics, Accumulation::Slots) => return None,
        };
        Some([self.texts, more].concat().concat())
    }
}
