//! Shaders and their kernels, offline; and what shaders draw, on a device.

use std::collections::{BTreeMap, BTreeSet};
use std::mem::offset_of;

use wgpu::naga::valid::{Capabilities, ValidationFlags, Validator};
use wgpu::naga::{AddressSpace, Module, StructMember, TypeInner};

use densify_policies::policy::{
    Cadence, CandidateRequest, DepthMode, ErrorMode, Needs, Signal, SignalSet,
};
use densify_policies::rng::{PolicyRng, Purpose};

use super::super::adapter::AdapterChoice;
use super::super::device::Device as Opened;
use super::super::frame::{Frame, State, folded_seed};
use super::super::launches::Launches;
use super::super::photographs::KeptPhotographs;
use super::super::pipelines::Variant;
use super::super::readback;
use super::super::sizes::Sizes;
use super::*;
use crate::backend::Shortcuts;
use crate::backend::signals::RecordLayout;

/// What naga must allow, beside what WebGPU has everywhere.
fn capabilities(accumulation: Accumulation) -> Capabilities {
    let needed = accumulation.features();
    [
        (wgpu::Features::SUBGROUP, Capabilities::SUBGROUP),
        (wgpu::Features::SHADER_FLOAT32_ATOMIC, Capabilities::SHADER_FLOAT32_ATOMIC),
    ]
    .into_iter()
    .filter(|(feature, _)| needed.contains(*feature))
    .fold(Capabilities::IMMEDIATES, |all, (_, capability)| all | capability)
}

#[test]
fn every_shader_is_valid_and_within_the_portable_limits() {
    let mut seen = BTreeSet::new();
    for accumulation in Accumulation::ALL {
        for stage in &STAGES {
            if let Some(text) = stage.text(accumulation) {
                check_stage(stage, &text, capabilities(accumulation));
                seen.insert(stage.name);
            }
        }
    }
    assert_eq!(seen.len(), STAGES.len(), "stages that no device has");
}

/// A device is asked for no more than its way to add up needs, and for all of that.
#[test]
fn a_shader_needs_what_its_way_to_add_up_asks_for() {
    let is_valid = |stage: &Stage, accumulation, allowed| {
        let text = stage.text(accumulation).expect("it has the stage");
        let module = stage.parse(&text);
        Validator::new(ValidationFlags::all(), allowed).validate(&module).is_ok()
    };
    for stage in STAGES.iter().filter(|stage| stage.on == On::Atomics) {
        for accumulation in [Accumulation::SubgroupCas, Accumulation::SubgroupAtomics] {
            let all = capabilities(accumulation);
            assert!(is_valid(stage, accumulation, all), "{accumulation}");
            for one in all.difference(Capabilities::IMMEDIATES).iter() {
                assert!(!is_valid(stage, accumulation, all.difference(one)), "{one:?}");
            }
        }
    }
}

/// Every device has the portable limits of WebGPU.
fn check_stage(stage: &Stage, text: &str, capabilities: Capabilities) {
    let module = stage.parse(text);
    let info = Validator::new(ValidationFlags::all(), capabilities)
        .validate(&module)
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

/// A shader's `override` is given its value by name, and a signal that the shader does not know would
/// be 0 for good.
#[test]
fn every_override_has_a_value_and_every_signal_a_number() {
    let variant = Variant {
        records: RecordLayout::ALL,
        more: true,
        shortcuts: Shortcuts::default(),
        accumulation: Accumulation::Slots,
    };
    let constants: BTreeSet<String> =
        variant.constants().into_iter().map(|(name, _)| name).collect();
    let mut declared = BTreeSet::new();
    for stage in &STAGES {
        for accumulation in Accumulation::ALL {
            let Some(text) = stage.text(accumulation) else { continue };
            let module = stage.parse(&text);
            declared.extend(module.overrides.iter().filter_map(|(_, o)| o.name.clone()));
        }
    }
    assert_eq!(declared, constants);
}

/// The sizes of a backend that has every buffer there is.
fn largest_sizes(accumulation: Accumulation) -> Sizes {
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
        ..Needs::default()
    };
    let mut sizes = Sizes::new(10, 100, 3, (32, 32), &needs, accumulation);
    sizes.photographs = KeptPhotographs { count: 1, with_masks: true };
    sizes
}

/// A variable that no buffer has the name of would be bound to nothing.
#[test]
fn every_kernel_is_launched_and_every_variable_has_a_buffer() {
    for accumulation in Accumulation::ALL {
        let mut kernels = BTreeMap::new();
        for stage in &STAGES {
            let Some(text) = stage.text(accumulation) else { continue };
            for Kernel { entry, bindings } in stage.kernels(&text, &stage.parse(&text)) {
                assert!(kernels.insert(entry.clone(), bindings).is_none(), "two kernels `{entry}`");
            }
        }
        let sizes = largest_sizes(accumulation);
        let buffers: BTreeSet<_> = sizes.planned().into_iter().map(|p| p.name).collect();
        let launched = std::cell::RefCell::new(BTreeSet::new());
        let _ = Launches::new(
            &|kernel, instead| {
                let bindings = &kernels[kernel];
                for (variable, buffer) in instead {
                    let is_used = bindings.iter().any(|binding| binding.name == *variable);
                    assert!(is_used, "{kernel}: it uses no `{variable}`");
                    assert!(buffers.contains(buffer), "{kernel}: there is no `{buffer}`");
                }
                for Binding { name, .. } in bindings {
                    let is_given = instead.iter().any(|(variable, _)| variable == name);
                    assert!(is_given || buffers.contains(&**name), "{kernel}: `{name}`");
                }
                launched.borrow_mut().insert(kernel);
            },
            &sizes,
        );
        let all: BTreeSet<_> = kernels.keys().map(|name| &**name).collect();
        assert_eq!(*launched.borrow(), all, "{accumulation}");
    }
}

