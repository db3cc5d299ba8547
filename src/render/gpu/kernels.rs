//! Reads the kernels of a stage and their bindings from the WGSL, with naga.
//!
//! Bindings are declared only in the WGSL. A variable is bound to the buffer of the same name (`row_of_slot`:
//! "row of slot"), unless `rebound` in `launches.rs` names another.

use std::collections::BTreeSet;

use densify_shaders::Stage;
use wgpu::naga::Module;
use wgpu::naga::compact::{KeepUnused, compact};
use wgpu::naga::front::wgsl;
use wgpu::naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};

/// Parses the WGSL of a stage.
///
/// # Panics
/// When the text is not WGSL: texts are part of the program, and tests parse all of them.
pub(super) fn parse(stage: &Stage, text: &str) -> Module {
    wgsl::parse_str(text).unwrap_or_else(|e| panic!("{}: {}", stage.name, e.emit_to_string(text)))
}

/// The kernels of a stage.
pub(super) fn kernels(stage: &Stage, text: &str, module: &Module) -> Vec<Kernel> {
    // No validation, which wgpu does; only the use of variables is needed.
    let info = Validator::new(ValidationFlags::empty(), Capabilities::all())
        .validate(module)
        .unwrap_or_else(|e| panic!("{}: {}", stage.name, e.emit_to_string(text)));
    let entries = module.entry_points.iter().enumerate();
    entries
        .map(|(i, e)| Kernel {
            entry: e.name.clone(),
            bindings: bindings(module, &info, i),
            overrides: overrides(module, i),
        })
        .collect()
}

/// An entry point of a module.
#[derive(Debug)]
pub(super) struct Kernel {
    pub(super) entry: String,
    pub(super) bindings: Vec<Binding>,
    /// Names of the `override` constants that it uses.
    pub(super) overrides: BTreeSet<String>,
}

/// A buffer that a kernel uses: its binding number, and the variable's name with spaces for underscores.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Binding {
    pub(super) number: u32,
    pub(super) name: String,
}

fn bindings(module: &Module, info: &ModuleInfo, entry: usize) -> Vec<Binding> {
    let uses = info.get_entry_point(entry);
    let used = module.global_variables.iter().filter(|(handle, _)| !uses[*handle].is_empty());
    used.filter_map(|(_, variable)| {
        let name = variable.name.as_ref()?.replace('_', " ");
        Some(Binding { number: variable.binding.as_ref()?.binding, name })
    })
    .collect()
}

/// The names of the `override` constants that an entry point uses: those of the module without the other entry points.
fn overrides(module: &Module, entry: usize) -> BTreeSet<String> {
    let mut alone = module.clone();
    alone.entry_points = vec![module.entry_points[entry].clone()];
    compact(&mut alone, KeepUnused::No);
    alone.overrides.iter().filter_map(|(_, constant)| constant.name.clone()).collect()
}

#[cfg(test)]
mod tests;
