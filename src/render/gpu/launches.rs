//! The kernels with their bound buffers, ready to dispatch.
//!
//! A kernel's variable is bound to the buffer of the same name. [`rebound`] lists the exceptions: kernels that
//! work on several buffers in turn, or that borrow a buffer with another purpose.

use std::collections::HashMap;

use wgpu::{BindGroup, BindGroupDescriptor, BindGroupEntry, ComputePipeline, Device};

use super::buffers::Buffers;
use super::pipelines::{CompiledKernel, Pipelines};
use super::rows::{Content, Edited, FIRST, MOMENTS, PARAMETERS, RowArray, SECOND, WAITING};
use super::sizes::Sizes;
use crate::{Accumulation, NumberKind};

/// Sources of the error per pixel: the loss's error, or its gradient.
const ERROR_MAPS: [&str; 2] = ["error", "canvas"];
const KEYS: [&str; 2] = ["keys 0", "keys 1"];
/// The sorted values end in the first, the lists.
const VALUES: [&str; 2] = ["list", "values"];

/// A kernel's variable and the buffer bound to it.
pub(super) type Rebinding = (&'static str, &'static str);

/// A kernel with its bound buffers.
#[derive(Debug)]
pub(super) struct Launch {
    pub(super) pipeline: ComputePipeline,
    pub(super) bindings: BindGroup,
}

/// All kernels of a backend, with their buffers.
#[derive(Debug)]
pub(super) struct Launches<L = Launch> {
    /// The launches of each kernel: one, or as many as in [`rebound`]. Keys are [base names](base_name).
    by_kernel: HashMap<String, Vec<L>>,
    /// Numbers per record.
    pub(super) record: u32,
    /// True if gradients are accumulated in slots: they are then gathered from there, and the sums need no clearing.
    pub(super) in_slots: bool,
    /// True if the pixels that each row dominates are counted.
    pub(super) counts_dominant: bool,
    /// `copy_rows`, which copies or clears rows, for every array that edits change.
    pub(super) copy_rows: Vec<RowLaunch<L>>,
    /// `swap_rows` for the same arrays.
    pub(super) swap_rows: Vec<RowLaunch<L>>,
    /// `audit` for every audited array.
    pub(super) audits: Vec<Audit<L>>,
}

/// A kernel bound to an array of rows.
#[derive(Debug)]
pub(super) struct RowLaunch<L> {
    pub(super) launch: L,
    pub(super) edited: Edited,
    /// First row that is stored in the array.
    pub(super) first_row: u32,
    /// First parameter that the numbers belong to; 0 if they belong to none.
    pub(super) first_parameter: usize,
    /// Numbers per row.
    pub(super) numbers: u32,
    /// Distance between rows, and between the numbers of a row.
    pub(super) pitch: [u32; 2],
}

/// The audit of one array.
#[derive(Debug)]
pub(super) struct Audit<L> {
    pub(super) launch: L,
    /// First row that is stored in the array.
    pub(super) first_row: u32,
    /// Numbers per row.
    pub(super) numbers: u32,
    /// A row whose number i is the first that is not finite is marked with `mark` + i + 1. `mark` is the index of the
    /// array's first parameter, plus [`MOMENT_MARKS`] for moments.
    pub(super) mark: u32,
}

/// Offset from a parameter's mark to that of its moments; larger than the number of parameters of a row.
pub(super) const MOMENT_MARKS: u32 = 64;

impl Launches {
    /// Binds all kernels to the buffers.
    pub(super) fn bind(
        device: &Device,
        pipelines: &Pipelines,
        buffers: &Buffers,
        sizes: &Sizes,
    ) -> Self {
        let bind = |kernel: &str, rebindings: &[Rebinding]| {
            launch(device, pipelines.get(kernel), buffers, rebindings)
        };
        Self::new(pipelines.names(), &bind, sizes)
    }
}

