//! Compiles the compute pipelines of a device. wgpu derives their layouts from the shaders.

use std::collections::HashMap;

use densify_policies::policy::{SUPPORT_WEIGHT, Signal};
use wgpu::{ComputePipeline, Device, ShaderModule};

use super::kernels::{Binding, kernels, parse};
use crate::Shortcuts;
use crate::signals::{Field, ParameterSignal, RecordLayout};
use densify_core::antialiasing::Antialiasing;
use densify_shaders::{Formats, STAGES};

/// Compile-time options of the kernels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Variant {
    pub(super) records: RecordLayout,
    /// True if gradients of alpha and depth are computed too.
    pub(super) alpha_and_depth: bool,
    /// True if depth may be in the loss.
    pub(super) depth: bool,
    pub(super) shortcuts: Shortcuts,
    pub(super) formats: Formats,
    /// True if the pixels that each row dominates are counted.
    pub(super) counts_dominant: bool,
    pub(super) antialiasing: Antialiasing,
}

impl Variant {
    /// The values of the shaders' `override` constants.
    pub(super) fn constants(&self) -> Vec<(String, f64)> {
        let mut all = vec![
            ("RECORD".to_owned(), self.records.stride() as f64),
            ("MORE".to_owned(), f64::from(u8::from(self.alpha_and_depth))),
            ("DEPTH_IN_LOSS".to_owned(), f64::from(u8::from(self.depth))),
            ("COUNTS_DOMINANT".to_owned(), f64::from(u8::from(self.counts_dominant))),
            ("BLUR".to_owned(), f64::from(self.antialiasing.kernel())),
            ("LOWERS_OPACITY".to_owned(), f64::from(u8::from(self.antialiasing.is_on()))),
            ("ALPHA_MIN".to_owned(), f64::from(self.shortcuts.alpha_min)),
            ("LOG2_REACH".to_owned(), f64::from(self.shortcuts.log2_reach())),
            ("TRANSMITTANCE_MIN".to_owned(), f64::from(self.shortcuts.transmittance_min)),
            ("SUPPORT_WEIGHT".to_owned(), f64::from(SUPPORT_WEIGHT)),
        ];
        let offset = |field| self.records.at(field).unwrap_or(0) as f64;
        all.extend(Field::ALL.map(|field| (field.constant().to_owned(), offset(field))));
        let is_computed = |signal: &Signal| ParameterSignal::new(*signal).is_none();
        let computed = Signal::ALL.into_iter().filter(is_computed);
        all.extend(computed.map(|signal| (constant(signal), f64::from(signal as u32))));
        all
    }
}

/// Name of a signal's constant in the shaders, such as `WEIGHT_MAX`.
fn constant(signal: Signal) -> String {
    let mut name = String::new();
    for c in format!("{signal:?}").chars() {
        if c.is_uppercase() && !name.is_empty() {
            name.push('_');
        }
        name.push(c.to_ascii_uppercase());
    }
    name
}

/// A compiled kernel and its bindings.
#[derive(Debug)]
pub(super) struct CompiledKernel {
    pub(super) pipeline: ComputePipeline,
    pub(super) bindings: Vec<Binding>,
}

/// The kernels of a device, by name.
#[derive(Debug)]
pub(super) struct Pipelines {
    kernels: HashMap<String, CompiledKernel>,
}

impl Pipelines {
    /// Compiles every kernel of the variant.
    pub(super) fn new(device: &Device, variant: Variant) -> Self {
        let mut compiled = HashMap::new();
        for stage in STAGES {
            let Some(text) = stage.text(variant.formats) else { continue };
            let parsed = parse(stage, &text);
            let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(stage.name),
                source: wgpu::ShaderSource::Wgsl((&text).into()),
            });
            let is_declared =
                |name: &str| parsed.overrides.iter().any(|(_, o)| o.name.as_deref() == Some(name));
            let constants = variant.constants();
            let declared = constants.iter().filter(|(name, _)| is_declared(name));
            let constants: Vec<_> = declared.map(|(name, value)| (&**name, *value)).collect();
            for kernel in kernels(stage, &text, &parsed) {
                let pipeline = compile(device, &module, &kernel.entry, &constants);
                let compiled_kernel = CompiledKernel { pipeline, bindings: kernel.bindings };
                compiled.insert(kernel.entry, compiled_kernel);
            }
        }
        Self { kernels: compiled }
    }

    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.kernels.keys().map(String::as_str)
    }

    /// # Panics
    /// When the device does not have the kernel: a bug in the caller.
    pub(super) fn get(&self, kernel: &str) -> &CompiledKernel {
        let found = self.kernels.get(kernel);
        found.unwrap_or_else(|| panic!("this device has no kernel `{kernel}`"))
    }
}

fn compile(
    device: &Device,
    module: &ShaderModule,
    entry: &str,
    constants: &[(&str, f64)],
) -> ComputePipeline {
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(entry),
        layout: None,
        module,
        entry_point: Some(entry),
        compilation_options: wgpu::PipelineCompilationOptions {
            constants,
            // Every kernel writes shared memory before it reads it.
            zero_initialize_workgroup_memory: false,
        },
        cache: None,
    })
}
