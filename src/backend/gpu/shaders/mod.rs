//! The stages' shaders: which texts make up each module, and the kernels and bindings that naga reads
//! from them.
//!
//! A stage is registered in [`STAGES`]. A binding stands once, in the WGSL: a kernel is given the
//! buffer that has the variable's name (`row_of_slot`: "row of slot"), unless `rebound` in
//! `launches.rs` names another for that variable.

use wgpu::naga::Module;
use wgpu::naga::front::wgsl;
use wgpu::naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};

use crate::backend::Accumulation;

macro_rules! shader {
    ($name:literal) => {
        include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/shaders/", $name, ".wgsl"))
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

/// Which devices have a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum On {
    /// Those that add up in slots.
    Slots,
    /// Those that add up by atomics.
    Atomics,
    /// All, but the invocations of a tile share splats through subgroups where there are some.
    Tiles,
    /// All.
    All,
}

/// One shader module.
#[derive(Debug)]
pub(super) struct Stage {
    pub(super) name: &'static str,
    on: On,
    texts: &'static [&'static str],
}

const fn stage(name: &'static str, on: On, texts: &'static [&'static str]) -> Stage {
    Stage { name, on, texts }
}

/// All stages; [`Stage::text`] adds what depends on the device.
pub(super) const STAGES: &[Stage] = &[
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
    /// The text of the module for a device that adds up gradients in this way; `None` where the
    /// device does not have the stage.
    pub(super) fn text(&self, accumulation: Accumulation) -> Option<String> {
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

    /// A text of this stage as naga reads it.
    ///
    /// # Panics
    /// When it is not WGSL: texts are part of the program, and tests read every one.
    pub(super) fn parse(&self, text: &str) -> Module {
        wgsl::parse_str(text)
            .unwrap_or_else(|e| panic!("{}: {}", self.name, e.emit_to_string(text)))
    }

    /// The kernels of a module of this stage.
    pub(super) fn kernels(&self, text: &str, module: &Module) -> Vec<Kernel> {
        // wgpu validates everything; here only the use of variables is of interest.
        let info = Validator::new(ValidationFlags::empty(), Capabilities::all())
            .validate(module)
            .unwrap_or_else(|e| panic!("{}: {}", self.name, e.emit_to_string(text)));
        let kernel = |i| Kernel { entry: entry(module, i), bindings: bindings(module, &info, i) };
        (0..module.entry_points.len()).map(kernel).collect()
    }
}

/// An entry point of a module.
#[derive(Debug)]
pub(super) struct Kernel {
    pub(super) entry: String,
    pub(super) bindings: Vec<Binding>,
}

/// A buffer that a kernel uses: its number, and the variable's name in words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Binding {
    pub(super) number: u32,
    pub(super) name: String,
}

fn entry(module: &Module, i: usize) -> String {
    module.entry_points[i].name.clone()
}

fn bindings(module: &Module, info: &ModuleInfo, i: usize) -> Vec<Binding> {
    let uses = info.get_entry_point(i);
    let used = module.global_variables.iter().filter(|(handle, _)| !uses[*handle].is_empty());
    used.filter_map(|(_, variable)| {
        let name = variable.name.as_ref()?.replace('_', " ");
        Some(Binding { number: variable.binding.as_ref()?.binding, name })
    })
    .collect()
}

#[cfg(test)]
mod tests;