fn offsets(module: &Module, name: &str) -> (BTreeMap<String, u32>, u32) {
    let found = module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some(name));
    let Some((_, ty)) = found else { panic!("no struct {name}") };
    let TypeInner::Struct { members, span } = &ty.inner else { panic!("{name} is no struct") };
    let of = |m: &StructMember| (m.name.clone().unwrap_or_default(), m.offset);
    (members.iter().map(of).collect(), *span)
}

#[test]
fn structs_lie_as_the_shaders_read_them() {
    macro_rules! check {
        ($offsets:expr, $ty:ty, $($field:ident)*) => {{
            $(assert_eq!($offsets[stringify!($field)] as usize, offset_of!($ty, $field),
                "{}", stringify!($field));)*
            [$(stringify!($field)),*].len()
        }};
    }
    let tiles = &STAGES[1];
    let module = tiles.parse(&tiles.text(Accumulation::Slots).expect("all devices have it"));
    let (frame, span) = offsets(&module, "Frame");
    let fields = check!(frame, Frame, rotation centre lens ratio background image model rates
        more_rates noise draw planes);
    assert_eq!((fields, span as usize), (frame.len(), size_of::<Frame>()));
    let (state, _) = offsets(&module, "State");
    let fields = check!(state, State, visible total bands short entries_low entries_high held
        broken_off l1 ssim spare_f);
    assert_eq!(state["cuts"] as usize, size_of::<State>());
    assert_eq!(fields + 1, state.len());
}

const DRAWS: &str = "
    @group(0) @binding(1) var<storage, read_write> drawn: array<vec4<u32>>;
    @compute @workgroup_size(64)
    fn draws(@builtin(global_invocation_id) id: vec3<u32>) {
        let i = id.x;
        drawn[2u * i] = draw_bits(i * 7919u, now.b, now.a, PURPOSE_PLACE, i % 5u);
        let normal = normal3(i * 7919u, now.b, now.a, PURPOSE_PLACE, i % 5u);
        drawn[2u * i + 1u] = bitcast<vec4<u32>>(vec4(normal, 0.0));
    }";

/// What the shader draws. Shape: `[rows, 2 × 4]`, bits and normals.
fn drawn(device: &Opened, rows: u32, now: [u32; 4]) -> Vec<[u32; 8]> {
    let (gpu, text) = (&device.device, [VIEW, RANDOM, DRAWS].concat());
    let module = gpu.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: None,
        source: wgpu::ShaderSource::Wgsl((&text).into()),
    });
    let pipeline = gpu.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: None,
        layout: None,
        module: &module,
        entry_point: Some("draws"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    });
    let size = 32 * u64::from(rows);
    let buffer = |usage| {
        let descriptor =
            wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false };
        gpu.create_buffer(&descriptor)
    };
    let found = buffer(wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC);
    let staging = buffer(wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
    let bindings = gpu.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[wgpu::BindGroupEntry { binding: 1, resource: found.as_entire_binding() }],
    });
    let mut encoder = gpu.create_command_encoder(&Default::default());
    {
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &bindings, &[]);
        pass.set_immediates(0, bytemuck::bytes_of(&now));
        pass.dispatch_workgroups(rows / 64, 1, 1);
    }
    encoder.copy_buffer_to_buffer(&found, 0, &staging, 0, size);
    let bytes = readback::finish(device, &staging, encoder, size);
    bytemuck::pod_collect_to_vec(&bytes.expect("the draws are read"))
}

#[test]
#[expect(clippy::print_stderr, reason = "a skipped test must say so")]
fn draws_are_those_of_the_policies() {
    let device = match Opened::open(&AdapterChoice::default()) {
        Ok(device) => device,
        Err(error) => {
            assert!(std::env::var_os("DENSIFY_REQUIRE_GPU").is_none(), "{error}");
            eprintln!("skipped: {error}");
            return;
        }
    };
    for (seed, step) in [(42, 600), (0, 0), (u64::MAX - 7, 30_000)] {
        let rng = PolicyRng::new(seed, step);
        let now = [folded_seed(seed), step, 0, 0];
        for (i, found) in (0..1024_u32).zip(drawn(&device, 1024, now)) {
            let row = i.wrapping_mul(7919);
            assert_eq!(found[..4], rng.bits(row, Purpose::Place, i % 5), "row {row}");
            let normal = rng.normal3(row, Purpose::Place, i % 5);
            for (found, expected) in found[4..].iter().zip(normal) {
                let found = f32::from_bits(*found);
                assert!((found - expected).abs() < 2e-6, "row {row}: {found} {expected}");
            }
        }
    }
}
