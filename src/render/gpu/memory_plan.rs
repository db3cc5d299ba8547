//! Memory of a backend, computed from its options before anything is allocated.

use densify_policies::policy::{AuxRequest, Candidate, Needs};

use super::device::Device;
use super::sizes::{MAX_ENTRIES, Sizes};
use crate::Accumulation;
use crate::Setup;
use crate::candidates::Candidates;
use crate::cpu::MAX_SIDE;
use crate::signals::RecordLayout;
use densify_core::memory::{Ledger, Section};

/// Largest number of (row, tile) pairs that this device can hold at a time, for a policy's needs, with or without depth in
/// the loss.
pub(super) fn max_pairs(device: &Device, needs: &Needs, depth: bool) -> u64 {
    // Numbers per pair in the largest buffer that grows with the number of pairs: the records, or else the lists.
    let numbers = match device.accumulation {
        Accumulation::Slots => RecordLayout::new(needs.signals, depth).stride() as u64,
        Accumulation::SubgroupCas | Accumulation::SubgroupAtomics => 1,
    };
    let by_binding = device.largest_binding() / (4 * numbers);
    // Three lists are sorted in one buffer, each at an aligned place, and with them as many sums of entries per row, or
    // of digits per block, as there are pairs at most: there are no more rows than pairs.
    let by_buffer = (device.summary.largest_buffer / 4).saturating_sub(2 * 256) / 4;
    by_binding.min(by_buffer).min(MAX_ENTRIES)
}

/// Sizes of all buffers.
pub(super) fn sizes(device: &Device, sh_degree: u8, options: &Setup) -> Sizes {
    let budget = options.row_budget();
    let rows = budget.total as u64;
    let cap = match options.tile_cap {
        Some(cap) => cap as u64,
        None => (16 * rows).min(max_pairs(device, &options.needs, options.depth)),
    };
    let (width, height) = options.largest_image;
    let image = (width.clamp(1, MAX_SIDE), height.clamp(1, MAX_SIDE));
    // An adapter supports fewer rows than MAX_ENTRIES.
    let cap = cap.min(MAX_ENTRIES).max(rows);
    let (needs, depth) = (&options.needs, options.depth);
    let mut sizes = Sizes::new(budget, cap, sh_degree, image, needs, depth, device.accumulation);
    sizes.photographs = options.photographs;
    sizes.exposures = options.exposures || options.vignettes;
    sizes.vignettes = options.vignettes;
    sizes.poses = options.poses;
    sizes.storage = options.storage;
    // The photographs are in one buffer, which no kernel binds.
    let bytes = sizes.photograph_bytes().iter().sum::<u64>();
    let max = usize::try_from(device.summary.largest_buffer / bytes).unwrap_or(usize::MAX);
    sizes.photographs.count = sizes.photographs.count.min(max);
    sizes
}

/// The ledger of a backend: its memory on the device and on the host.
pub(super) fn ledger(sizes: &Sizes, needs: &Needs) -> Ledger {
    let mut ledger = sizes.ledger();
    let pixels = u64::from(sizes.image.0) * u64::from(sizes.image.1);
    let candidates = Candidates::bytes(needs.candidates, pixels as usize);
    ledger.add_to(Section::Policy, "candidates", candidates);
    if sizes.with_edges {
        // Luma, edges and their weights.
        ledger.add_to(Section::Policy, "edges of a photograph", 6 * pixels);
    }
    if sizes.depth {
        ledger.add_to(Section::Images, "given depth to upload", 4 * pixels);
    }
    if let Some(request) = &needs.aux {
        let bytes = aux_bytes(request, pixels);
        ledger.add_to(Section::Policy, "auxiliary views", bytes);
    }
    ledger
}

/// Memory on the host while an auxiliary view of this number of pixels is measured `[bytes]`.
fn aux_bytes(request: &AuxRequest, pixels: u64) -> u64 {
    let sampling = if request.points > 0 { 20 } else { 0 };
    // The copied image, its map, error, edges and luma.
    pixels * (20 + 24 + 13 + sampling) + u64::from(request.points) * size_of::<Candidate>() as u64
}
