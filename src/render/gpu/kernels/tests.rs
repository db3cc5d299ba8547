//! Tests of the shaders that need no device. Tests in `tests/it` compare their results.

use std::collections::{BTreeMap, BTreeSet};
use std::mem::offset_of;

use wgpu::naga::valid::{Capabilities, ValidationFlags, Validator};
use wgpu::naga::{AddressSpace, StructMember, TypeInner};

use densify_policies::policy::{
    Cadence, CandidateRequest, DepthMode, ErrorMode, ErrorScore, Needs, PixelLoss, Signal,
    SignalSet,
};

use super::super::adapter::features_for;
use super::super::frame::{Frame, State};
use super::super::launches::{Launches, Rebinding, base_name, rebound};
use super::super::pipelines::Variant;
use super::super::sizes::Sizes;
use super::*;
use crate::Shortcuts;
use crate::signals::RecordLayout;
use crate::{KeptPhotographs, MomentStorage, ParameterStorage};
use densify_core::antialiasing::Antialiasing;
use densify_shaders::{Accumulation, Formats, STAGES};

const SLOTS: Formats = Formats {
    accumulation: Accumulation::Slots,
    moments_in_bytes: false,
    parameters_in_16_bits: false,
};

/// Capabilities that naga must allow in addition to those of every WebGPU device.
fn capabilities(accumulation: Accumulation) -> Capabilities {
    let needed = features_for(accumulation);
    [
        (wgpu::Features::SUBGROUP, Capabilities::SUBGROUP),
        (wgpu::Features::SHADER_FLOAT32_ATOMIC, Capabilities::SHADER_FLOAT32_ATOMIC),
    ]
    .into_iter()
    .filter(|(feature, _)| needed.contains(*feature))
    .fold(Capabilities::IMMEDIATES, |all, (_, capability)| all | capability)
}

/// The shader modules of these formats, with their texts.
fn modules(formats: Formats) -> impl Iterator<Item = (&'static Stage, String, Module)> {
    let texts = STAGES.iter().filter_map(move |stage| Some((stage, stage.text(formats)?)));
    texts.map(|(stage, text)| {
        let module = parse(stage, &text);
        (stage, text, module)
    })
}

#[test]
fn every_shader_is_valid_and_within_the_portable_limits() {
    let mut seen = BTreeSet::new();
    for formats in Formats::all() {
        for (stage, text, module) in modules(formats) {
            check_stage(stage, &text, &module, capabilities(formats.accumulation));
            seen.insert(stage.name);
        }
    }
    assert_eq!(seen.len(), STAGES.len(), "stages that no device has");
}

/// Checks the limits that every WebGPU device has.
fn check_stage(stage: &Stage, text: &str, module: &Module, capabilities: Capabilities) {
    let info = Validator::new(ValidationFlags::all(), capabilities)
        .validate(module)
        .unwrap_or_else(|e| panic!("{}: {}", stage.name, e.emit_to_string(text)));
    for (i, entry) in module.entry_points.iter().enumerate() {
        let uses = info.get_entry_point(i);
        let (mut storage, mut shared) = (0, 0);
        for (handle, variable) in module.global_variables.iter() {
            if uses[handle].is_empty() {
                continue;
            }
            storage += u32::from(matches!(variable.space, AddressSpace::Storage { .. }));
            if variable.space == AddressSpace::WorkGroup {
                shared += module.types[variable.ty].inner.size(module.to_ctx());
            }
        }
        assert!(storage <= 8, "{}: {storage} storage buffers", entry.name);
        assert!(shared <= 16_384, "{}: {shared} bytes of shared memory", entry.name);
        assert!(entry.workgroup_size.iter().product::<u32>() <= 256, "{}", entry.name);
    }
}

/// Override constants are matched by name; a misspelt one would keep its default.
#[test]
fn every_override_has_a_value_and_every_signal_a_number() {
    let variant = Variant {
        records: RecordLayout::DIFFERENTIATED,
        alpha_and_depth: true,
        depth: true,
        pixel_loss: PixelLoss::Huber,
        shortcuts: Shortcuts::default(),
        antialiasing: Antialiasing::Wide,
        formats: SLOTS,
        counts_dominant: true,
    };
    let constants: BTreeSet<String> =
        variant.constants().into_iter().map(|(name, _)| name).collect();
    let mut declared = BTreeSet::new();
    for (_, _, module) in Formats::all().flat_map(modules) {
        declared.extend(module.overrides.iter().filter_map(|(_, o)| o.name.clone()));
    }
    assert_eq!(declared, constants);
}

/// The sizes of a backend with every optional buffer.
fn largest_sizes(formats: Formats) -> Sizes {
    let candidates = CandidateRequest {
        from: 0,
        until: 1,
        rows_per_candidate: 1,
        capacity: 1,
        error: ErrorMode::L1,
        depth: DepthMode::Median,
        min_alpha: 0.0,
        spaced: false,
    };
    let needs = Needs {
        signals: SignalSet::from(Signal::ALL),
        candidates: Some(candidates),
        cadence: Cadence { all: 2, sh_rest: 2 },
        error_score: ErrorScore { edge: 1.0, ..ErrorScore::default() },
        ..Needs::default()
    };
    let mut sizes = Sizes::new(10.into(), 100, 3, (32, 32), &needs, true, formats.accumulation);
    if formats.moments_in_bytes {
        sizes.storage.moments = MomentStorage::Both8;
    }
    if formats.parameters_in_16_bits {
        sizes.storage.parameters = ParameterStorage::F16;
    }
    sizes.photographs = KeptPhotographs { count: 1, with_masks: true };
    sizes.exposures = true;
    sizes.poses = true;
    sizes.vignettes = true;
    sizes
}

