//! Every dispatch of a kernel with the buffers that it works on.
//!
//! A kernel's variable is bound to the buffer of its own name. Where one kernel works on several
//! buffers, or on one that is only borrowed, the pairs here say which.

use std::collections::HashMap;

use wgpu::{BindGroup, BindGroupDescriptor, BindGroupEntry, ComputePipeline, Device};

use super::buffers::Buffers;
use super::pipelines::{Compiled, Pipelines};
use super::rows::{Edited, FIRST, PARAMETERS, RowArray, SECOND, WAITING};
use super::sizes::Sizes;
use crate::{Accumulation, NumberKind};

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

/// All dispatches.
#[derive(Debug)]
pub(super) struct Launches<L = Launch> {
    /// By kernel: one, or as many as [`rebound`] has. Of kernels that differ by how a device adds up,
    /// a device has one, whose name here is without `_atomic`.
    by_kernel: HashMap<String, Vec<L>>,
    /// Numbers of a record, whose sums atomics add to.
    pub(super) record: u32,
    /// Whether the device adds up in slots: it gathers, and has no sums to clear.
    pub(super) in_slots: bool,
    /// Whether pixels are counted for the row that dominates them.
    pub(super) counts_dominant: bool,
    /// Copies or clears rows, for every array that an edit touches.
    pub(super) copy_rows: Vec<RowLaunch<L>>,
    /// Exchanges rows, for the same arrays.
    pub(super) swap_rows: Vec<RowLaunch<L>>,
    pub(super) audits: Vec<Audit<L>>,
}

/// A kernel for one array of rows: the first row that it has, how many numbers a row has, how far apart rows are,
/// and a row's numbers.
#[derive(Debug)]
pub(super) struct RowLaunch<L> {
    pub(super) launch: L,
    pub(super) edited: Edited,
    pub(super) first_row: u32,
    /// The first of the parameters that the numbers belong to; 0 where they belong to none.
    pub(super) first_parameter: usize,
    pub(super) numbers: u32,
    pub(super) pitch: [u32; 2],
}

/// The audit of one array: the first row that it has, how many numbers a row has, and the place of the first of them.
#[derive(Debug)]
pub(super) struct Audit<L> {
    pub(super) launch: L,
    pub(super) first_row: u32,
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
        let bind = |kernel: &str, instead: &[Instead]| {
            launch(device, pipelines.get(kernel), buffers, instead)
        };
        Self::new(pipelines.names(), &bind, sizes)
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

/// What binds a kernel.
type Bind<'a, L> = &'a dyn Fn(&str, &[Instead]) -> L;

impl<L> Launches<L> {
    /// Binds each kernel by name, and those of [`rebound`] to the buffers that it has for them.
    pub(super) fn new<'k>(
        kernels: impl Iterator<Item = &'k str>,
        bind: Bind<'_, L>,
        sizes: &Sizes,
    ) -> Self {
        let rebound = rebound();
        let launches = |kernel: &str| match rebound.get(plain(kernel)) {
            None => vec![bind(kernel, &[])],
            Some(several) => several.iter().map(|instead| bind(kernel, instead)).collect(),
        };
        let of_array = |kernel: &&str| !["copy_rows", "swap_rows", "audit"].contains(kernel);
        Self {
            by_kernel: kernels
                .filter(of_array)
                .map(|k| (plain(k).to_owned(), launches(k)))
                .collect(),
            record: sizes.records.stride() as u32,
            in_slots: sizes.accumulation == Accumulation::Slots,
            counts_dominant: sizes.dominant,
            copy_rows: of_rows("copy_rows", bind, sizes),
            swap_rows: of_rows("swap_rows", bind, sizes),
            audits: audits(bind, sizes),
        }
    }

    /// The dispatch of a kernel with this number.
    ///
    /// # Panics
    /// When the device does not have it: a bug in the caller.
    pub(super) fn nth(&self, kernel: &str, number: usize) -> &L {
        let found = self.by_kernel.get(kernel).and_then(|launches| launches.get(number));
        found.unwrap_or_else(|| panic!("this device has no launch {number} of `{kernel}`"))
    }

    /// The first dispatch of a kernel.
    ///
    /// # Panics
    /// As [`nth`](Self::nth).
    pub(super) fn get(&self, kernel: &str) -> &L {
        self.nth(kernel, 0)
    }
}

