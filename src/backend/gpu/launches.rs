//! Every dispatch of a kernel with the buffers that it works on.
//!
//! A kernel's variable is bound to the buffer of its own name. Where one kernel works on several
//! buffers, or on one that is only borrowed, the pairs here say which.

use wgpu::{BindGroup, BindGroupDescriptor, BindGroupEntry, ComputePipeline, Device};

use super::accumulation::Accumulation;
use super::buffers::Buffers;
use super::pipelines::{Compiled, Pipelines};
use super::rows::{Edited, FIRST, PARAMETERS, RowArray, SECOND, WAITING};
use super::sizes::Sizes;
use crate::backend::Kept;

/// What errors are read from: the loss's error per pixel, or its gradient.
const MAPS: [&str; 2] = ["error", "pixel gradient"];
const KEYS: [&str; 2] = ["keys 0", "keys 1"];
const VALUES: [&str; 2] = ["values 0", "values 1"];

/// A kernel's variable, and the buffer bound to it.
pub(super) type Instead = (&'static str, &'static str);

/// A kernel with its buffers.
#[derive(Debug)]
pub(super) struct Launch {
    pub(super) pipeline: ComputePipeline,
    pub(super) bindings: BindGroup,
}

/// All dispatches. Of pairs, the first reads `keys 0` and `values 0`.
#[derive(Debug)]
pub(super) struct Launches<L = Launch> {
    pub(super) project: L,
    pub(super) scan_blocks: L,
    pub(super) scan_sums: L,
    pub(super) compact: L,
    pub(super) count_digits: [L; 2],
    pub(super) scatter: [L; 2],
    pub(super) scatter_order: L,
    pub(super) count_entries: L,
    pub(super) emit_entries: L,
    pub(super) count_tiles: L,
    pub(super) cut_bands: L,
    pub(super) find_tiles: [L; 2],
    pub(super) rasterize: [L; 2],
    pub(super) similarity: L,
    pub(super) pixel_gradient: L,
    pub(super) loss_total: L,
    pub(super) rasterize_bwd: [L; 2],
    pub(super) project_bwd: L,
    pub(super) adam_bands: [L; 4],
    pub(super) adam_geometry: L,
    pub(super) accumulate: L,
    pub(super) measure: L,
    pub(super) present: L,
    pub(super) surface: [L; 2],
    pub(super) count_errors: [L; 2],
    pub(super) narrow: L,
    pub(super) write_worst: [L; 2],
    pub(super) replay: [L; 2],
    pub(super) sums: Sums<L>,
    /// Copies or clears rows, for every array that an edit touches.
    pub(super) copy_rows: Vec<RowLaunch<L>>,
    pub(super) breed: L,
    pub(super) rewrite: L,
    pub(super) sow: L,
    pub(super) clamp_opacity: L,
    pub(super) audits: Vec<Audit<L>>,
}

/// What comes before or after a tile kernel, so that its sums are those of rows.
#[derive(Debug)]
pub(super) enum Sums<L> {
    /// After each band: of the backward pass, and of an auxiliary view.
    Slots { gather: L, gather_columns: L },
    /// Before the first one, the sums being of so many numbers per row.
    Atomics { clear: L, numbers: u32 },
}

/// A kernel for one array of rows: how many numbers a row has, how far apart rows are, and a row's
/// numbers.
#[derive(Debug)]
pub(super) struct RowLaunch<L> {
    pub(super) launch: L,
    pub(super) edited: Edited,
    pub(super) numbers: u32,
    pub(super) pitch: [u32; 2],
}

/// The audit of one array: how many numbers a row has, and the place of the first of them.
#[derive(Debug)]
pub(super) struct Audit<L> {
    pub(super) launch: L,
    pub(super) numbers: u32,
    pub(super) place: u32,
}

/// From a parameter's place to that of its moments; no row has as many parameters.
pub(super) const MOMENTS: u32 = 64;

impl Launches {
    /// All dispatches on these buffers.
    pub(super) fn bound(
        device: &Device,
        pipelines: &Pipelines,
        buffers: &Buffers,
        sizes: &Sizes,
    ) -> Self {
        Self::new(&|kernel, instead| launch(device, pipelines.get(kernel), buffers, instead), sizes)
    }
}

fn launch(device: &Device, kernel: &Compiled, buffers: &Buffers, instead: &[Instead]) -> Launch {
    let entries: Vec<_> = kernel
        .bindings
        .iter()
        .map(|binding| {
            let other = instead.iter().find(|(variable, _)| *variable == binding.name);
            let name = other.map_or(&*binding.name, |(_, buffer)| buffer);
            BindGroupEntry {
                binding: binding.number,
                resource: buffers.get(name).as_entire_binding(),
            }
        })
        .collect();
    let bindings = device.create_bind_group(&BindGroupDescriptor {
        label: None,
        layout: &kernel.pipeline.get_bind_group_layout(0),
        entries: &entries,
    });
    Launch { pipeline: kernel.pipeline.clone(), bindings }
}

