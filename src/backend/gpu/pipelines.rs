//! The compute pipelines: which shader texts make up a kernel, and which buffer stands at which
//! binding. A text is the shared one, what it builds on, and the stage's own.

use wgpu::{
    BindGroup, BindGroupDescriptor, BindGroupEntry, BindGroupLayout, ComputePipeline, Device,
};

use super::accumulation::Accumulation;
use super::buffers::Buffers;
use crate::backend::Shortcuts;

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

/// Which devices have a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Of {
    /// Those that add up in slots.
    Slots,
    /// Those that add up by atomics.
    Atomics,
    /// All, but how the invocations of a tile work together is another thing where there are subgroups.
    Tiles,
    /// All.
    All,
}

/// The texts of each stage; [`text`] adds those that its device asks for.
pub(super) const STAGES: [(&str, Of, &[&str]); 14] = [
    ("project", Of::All, &[VIEW, GAUSSIAN, shader!("project")]),
    ("tiles", Of::All, &[VIEW, shader!("tiles")]),
    ("rasterize", Of::Tiles, &[VIEW, QUADS, shader!("rasterize")]),
    ("loss", Of::All, &[VIEW, shader!("loss")]),
    ("rasterize_bwd", Of::Slots, &[VIEW, QUADS, BACKWARD, shader!("rasterize_bwd")]),
    (
        "rasterize_bwd_atomic",
        Of::Atomics,
        &[VIEW, QUADS, BACKWARD, shader!("rasterize_bwd_atomic")],
    ),
    ("project_bwd", Of::All, &[VIEW, GAUSSIAN, shader!("project_bwd")]),
    ("adam", Of::All, &[VIEW, RANDOM, shader!("adam")]),
    ("signals", Of::All, &[VIEW, shader!("signals")]),
    ("apply", Of::All, &[VIEW, RANDOM, shader!("apply")]),
    ("candidates", Of::All, &[VIEW, RANDOM, shader!("candidates")]),
    ("observe", Of::Slots, &[VIEW, QUADS, BLENDED, shader!("observe")]),
    ("observe_atomic", Of::Atomics, &[VIEW, QUADS, BLENDED, shader!("observe_atomic")]),
    ("audit", Of::All, &[VIEW, shader!("audit")]),
];

/// The text of a stage's module, for a device that adds up gradients in this way; none of a stage that
/// it does not have.
pub(super) fn text(stage: usize, accumulation: Accumulation) -> Option<String> {
    let (_, of, texts) = STAGES[stage];
    let more: &[&str] = match (of, accumulation) {
        (Of::All, _) => &[],
        (Of::Tiles, Accumulation::Slots) => &[BATCH],
        (Of::Tiles, _) => &[SUBGROUPS],
        (Of::Slots, Accumulation::Slots) => &[BATCH, SLOTS],
        (Of::Atomics, Accumulation::SubgroupCas) => {
            &[SUBGROUPS, ATOMICS, shader!("shared/sums_cas")]
        }
        (Of::Atomics, Accumulation::SubgroupAtomics) => {
            &[SUBGROUPS, ATOMICS, shader!("shared/sums_f32")]
        }
        (Of::Slots, _) | (Of::Atomics, Accumulation::Slots) => return None,
    };
    Some([texts, more].concat().concat())
}

macro_rules! kernels {
    ($($kernel:ident: $stage:literal $entry:literal [$($binding:literal),*];)*) => {
        /// A kernel: an entry point of a stage's module.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub(super) enum Kernel { $($kernel),* }

        /// Stage, entry point and bindings of each kernel, in the order of [`Kernel`].
        pub(super) const KERNELS: &[(&str, &str, &[u32])] =
            &[$(($stage, $entry, &[$($binding),*])),*];
    };
}