fn launch(
    device: &Device,
    kernel: &CompiledKernel,
    buffers: &Buffers,
    rebindings: &[Rebinding],
) -> Launch {
    let entries: Vec<_> = kernel
        .bindings
        .iter()
        .map(|binding| {
            let other = rebindings.iter().find(|(variable, _)| *variable == binding.name);
            let name = other.map_or(&*binding.name, |(_, buffer)| buffer);
            BindGroupEntry { binding: binding.number, resource: buffers.binding(name) }
        })
        .collect();
    let bindings = device.create_bind_group(&BindGroupDescriptor {
        label: None,
        layout: &kernel.pipeline.get_bind_group_layout(0),
        entries: &entries,
    });
    Launch { pipeline: kernel.pipeline.clone(), bindings }
}

/// Binds a kernel, with exceptions to the names of its variables.
type Bind<'a, L> = &'a dyn Fn(&str, &[Rebinding]) -> L;

impl<L> Launches<L> {
    /// Binds each kernel by the names of its variables, and each kernel in [`rebound`] once per list of exceptions.
    pub(super) fn new<'k>(
        kernels: impl Iterator<Item = &'k str>,
        bind: Bind<'_, L>,
        sizes: &Sizes,
    ) -> Self {
        let rebound = rebound(sizes);
        let launches = |kernel: &str| match rebound.get(base_name(kernel)) {
            None => vec![bind(kernel, &[])],
            Some(lists) => lists.iter().map(|rebindings| bind(kernel, rebindings)).collect(),
        };
        let of_rows = ["copy_rows", "swap_rows", "audit", "audit_bytes", "audit_halves"];
        let is_single = |kernel: &&str| !of_rows.contains(kernel);
        Self {
            by_kernel: kernels
                .filter(is_single)
                .map(|k| (base_name(k).to_owned(), launches(k)))
                .collect(),
            record: sizes.records.stride() as u32,
            in_slots: sizes.accumulation == Accumulation::Slots,
            counts_dominant: sizes.counts_dominant,
            copy_rows: row_launches("copy_rows", bind, sizes),
            swap_rows: row_launches("swap_rows", bind, sizes),
            audits: audits(bind, sizes),
        }
    }

    /// Launch `number` of a kernel.
    ///
    /// # Panics
    /// When there is none: a bug in the caller.
    pub(super) fn nth(&self, kernel: &str, number: usize) -> &L {
        let found = self.by_kernel.get(kernel).and_then(|launches| launches.get(number));
        found.unwrap_or_else(|| panic!("this device has no launch {number} of `{kernel}`"))
    }

    /// The first launch of a kernel.
    ///
    /// # Panics
    /// As [`nth`](Self::nth).
    pub(super) fn get(&self, kernel: &str) -> &L {
        self.nth(kernel, 0)
    }
}

/// A kernel's name without `_atomic`, which distinguishes two versions of a kernel that accumulate gradients in
/// different ways. A device has only one of them.
pub(super) fn base_name(kernel: &str) -> &str {
    kernel.strip_suffix("_atomic").unwrap_or(kernel)
}

