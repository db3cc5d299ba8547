//! Counts the dispatches of a step, and the bytes of the buffers that they bind, without a device.

use std::collections::{BTreeSet, HashMap};

use densify_policies::policy::{Needs, Signal};
use densify_shaders::{Accumulation, STAGES};
use wgpu::naga::{AddressSpace, StorageAccess};

use super::super::kernels::{kernels, parse};
use super::super::launches::Rebinding;
use super::super::sizes::{SCRATCH, Sizes};
use super::*;

const ROWS: u64 = 1_000_000;
const ENTRIES_IN_MEMORY: u64 = 2 * ROWS;
const IMAGE: (u32, u32) = (1600, 1000);

fn sizes(rows: u64, entries: u64, image: (u32, u32), depth: bool) -> Sizes {
    let signals = [Signal::VisibleCount, Signal::ScreenGradient, Signal::WeightMax];
    let needs = Needs { signals: signals.into_iter().collect(), ..Needs::default() };
    let rows = usize::try_from(rows).expect("64 bits");
    Sizes::new(rows.into(), entries, 3, image, &needs, depth, Accumulation::SubgroupCas)
}

/// Bytes of every buffer and range.
fn bytes(sizes: &Sizes) -> HashMap<&'static str, u64> {
    let buffers = sizes.planned().into_iter().map(|planned| (planned.name, planned.bytes));
    buffers.chain(sizes.ranges().into_iter().map(|range| (range.name, range.bytes))).collect()
}

/// Bytes per row, per entry and per pixel of every buffer and range.
fn rates(depth: bool) -> HashMap<&'static str, [f64; 3]> {
    let base = bytes(&sizes(ROWS, ENTRIES_IN_MEMORY, IMAGE, depth));
    let more = [
        bytes(&sizes(2 * ROWS, ENTRIES_IN_MEMORY, IMAGE, depth)),
        bytes(&sizes(ROWS, ENTRIES_IN_MEMORY + ROWS, IMAGE, depth)),
        bytes(&sizes(ROWS, ENTRIES_IN_MEMORY, (IMAGE.0, 2 * IMAGE.1), depth)),
    ];
    let pixels = f64::from(IMAGE.0 * IMAGE.1);
    let steps = [ROWS as f64, ROWS as f64, pixels];
    let rate = |name, bytes: u64| {
        std::array::from_fn(|i| {
            (more[i].get(name).map_or(0.0, |b| *b as f64) - bytes as f64) / steps[i]
        })
    };
    base.into_iter().map(|(name, bytes)| (name, rate(name, bytes))).collect()
}

/// The buffers of a kernel's launch, and whether the kernel writes them.
struct Bound(Vec<(String, bool)>);

/// A stage's dispatches, the barriers before them, and bytes per row, entry and pixel of the buffers that they bind.
#[derive(Default)]
struct Tally {
    name: &'static str,
    dispatches: u32,
    barriers: u32,
    bytes: [f64; 3],
}

/// Counts dispatches by stage.
struct Counter {
    stages: Vec<Tally>,
    rates: HashMap<&'static str, [f64; 3]>,
    /// The buffers used since the last barrier, and whether they were written.
    used: HashMap<String, bool>,
}

impl Counter {
    fn add(&mut self, launch: &Bound, is_counted: bool) {
        let stage = self.stages.last_mut().expect("a stage has begun");
        stage.dispatches += 1;
        let groups = is_counted.then(|| ("groups".to_owned(), false));
        let accesses = || launch.0.iter().cloned().chain(groups.clone());
        let scratch: BTreeSet<_> =
            sizes(ROWS, ENTRIES_IN_MEMORY, IMAGE, false).ranges().iter().map(|r| r.name).collect();
        // Ranges of the scratch buffer are one buffer to wgpu.
        let buffer =
            |name: String| if scratch.contains(&*name) { SCRATCH.to_owned() } else { name };
        let waits = accesses().any(|(name, writes)| {
            self.used.get(&buffer(name)).is_some_and(|was_written| writes || *was_written)
        });
        if waits {
            stage.barriers += 1;
            self.used.clear();
        }
        for (name, writes) in accesses() {
            *self.used.entry(buffer(name.clone())).or_default() |= writes;
            for (sum, rate) in
                stage.bytes.iter_mut().zip(self.rates.get(&*name).unwrap_or(&[0.0; 3]))
            {
                *sum += rate;
            }
        }
    }
}

impl Record<Bound> for Counter {
    fn stage(&mut self, name: &'static str) {
        if self.stages.last().is_none_or(|stage| stage.name != name) {
            self.stages.push(Tally { name, ..Tally::default() });
        }
    }