kernels! {
    Project: "project" "project" [0, 1, 2, 3, 4, 5, 6, 7, 8];
    ScanBlocks: "tiles" "scan_blocks" [0, 1, 3, 9, 10];
    ScanSums: "tiles" "scan_sums" [0, 1, 2, 10];
    Compact: "tiles" "compact" [0, 3, 7, 8, 9, 10];
    CountEntries: "tiles" "count_entries" [0, 1, 4, 9, 11];
    EmitEntries: "tiles" "emit_entries" [0, 1, 4, 7, 9, 10, 11, 12, 13];
    CountTiles: "tiles" "count_tiles" [0, 1, 4, 11, 15];
    CutBands: "tiles" "cut_bands" [0, 1, 15];
    CountDigits: "tiles" "count_digits" [1, 5, 9];
    Scatter: "tiles" "scatter" [1, 5, 6, 7, 8, 9, 10];
    FindTiles: "tiles" "find_tiles" [0, 1, 5, 14];
    Rasterize: "rasterize" "rasterize" [0, 1, 2, 3, 4, 5, 6, 7];
    Similarity: "loss" "similarity" [0, 2, 3, 4, 5, 7, 8];
    PixelGradient: "loss" "pixel_gradient" [0, 2, 3, 4, 5, 6];
    LossTotal: "loss" "total" [0, 1, 7];
    RasterizeBwd: "rasterize_bwd" "rasterize_bwd" [0, 1, 2, 3, 4, 5, 6, 7, 8];
    Gather: "rasterize_bwd" "gather" [0, 9, 10, 11, 12];
    RasterizeBwdAtomic: "rasterize_bwd_atomic" "rasterize_bwd_atomic" [0, 1, 2, 3, 4, 5, 6, 7, 8];
    ClearSums: "rasterize_bwd_atomic" "clear_sums" [0, 8];
    ProjectBwd: "project_bwd" "project_bwd" [0, 1, 2, 3, 4, 5, 6, 7, 8];
    AdamBand: "adam" "adam_band" [0, 1, 2, 3, 4, 5, 6, 7, 8];
    AdamGeometry: "adam" "adam_geometry" [0, 1, 2, 3, 4, 5, 6, 7, 8];
    Accumulate: "signals" "accumulate" [0, 1, 2, 3, 4, 5, 6];
    Measure: "signals" "measure" [0, 1, 2, 4, 5];
    Present: "signals" "present" [0, 2, 7, 8];
    CopyRows: "apply" "copy_rows" [1, 2];
    Breed: "apply" "breed" [1, 3];
    Rewrite: "apply" "rewrite" [1, 3];
    Sow: "apply" "sow" [1, 3, 4];
    ClampOpacity: "apply" "clamp_opacity" [3, 5, 6, 7];
    Surface: "candidates" "surface" [0, 1, 2, 3, 4, 5, 6, 7, 8];
    CountErrors: "candidates" "count_errors" [0, 9, 10, 11];
    Narrow: "candidates" "narrow" [11, 12];
    WriteWorst: "candidates" "write_worst" [0, 9, 10, 11, 12];
    Replay: "observe" "replay" [0, 1, 2, 3, 4, 5, 6, 7];
    GatherColumns: "observe" "gather_columns" [0, 8, 9, 10, 11];
    ReplayAtomic: "observe_atomic" "replay_atomic" [0, 1, 2, 3, 4, 5, 6, 8];
    Audit: "audit" "audit" [1, 2];
}

/// What kernels are compiled for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Variant {
    /// Detail of the records.
    pub(super) detail: u32,
    /// Whether alpha and depth have gradients.
    pub(super) more: bool,
    pub(super) shortcuts: Shortcuts,
    pub(super) accumulation: Accumulation,
}

/// The kernels of a device, for records of one detail, in the order of [`Kernel`]; none of stages that
/// it does not have.
#[derive(Debug)]
pub(super) struct Pipelines {
    pipelines: Vec<Option<(ComputePipeline, BindGroupLayout)>>,
}

/// How a stage's text declares the buffer at a binding.
fn binding_type(text: &str, binding: u32) -> wgpu::BufferBindingType {
    let declared = |space: &str| text.contains(&format!("@binding({binding}) var<{space}>"));
    if declared("uniform") {
        return wgpu::BufferBindingType::Uniform;
    }
    wgpu::BufferBindingType::Storage { read_only: declared("storage, read") }
}