/// The kernels with variables that are bound to buffers of other names, with the exceptions of each launch. Of two
/// launches, the first reads `keys 0` or writes the lists.
pub(super) fn rebound(sizes: &Sizes) -> HashMap<&'static str, Vec<Vec<Rebinding>>> {
    let formats = sizes.formats();
    let two = |rebindings: &dyn Fn(usize) -> Vec<Rebinding>| vec![rebindings(0), rebindings(1)];
    let scatter = |keys: usize, values: usize, values_to| {
        let from = [("keys in", KEYS[keys]), ("values in", VALUES[values])];
        [&from[..], &[("keys out", KEYS[1 - keys]), ("values out", values_to)]].concat()
    };
    let emitted = |i: usize| match formats.accumulation {
        Accumulation::Slots => "row of slot",
        _ => VALUES[i],
    };
    let moments = |part: usize| {
        if formats.moments_in_bytes {
            vec![("moments", MOMENTS[part])]
        } else {
            vec![("first", FIRST[part]), ("second", SECOND[part])]
        }
    };
    let adam = |part: usize| {
        let params = (part > 0).then_some(("params", PARAMETERS[part]));
        let others = [("waiting", WAITING[part])].into_iter().chain(params);
        others.chain(moments(part)).collect()
    };
    // Without and with an exposure.
    let derivatives = ("derivatives", sizes.derivatives());
    let images = vec![vec![derivatives], vec![derivatives, ("canvas", "exposed")]];
    // Borrows the sums of the loss, which has not begun.
    let depth_sums = vec![vec![("depth sums", "tile sums")]];
    let keys_in = two(&|i| vec![("keys in", KEYS[i])]);
    HashMap::from([
        ("count_digits", keys_in.clone()),
        ("find_tiles", keys_in),
        // The first four by the numbers of their keys and values; the fifth writes the order of rows.
        (
            "scatter",
            vec![
                scatter(0, 0, VALUES[1]),
                scatter(0, 1, VALUES[0]),
                scatter(1, 0, VALUES[1]),
                scatter(1, 1, VALUES[0]),
                scatter(1, 1, "order"),
            ],
        ),
        ("emit_entries", two(&|i| vec![("keys out", KEYS[0]), ("values out", emitted(i))])),
        ("similarity", images.clone()),
        ("pixel_gradient", images),
        ("depth_gradient", depth_sums.clone()),
        ("total_depth", depth_sums),
        ("rasterize_bwd", vec![vec![("pixel gradient", sizes.pixel_gradient())]]),
        ("adam_band", (0..4).map(|band| adam(1 + band)).collect()),
        ("adam_geometry", vec![adam(0)]),
        ("clamp_opacity", vec![moments(0)]),
        // Borrows the buffer of prefix sums, which is long enough and unused between two steps.
        ("present", vec![vec![("signals", "sums")]]),
        // Borrows the sums of the rows, which are unused before the backward pass.
        ("surface", vec![vec![("pixels", "ops"), ("points", "row sums")]]),
        // The second quarter of the canvas, which the host has read.
        ("find_front", vec![vec![("depths", "canvas")]]),
        ("count_errors", two(&|i| vec![("map", ERROR_MAPS[i])])),
        ("write_worst", two(&|i| vec![("map", ERROR_MAPS[i])])),
        // Borrows the canvas, which the host has read.
        ("replay", vec![vec![("map", "canvas")]]),
        ("gather", vec![vec![("all records", "records")]]),
        ("gather_columns", vec![vec![("all records", "records")]]),
    ])
}

/// One launch of a kernel for each array that edits change.
fn row_launches<L>(kernel: &str, bind: Bind<'_, L>, sizes: &Sizes) -> Vec<RowLaunch<L>> {
    let launch = |array: &RowArray| {
        let [first_row, rows] = sizes.row_range(array);
        RowLaunch {
            launch: bind(kernel, &[("buffer", array.name)]),
            edited: array.content.traits().edited,
            first_row: first_row as u32,
            first_parameter: array.parameters.start,
            numbers: array.numbers as u32,
            pitch: array.pitch(rows),
        }
    };
    let arrays = sizes.row_arrays();
    let edited = arrays.iter().filter(|array| array.content.traits().edited != Edited::Untouched);
    edited.map(launch).collect()
}

/// The launches of `audit`. The marks borrow the buffer of prefix sums, which is unused between two steps.
fn audits<L>(bind: Bind<'_, L>, sizes: &Sizes) -> Vec<Audit<L>> {
    let arrays = sizes.row_arrays();
    let audit = |array: &RowArray| {
        let first = array.parameters.start as u32;
        let kernel = match array.content {
            Content::NarrowMoments => "audit_bytes",
            _ if array.is_narrow => "audit_halves",
            _ => "audit",
        };
        Some(Audit {
            launch: bind(kernel, &[("marks", "sums"), ("numbers", array.name)]),
            first_row: sizes.row_range(array)[0] as u32,
            numbers: array.numbers as u32,
            mark: match array.content.traits().audited? {
                NumberKind::Parameter => first,
                NumberKind::Moment => MOMENT_MARKS + first,
            },
        })
    };
    arrays.iter().filter_map(audit).collect()
}
