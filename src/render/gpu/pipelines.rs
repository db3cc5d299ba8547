//! Compiles the compute pipelines of a device. wgpu derives their layouts from the shaders.

use std::collections::HashMap;
use std::sync::Arc;

use densify_policies::policy::{PixelLoss, SUPPORT_WEIGHT, Signal};
use wgpu::{ComputePipeline, Device, ShaderModule};

use super::kernels::{Binding, Kernel, kernels, parse};
use crate::Shortcuts;
use crate::signals::{Field, ParameterSignal, RecordLayout};
use densify_core::antialiasing::Antialiasing;
use densify_shaders::{Formats, STAGES, Stage};

/// Compile-time options of the kernels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Variant {
    pub(super) records: RecordLayout,
    /// True if gradients of alpha and depth are computed too.
    pub(super) alpha_and_depth: bool,
    /// True if depth may be in the loss.
    pub(super) depth: bool,
    pub(super) pixel_loss: PixelLoss,
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
            ("PIXEL_BOUND".to_owned(), f64::from(self.pixel_loss.bound())),
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
    entry: String,
    /// Values of the constants that it uses.
    constants: Vec<(String, f64)>,
    pub(super) pipeline: ComputePipeline,
    pub(super) bindings: Vec<Binding>,
}

/// The kernels that a device has compiled. Variants share the kernels whose text and constants are equal.
#[derive(Debug, Default)]
pub(super) struct KernelCache {
    variants: Vec<(Variant, Arc<Pipelines>)>,
    /// By the text of the stage.
    stages: HashMap<String, CachedStage>,
}

impl KernelCache {
    /// The kernels of a variant; compiles those that are new.
    pub(super) fn pipelines(&mut self, device: &Device, variant: Variant) -> Arc<Pipelines> {
        if let Some((_, pipelines)) = self.variants.iter().find(|(known, _)| *known == variant) {
            return pipelines.clone();
        }
        let mut kernels = HashMap::new();
        let values = variant.constants();
        for stage in STAGES {
            let Some(text) = stage.text(variant.formats) else { continue };
            let new = || CachedStage::new(device, stage, &text);
            let cached = self.stages.entry(text.clone()).or_insert_with(new);
            kernels.extend(cached.compiled(device, &values));
        }
        let pipelines = Arc::new(Pipelines { kernels });
        self.variants.push((variant, pipelines.clone()));
        pipelines
    }
}

/// The kernels of a text.
#[derive(Debug)]
struct CachedStage {
    kernels: Vec<Kernel>,
    module: ShaderModule,
    compiled: Vec<Arc<CompiledKernel>>,
}

impl CachedStage {
    fn new(device: &Device, stage: &Stage, text: &str) -> Self {
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(stage.name),
            source: wgpu::ShaderSource::Wgsl(text.into()),
        });
        let kernels = kernels(stage, text, &parse(stage, text));
        Self { kernels, module, compiled: Vec::new() }
    }

    /// The kernels with the values of all constants.
    fn compiled<'a>(
        &'a mut self,
        device: &'a Device,
        values: &'a [(String, f64)],
    ) -> impl Iterator<Item = (String, Arc<CompiledKernel>)> + 'a {
        let Self { kernels, module, compiled } = self;
        kernels.iter().map(move |kernel| {
            let is_used = |name: &String| kernel.overrides.contains(name);
            let constants = values.iter().filter(|(name, _)| is_used(name)).cloned();
            let constants: Vec<_> = constants.collect();
            let is_same = |known: &&Arc<CompiledKernel>| {
                known.entry == kernel.entry && known.constants == constants
            };
            let found = compiled.iter().find(is_same).cloned().unwrap_or_else(|| {
                let pipeline = compile(device, module, &kernel.entry, &constants);
                let (entry, bindings) = (kernel.entry.clone(), kernel.bindings.clone());
                let new = Arc::new(CompiledKernel { entry, constants, pipeline, bindings });
                compiled.push(new.clone());
                new
            });
            (kernel.entry.clone(), found)
        })
    }
}

/// The kernels of a variant, by name.
#[derive(Debug)]
pub(super) struct Pipelines {
    kernels: HashMap<String, Arc<CompiledKernel>>,
}

impl Pipelines {
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
    constants: &[(String, f64)],
) -> ComputePipeline {
    let constants: Vec<_> = constants.iter().map(|(name, value)| (&**name, *value)).collect();
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(entry),
        layout: None,
        module,
        entry_point: Some(entry),
        compilation_options: wgpu::PipelineCompilationOptions {
            constants: &constants,
            // Every kernel writes shared memory before it reads it.
            zero_initialize_workgroup_memory: false,
        },
        cache: None,
    })
}