/// Bytes of `now`.
const NOW_BYTES: u32 = 16;

/// A kernel with its buffers.
#[derive(Debug)]
pub(super) struct Launch {
    pub(super) kernel: Kernel,
    pub(super) bindings: BindGroup,
}

impl Pipelines {
    /// Builds every kernel that there is for the variant.
    pub(super) fn new(device: &Device, variant: Variant) -> Self {
        let Variant { detail, more, shortcuts, accumulation } = variant;
        let detail = ("DETAIL", f64::from(detail));
        // Every text has these, as the shared one does.
        let blending = [
            ("ALPHA_MIN", f64::from(shortcuts.alpha_min)),
            ("LOG2_REACH", f64::from(shortcuts.log2_reach())),
            ("TRANSMITTANCE_MIN", f64::from(shortcuts.transmittance_min)),
        ];
        let modules: Vec<_> = STAGES
            .iter()
            .enumerate()
            .map(|(place, (stage, ..))| {
                let text = text(place, accumulation)?;
                let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
                    label: Some(stage),
                    source: wgpu::ShaderSource::Wgsl((&text).into()),
                });
                Some((module, text))
            })
            .collect();
        let pipelines = KERNELS
            .iter()
            .map(|&(stage, entry, bindings)| {
                let place = STAGES.iter().position(|(name, ..)| *name == stage).unwrap_or(0);
                let (module, text) = modules[place].as_ref()?;
                let own: &[(&str, f64)] = match stage {
                    "rasterize_bwd" | "rasterize_bwd_atomic" => {
                        &[detail, ("MORE", f64::from(u8::from(more)))]
                    }
                    "project_bwd" | "signals" => &[detail],
                    _ => &[],
                };
                let constants = [own, &blending].concat();
                let layout = bind_group_layout(device, entry, text, bindings);
                let pipeline_layout =
                    device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                        label: Some(entry),
                        bind_group_layouts: &[Some(&layout)],
                        immediate_size: NOW_BYTES,
                    });
                let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                    label: Some(entry),
                    layout: Some(&pipeline_layout),
                    module,
                    entry_point: Some(entry),
                    compilation_options: wgpu::PipelineCompilationOptions {
                        constants: &constants,
                        // Every kernel writes what it reads.
                        zero_initialize_workgroup_memory: false,
                    },
                    cache: None,
                });
                Some((pipeline, layout))
            })
            .collect();
        Self { pipelines }
    }

    /// # Panics
    /// When the device does not have the kernel's stage: a bug in the caller.
    fn built(&self, kernel: Kernel) -> &(ComputePipeline, BindGroupLayout) {
        let built = self.pipelines[kernel as usize].as_ref();
        built.unwrap_or_else(|| panic!("this device adds up in another way than {kernel:?}"))
    }

    pub(super) fn pipeline(&self, kernel: Kernel) -> &ComputePipeline {
        &self.built(kernel).0
    }

    /// Binds buffers by name, in the order of the kernel's bindings.
    pub(super) fn launch(
        &self,
        device: &Device,
        buffers: &Buffers,
        kernel: Kernel,
        names: &[&'static str],
    ) -> Launch {
        let (_, entry, bindings) = KERNELS[kernel as usize];
        assert_eq!(bindings.len(), names.len(), "buffers of {entry}");
        let entries: Vec<_> = bindings
            .iter()
            .zip(names)
            .map(|(&binding, name)| BindGroupEntry {
                binding,
                resource: buffers.get(name).as_entire_binding(),
            })
            .collect();
        let bindings = device.create_bind_group(&BindGroupDescriptor {
            label: Some(entry),
            layout: &self.built(kernel).1,
            entries: &entries,
        });
        Launch { kernel, bindings }
    }
}

fn bind_group_layout(
    device: &Device,
    label: &str,
    text: &str,
    bindings: &[u32],
) -> BindGroupLayout {
    let entries: Vec<_> = bindings
        .iter()
        .map(|&binding| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: binding_type(text, binding),
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        })
        .collect();
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some(label),
        entries: &entries,
    })
}

#[cfg(test)]
mod tests;