/// A kernel that nothing dispatches would be a missing stage; a dispatched name without a kernel would panic.
#[test]
fn every_kernel_is_dispatched_by_its_name() {
    let mut found_kernels = BTreeSet::new();
    for (stage, text, module) in Formats::all().flat_map(modules) {
        let found = kernels(stage, &text, &module);
        found_kernels.extend(found.into_iter().map(|kernel| base_name(&kernel.entry).to_owned()));
    }
    for kernel in rebound(&largest_sizes(SLOTS)).keys() {
        assert!(
            found_kernels.contains(*kernel),
            "`rebound` has buffers for `{kernel}`, which is no kernel"
        );
    }
    // These are bound to each array of rows, not dispatched by name.
    let mut dispatched = BTreeSet::from(
        ["copy_rows", "swap_rows", "audit", "audit_bytes", "audit_halves"].map(str::to_owned),
    );
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/gpu");
    for entry in std::fs::read_dir(folder).expect("the sources") {
        let path = entry.expect("a file").path();
        let Ok(text) = std::fs::read_to_string(path) else { continue };
        for call in ["l.get(\"", "l.nth(\"", "launches.get(\"", "launches.nth(\""] {
            let names = text.split(call).skip(1).filter_map(|rest| rest.split('"').next());
            dispatched.extend(names.map(str::to_owned));
        }
    }
    assert_eq!(dispatched, found_kernels);
}

/// A kernel is compiled again where one of its constants changes, and only there.
#[test]
fn kernels_have_exactly_the_constants_that_they_use() {
    let (mut declared, mut used) = (BTreeSet::new(), BTreeSet::new());
    let mut of_kernel = BTreeMap::new();
    for (stage, text, module) in modules(SLOTS) {
        let names = module.overrides.iter().filter_map(|(_, constant)| constant.name.clone());
        declared.extend(names);
        for Kernel { entry, overrides, .. } in kernels(stage, &text, &module) {
            used.extend(overrides.iter().cloned());
            of_kernel.insert(entry, overrides);
        }
    }
    assert_eq!(used, declared);
    assert!(of_kernel["similarity"].is_empty());
    assert!(of_kernel["rasterize_bwd"].contains("RECORD"));
    assert!(!of_kernel["rasterize"].contains("RECORD"));
}

/// A variable without a buffer would be bound to the placeholder.
#[test]
fn every_variable_has_a_buffer() {
    for formats in Formats::all() {
        let mut found_kernels = BTreeMap::new();
        for (stage, text, module) in modules(formats) {
            for Kernel { entry, bindings, .. } in kernels(stage, &text, &module) {
                assert!(
                    found_kernels.insert(entry.clone(), bindings).is_none(),
                    "two kernels `{entry}`"
                );
            }
        }
        let sizes = largest_sizes(formats);
        let ranges = sizes.ranges().into_iter().map(|range| range.name);
        let buffers: BTreeSet<_> =
            sizes.planned().into_iter().map(|p| p.name).chain(ranges).collect();
        let bind = |kernel: &str, rebindings: &[Rebinding]| {
            let bindings = &found_kernels[kernel];
            for (variable, buffer) in rebindings {
                let is_used = bindings.iter().any(|binding| binding.name == *variable);
                assert!(is_used, "{kernel}: it uses no `{variable}`");
                assert!(buffers.contains(buffer), "{kernel}: there is no `{buffer}`");
            }
            for Binding { name, .. } in bindings {
                let is_given = rebindings.iter().any(|(variable, _)| variable == name);
                assert!(is_given || buffers.contains(&**name), "{kernel}: `{name}`");
            }
        };
        let _ = Launches::new(found_kernels.keys().map(|name| &**name), &bind, &sizes);
    }
}

/// Lists the fields of a struct with their offsets, and the size of the struct.
macro_rules! layout {
    ($type:ident: $($field:ident)*) => {
        (stringify!($type), vec![$((stringify!($field), offset_of!($type, $field))),*], size_of::<$type>())
    };
}

#[test]
fn struct_layouts_are_those_of_the_shaders() {
    let project = &STAGES[0];
    let text = project.text(SLOTS).expect("every device projects");
    let module = parse(project, &text);
    let layouts = [
        layout!(Frame: rotation centre lens ratio background image model rates more_rates noise score errors draw frozen planes),
        layout!(State: visible total bands short entries_low entries_high held broken_off l1 ssim depth spare_f),
    ];
    for (name, mut expected, size) in layouts {
        let found = module.types.iter().find(|(_, t)| t.name.as_deref() == Some(name));
        let Some(TypeInner::Struct { members, .. }) = found.map(|(_, t)| &t.inner) else {
            panic!("no struct `{name}`");
        };
        if name == "State" {
            expected.push(("cuts", size));
        }
        let name_and_offset =
            |m: &StructMember| (m.name.clone().unwrap_or_default(), m.offset as usize);
        let found: Vec<_> = members.iter().map(name_and_offset).collect();
        let expected: Vec<_> =
            expected.iter().map(|(name, at)| ((*name).to_owned(), *at)).collect();
        assert_eq!(found, expected, "{name}");
    }
}
