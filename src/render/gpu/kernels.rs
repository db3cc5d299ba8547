//! The kernels of each stage, and the bindings that naga reads from their texts.
//!
//! A binding stands once, in the WGSL: a kernel is given the buffer that has the variable's name
//! (`row_of_slot`: "row of slot"), unless `rebound` in `launches.rs` names another for that variable.

use densify_shaders::Stage;
use wgpu::naga::Module;
use wgpu::naga::front::wgsl;
use wgpu::naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};

/// A text of a stage as naga reads it.
///
/// # Panics
/// When it is not WGSL: texts are part of the program, and tests read every one.
pub(super) fn parse(stage: &Stage, text: &str) -> Module {
    wgsl::parse_str(text).unwrap_or_else(|e| panic!("{}: {}", stage.name, e.emit_to_string(text)))
}

/// The kernels of a module of a stage.
pub(super) fn kernels(stage: &Stage, text: &str, module: &Module) -> Vec<Kernel> {
    // wgpu validates everything; here only the use of variables is of interest.
    let info = Validator::new(ValidationFlags::empty(), Capabilities::all())
        .validate(module)
        .unwrap_or_else(|e| panic!("{}: {}", stage.name, e.emit_to_string(text)));
    let kernel = |i| Kernel { entry: entry(module, i), bindings: bindings(module, &info, i) };
    (0..module.entry_points.len()).map(kernel).collect()
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