impl<L> Launches<L> {
    /// Binds each kernel by name, with the buffers that are not those of its variables' names.
    pub(super) fn new(bind: &dyn Fn(&'static str, &[Instead]) -> L, sizes: &Sizes) -> Self {
        let both = |kernel, instead: &dyn Fn(usize) -> Vec<Instead>| {
            [bind(kernel, &instead(0)), bind(kernel, &instead(1))]
        };
        let list = |i: usize| vec![("list", VALUES[i])];
        let in_slots = sizes.accumulation == Accumulation::Slots;
        let scatter = |i: usize, values_to| {
            let from = [("keys in", KEYS[i]), ("values in", VALUES[i])];
            [&from[..], &[("keys out", KEYS[1 - i]), ("values out", values_to)]].concat()
        };
        let replay = if in_slots { "replay" } else { "replay_atomic" };
        let adam = |part: usize| {
            let moments = [("first", FIRST[part]), ("second", SECOND[part])];
            [&[("params", PARAMETERS[part]), ("waiting", WAITING[part])], &moments[..]].concat()
        };
        let row_launch = |array: &RowArray| RowLaunch {
            launch: bind("copy_rows", &[("buffer", array.name)]),
            edited: array.holds.traits().edited,
            numbers: array.numbers as u32,
            pitch: array.pitch(sizes.budget),
        };
        let mut edited = sizes.row_arrays();
        edited.retain(|array| array.holds.traits().edited != Edited::Untouched);
        Self {
            project: bind("project", &[]),
            scan_blocks: bind("scan_blocks", &[]),
            scan_sums: bind("scan_sums", &[]),
            compact: bind("compact", &[("keys out", KEYS[0]), ("values out", VALUES[0])]),
            count_digits: both("count_digits", &|i| vec![("keys in", KEYS[i])]),
            scatter: both("scatter", &|i| scatter(i, VALUES[1 - i])),
            scatter_order: bind("scatter", &scatter(1, "order")),
            count_entries: bind("count_entries", &[]),
            emit_entries: bind("emit_entries", &[("keys out", KEYS[0])]),
            count_tiles: bind("count_tiles", &[]),
            cut_bands: bind("cut_bands", &[]),
            find_tiles: both("find_tiles", &|i| vec![("keys in", KEYS[i])]),
            rasterize: both("rasterize", &list),
            similarity: bind("similarity", &[]),
            pixel_gradient: bind("pixel_gradient", &[("gradient", "pixel gradient")]),
            loss_total: bind("total", &[]),
            rasterize_bwd: match in_slots {
                true => both("rasterize_bwd", &list),
                false => both("rasterize_bwd_atomic", &list),
            },
            project_bwd: bind("project_bwd", &[]),
            adam_bands: std::array::from_fn(|band| bind("adam_band", &adam(1 + band))),
            adam_geometry: bind("adam_geometry", &adam(0)),
            accumulate: bind("accumulate", &[]),
            measure: bind("measure", &[]),
            // Borrows the sums of the sorts, which are not needed then and are long enough.
            present: bind("present", &[("signals", "sums")]),
            // Borrows the gradients of the rows, which are not needed between two steps.
            surface: both("surface", &|i| {
                [list(i), vec![("pixels", "ops"), ("points", "gradient")]].concat()
            }),
            count_errors: both("count_errors", &|i| vec![("map", MAPS[i])]),
            narrow: bind("narrow", &[("worst", "gradient")]),
            write_worst: both("write_worst", &|i| vec![("map", MAPS[i]), ("worst", "gradient")]),
            replay: both(replay, &|i| [list(i), vec![("map", "pixel gradient")]].concat()),
            sums: match in_slots {
                true => Sums::Slots {
                    gather: bind("gather", &[("all records", "records")]),
                    gather_columns: bind("gather_columns", &[("all records", "records")]),
                },
                false => Sums::Atomics {
                    clear: bind("clear_sums", &[]),
                    numbers: sizes.records.stride() as u32,
                },
            },
            copy_rows: edited.iter().map(row_launch).collect(),
            breed: bind("breed", &[]),
            rewrite: bind("rewrite", &[]),
            sow: bind("sow", &[]),
            clamp_opacity: bind("clamp_opacity", &[]),
            audits: audits(bind, sizes),
        }
    }
}

/// The marks borrow the sums of the sorts, which are not needed between two steps.
fn audits<L>(bind: &dyn Fn(&'static str, &[Instead]) -> L, sizes: &Sizes) -> Vec<Audit<L>> {
    let arrays = sizes.row_arrays();
    let audit = |array: &RowArray| {
        let first = array.parameters.start as u32;
        Some(Audit {
            launch: bind("audit", &[("marks", "sums"), ("numbers", array.name)]),
            numbers: array.numbers as u32,
            place: match array.holds.traits().audited? {
                Kept::Parameter => first,
                Kept::Moment => MOMENTS + first,
            },
        })
    };
    arrays.iter().filter_map(audit).collect()
}
