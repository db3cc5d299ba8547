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
const DIRECTION: &str = shader!("shared/direction");
const SPLAT: &str = shader!("shared/splat");
const FOOTPRINT: &str = shader!("shared/footprint");
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
const ROW: &str = shader!("shared/row");
const NARROW: &str = shader!("shared/narrow");
const DRAWS: &str = shader!("shared/draws");
const EXPOSED: &str = shader!("shared/exposed");
const REDUCE: &str = shader!("shared/reduce");

/// The choices that the text of a module depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Formats {
    /// How gradients are accumulated.
    pub accumulation: Accumulation,
    /// True if the moments of the optimiser are stored in a byte each.
    pub moments_in_bytes: bool,
    /// True if parameters but means are stored in 16 bits.
    pub parameters_in_16_bits: bool,
}

impl Formats {
    /// All combinations.
    pub fn all() -> impl Iterator<Item = Self> {
        let of_kind = |accumulation| {
            [(false, false), (true, false), (false, true), (true, true)].map(
                |(moments_in_bytes, parameters_in_16_bits)| Self {
                    accumulation,
                    moments_in_bytes,
                    parameters_in_16_bits,
                },
            )
        };
        Accumulation::ALL.into_iter().flat_map(of_kind)
    }
}

/// The numbers that a module accesses, whose format is chosen for a run.
#[derive(Debug, Clone, Copy)]
enum Numbers {
    /// Reads rows.
    Rows,
    /// Writes rows.
    StoreRows,
    /// Steps rows and coefficients of colour.
    Steps,
    /// Reads coefficients of colour.
    Colours,
    /// Writes band 0 of colour.
    Band0,
    /// Steps or clears moments.
    Moments,
}

impl Numbers {
    /// The texts for these formats.
    fn texts(self, formats: Formats) -> &'static [&'static str] {
        let is_narrow = match self {
            Self::Moments => formats.moments_in_bytes,
            _ => formats.parameters_in_16_bits,
        };
        match (self, is_narrow) {
            (Self::Rows, false) => &[ROW, shader!("shared/rows_f32")],
            (Self::Rows, true) => &[ROW, NARROW, shader!("shared/rows_f16")],
            (Self::StoreRows, false) => &[shader!("shared/store_f32")],
            (Self::StoreRows, true) => &[shader!("shared/store_f16")],
            (Self::Steps, false) => &[shader!("shared/step_f32")],
            (Self::Steps, true) => &[DRAWS, shader!("shared/step_f16")],
            (Self::Colours, false) => &[shader!("shared/colours_f32")],
            (Self::Colours, true) => &[NARROW, shader!("shared/colours_f16")],
            (Self::Band0, false) => &[shader!("shared/band0_f32")],
            (Self::Band0, true) => &[NARROW, shader!("shared/band0_f16")],
            (Self::Moments, false) => &[shader!("shared/moments_f32")],
            (Self::Moments, true) => &[NARROW, DRAWS, shader!("shared/moments_both8")],
        }
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
    numbers: &'static [Numbers],
}

impl Stage {
    const fn with(self, numbers: &'static [Numbers]) -> Self {
        Self { numbers, ..self }
    }
}

const fn stage(name: &'static str, on: On, texts: &'static [&'static str]) -> Stage {
    Stage { name, on, texts, numbers: &[] }
}

/// All stages. [`Stage::text`] adds the texts that depend on the device.
pub const STAGES: &[Stage] = &[
    stage("project", On::All, &[VIEW, GAUSSIAN, DIRECTION, SPLAT, FOOTPRINT, shader!("project")])
        .with(&[Numbers::Rows, Numbers::Colours]),
    stage("tiles", On::Emits, &[VIEW, SPLAT, FOOTPRINT, shader!("tiles")]),
    stage("rasterize", On::Tiles, &[VIEW, SPLAT, QUADS, shader!("rasterize")]),
    stage("exposure", On::All, &[VIEW, REDUCE, EXPOSED, shader!("exposure")]),
    stage("vignette", On::All, &[VIEW, REDUCE, EXPOSED, shader!("vignette")]),
    stage("loss", On::All, &[VIEW, REDUCE, shader!("loss")]),
    stage("depth_gradient", On::All, &[VIEW, REDUCE, shader!("depth_gradient")]),
    stage(
        "rasterize_bwd",
        On::Slots,
        &[VIEW, RECORD, SPLAT, QUADS, BACKWARD, shader!("rasterize_bwd")],
    ),
    stage(
        "rasterize_bwd_atomic",
        On::Atomics,
        &[VIEW, RECORD, SPLAT, QUADS, BACKWARD, shader!("rasterize_bwd_atomic")],
    ),
    stage(
        "project_bwd",
        On::All,
        &[VIEW, RECORD, SPLAT, GAUSSIAN, DIRECTION, REDUCE, shader!("project_bwd")],
    )
    .with(&[Numbers::Rows, Numbers::Colours]),
    stage("mask", On::All, &[VIEW, RECORD, SPLAT, STEPS, shader!("mask")])
        .with(&[Numbers::Rows, Numbers::StoreRows]),
    stage("adam", On::All, &[VIEW, RANDOM, RECORD, SPLAT, DIRECTION, STEPS, shader!("adam")])
        .with(&[Numbers::Rows, Numbers::StoreRows, Numbers::Steps, Numbers::Moments]),
    stage("signals", On::All, &[VIEW, RECORD, SPLAT, shader!("signals")]).with(&[Numbers::Rows]),
    stage("apply", On::All, &[VIEW, RANDOM, STEPS, shader!("apply")]).with(&[
        Numbers::Rows,
        Numbers::StoreRows,
        Numbers::Band0,
        Numbers::Moments,
    ]),
    stage("candidates", On::Lists, &[VIEW, RANDOM, SPLAT, shader!("candidates")])
        .with(&[Numbers::Rows]),
    stage("observe", On::Slots, &[VIEW, SPLAT, QUADS, BLENDED, shader!("observe")]),
    stage("observe_atomic", On::Atomics, &[VIEW, SPLAT, QUADS, BLENDED, shader!("observe_atomic")]),
    stage("audit", On::All, &[VIEW, shader!("audit")]),
];

impl Stage {
    /// The WGSL of the module; `None` if devices with this accumulation do not have the stage.
    pub fn text(&self, formats: Formats) -> Option<String> {
        let accumulation = formats.accumulation;
        let more: &[&str] = match (self.on, accumulation) {
            (On::All, _) => &[],
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
        let mut all = [self.texts, more].concat();
        for text in self.numbers.iter().flat_map(|numbers| numbers.texts(formats)) {
            // Several accesses may need the same file.
            if !all.contains(text) {
                all.push(text);
            }
        }
        Some(all.concat())
    }
}