    fn run(&mut self, launch: &Bound, _: [u32; 4], groups: u32) {
        if groups > 0 {
            self.add(launch, false);
        }
    }

    fn run_counted(&mut self, launch: &Bound, _: [u32; 4], _: u64) {
        self.add(launch, true);
    }
}

/// The kernels' launches, with the names of their buffers instead of these.
fn launches(sizes: &Sizes) -> Launches<Bound> {
    let mut accesses: HashMap<String, Vec<(String, bool)>> = HashMap::new();
    for stage in STAGES {
        let Some(text) = stage.text(sizes.formats()) else { continue };
        let module = parse(stage, &text);
        let writes = |number| {
            let variable = module.global_variables.iter().find(|(_, v)| {
                v.binding.as_ref().is_some_and(|binding| binding.binding == number)
                    && matches!(v.space, AddressSpace::Storage { access } if access.contains(StorageAccess::STORE))
            });
            variable.is_some()
        };
        for kernel in kernels(stage, &text, &module) {
            let bound = kernel.bindings.into_iter().map(|b| (b.name, writes(b.number)));
            accesses.insert(kernel.entry, bound.collect());
        }
    }
    let bind = |kernel: &str, rebindings: &[Rebinding]| {
        let buffer_of = |variable: &String| {
            let other = rebindings.iter().find(|(name, _)| name == variable);
            other.map_or(variable.clone(), |(_, buffer)| (*buffer).to_owned())
        };
        Bound(accesses[kernel].iter().map(|(name, writes)| (buffer_of(name), *writes)).collect())
    };
    Launches::new(accesses.keys().map(String::as_str), &bind, sizes)
}

/// The dispatches of a step of a large model, with or without depth in the loss.
fn count_step(depth: bool) -> Vec<Tally> {
    let sizes = sizes(ROWS, ENTRIES_IN_MEMORY, IMAGE, depth);
    let launches = launches(&sizes);
    let shape = Shape { rows: ROWS as u32, tiles: 100 * 63, bands: 1 };
    let passes = Passes { launches: &launches, shape };
    let mut counter = Counter { stages: Vec::new(), rates: rates(depth), used: HashMap::new() };
    passes.forward(&mut counter);
    if depth {
        passes.depth_gradient(&mut counter, IMAGE.0 * IMAGE.1, [1.0; 4]);
    }
    passes.loss(&mut counter, false, true);
    passes.backward(&mut counter);
    passes.optimise(&mut counter, 3, [false, true], None);
    counter.stages
}

/// Dispatches, barriers, bytes per row, per entry, per pixel.
fn table(stages: &[Tally]) -> Vec<String> {
    let row = |Tally { name, dispatches, barriers, bytes: [row, entry, pixel] }: &Tally| {
        format!("{name}: {dispatches}, {barriers}, {row:.0}, {entry:.0}, {pixel:.0}")
    };
    stages.iter().map(row).collect()
}

/// What a step of a large model costs the device: this table changes whenever a kernel reads or writes another buffer, or
/// another dispatch is added. It counts whole buffers, of which a kernel may use a part.
#[test]
fn a_step_has_the_known_dispatches_barriers_and_bytes() {
    let stages = count_step(false);
    let expected = [
        "project: 1, 0, 288, 0, 0",
        "sort by depth: 12, 12, 372, 76, 0",
        "tiles: 11, 11, 220, 52, 0",
        "rasterize: 1, 1, 40, 4, 24",
        "loss: 6, 6, 240, 0, 128",
        "rasterize_bwd: 2, 2, 120, 4, 24",
        "project_bwd: 2, 2, 416, 0, 0",
        "adam: 5, 4, 1171, 0, 0",
    ];
    assert_eq!(table(&stages), expected);
    let dispatches: u32 = stages.iter().map(|stage| stage.dispatches).sum();
    assert!(dispatches <= 40, "{dispatches}");
}

/// Depth in the loss adds a stage. The canvas, the transmittances with the channel, and the given depth are read or
/// written once more, and records have another number.
#[test]
fn depth_in_the_loss_costs_two_dispatches() {
    let [without, with] = [false, true].map(|depth| table(&count_step(depth)));
    let added: Vec<_> = with.iter().filter(|row| !without.contains(row)).collect();
    let expected = [
        "rasterize: 1, 1, 40, 4, 32",
        "depth_gradient: 2, 2, 0, 0, 37",
        "loss: 6, 6, 264, 0, 128",
        "rasterize_bwd: 2, 2, 128, 4, 32",
        "project_bwd: 2, 2, 424, 0, 0",
        "adam: 5, 4, 1191, 0, 0",
    ];
    assert_eq!(added, expected);
}