/// A kernel's name without the way of adding up.
pub(super) fn plain(kernel: &str) -> &str {
    kernel.strip_suffix("_atomic").unwrap_or(kernel)
}

/// The dispatches of the kernels whose variables are not all bound to buffers of their names: for each,
/// the variables that are bound to others. Of pairs, the first reads `keys 0` and `values 0`.
pub(super) fn rebound() -> HashMap<&'static str, Vec<Vec<Instead>>> {
    let both = |instead: &dyn Fn(usize) -> Vec<Instead>| vec![instead(0), instead(1)];
    let list = |i: usize| ("list", VALUES[i]);
    let scatter = |i: usize, values_to| {
        let from = [("keys in", KEYS[i]), ("values in", VALUES[i])];
        [&from[..], &[("keys out", KEYS[1 - i]), ("values out", values_to)]].concat()
    };
    let adam = |part: usize| {
        let moments = [("first", FIRST[part]), ("second", SECOND[part])];
        [&[("params", PARAMETERS[part]), ("waiting", WAITING[part])], &moments[..]].concat()
    };
    let keys_in = both(&|i| vec![("keys in", KEYS[i])]);
    HashMap::from([
        ("compact", vec![vec![("keys out", KEYS[0]), ("values out", VALUES[0])]]),
        ("count_digits", keys_in.clone()),
        ("find_tiles", keys_in),
        // The last writes the order of rows.
        ("scatter", vec![scatter(0, VALUES[1]), scatter(1, VALUES[0]), scatter(1, "order")]),
        ("emit_entries", vec![vec![("keys out", KEYS[0])]]),
        ("rasterize", both(&|i| vec![list(i)])),
        ("rasterize_bwd", both(&|i| vec![list(i)])),
        ("similarity", vec![vec![("gradient", "pixel gradient")]]),
        ("pixel_gradient", vec![vec![("gradient", "pixel gradient")]]),
        ("expose_bwd", vec![vec![("gradient", "pixel gradient")]]),
        ("adam_band", (0..4).map(|band| adam(1 + band)).collect()),
        ("adam_geometry", vec![adam(0)]),
        // Borrows the sums of the sorts, which are not needed then and are long enough.
        ("present", vec![vec![("signals", "sums")]]),
        // Borrows the gradients of the rows, which are not needed between two steps.
        ("surface", both(&|i| vec![list(i), ("pixels", "ops"), ("points", "gradient")])),
        ("count_errors", both(&|i| vec![("map", MAPS[i])])),
        ("narrow", vec![vec![("worst", "gradient")]]),
        ("write_worst", both(&|i| vec![("map", MAPS[i]), ("worst", "gradient")])),
        ("replay", both(&|i| vec![list(i), ("map", "pixel gradient")])),
        ("gather", vec![vec![("all records", "records")]]),
        ("gather_columns", vec![vec![("all records", "records")]]),
    ])
}

/// One dispatch of a kernel for each array that an edit touches.
fn of_rows<L>(kernel: &str, bind: Bind<'_, L>, sizes: &Sizes) -> Vec<RowLaunch<L>> {
    let launch = |array: &RowArray| {
        let [first_row, rows] = sizes.places(array);
        RowLaunch {
            launch: bind(kernel, &[("buffer", array.name)]),
            edited: array.holds.traits().edited,
            first_row: first_row as u32,
            first_parameter: array.parameters.start,
            numbers: array.numbers as u32,
            pitch: array.pitch(rows),
        }
    };
    let arrays = sizes.row_arrays();
    let edited = arrays.iter().filter(|array| array.holds.traits().edited != Edited::Untouched);
    edited.map(launch).collect()
}

/// The marks borrow the sums of the sorts, which are not needed between two steps.
fn audits<L>(bind: Bind<'_, L>, sizes: &Sizes) -> Vec<Audit<L>> {
    let arrays = sizes.row_arrays();
    let audit = |array: &RowArray| {
        let first = array.parameters.start as u32;
        Some(Audit {
            launch: bind("audit", &[("marks", "sums"), ("numbers", array.name)]),
            first_row: sizes.places(array)[0] as u32,
            numbers: array.numbers as u32,
            place: match array.holds.traits().audited? {
                NumberKind::Parameter => first,
                NumberKind::Moment => MOMENTS + first,
            },
        })
    };
    arrays.iter().filter_map(audit).collect()
}
