//! Which buffers every kernel works on.

use wgpu::Device;

use super::accumulation::Accumulation;
use super::buffers::{Buffers, FIRST_SH, SECOND_SH, SH, Sizes, WAITING_SH};
use super::pipelines::{Kernel, Launch, Pipelines};
use super::signals::record_stride;

/// What errors are read from: the loss's error per pixel, or its gradient.
const MAPS: [&str; 2] = ["error", "pixel gradient"];

/// All kernels with their buffers. Of pairs, the first reads `keys 0` and `values 0`.
#[derive(Debug)]
pub(super) struct Launches {
    pub(super) project: Launch,
    pub(super) scan_blocks: Launch,
    pub(super) scan_sums: Launch,
    pub(super) compact: Launch,
    pub(super) count_digits: [Launch; 2],
    pub(super) scatter: [Launch; 2],
    pub(super) scatter_order: Launch,
    pub(super) count_entries: Launch,
    pub(super) emit_entries: Launch,
    pub(super) count_tiles: Launch,
    pub(super) cut_bands: Launch,
    pub(super) find_tiles: [Launch; 2],
    pub(super) rasterize: [Launch; 2],
    pub(super) similarity: Launch,
    pub(super) pixel_gradient: Launch,
    pub(super) loss_total: Launch,
    pub(super) rasterize_bwd: [Launch; 2],
    pub(super) project_bwd: Launch,
    pub(super) adam_bands: [Launch; 4],
    pub(super) adam_geometry: Launch,
    pub(super) accumulate: Launch,
    pub(super) measure: Launch,
    pub(super) present: Launch,
    pub(super) surface: [Launch; 2],
    pub(super) count_errors: [Launch; 2],
    pub(super) narrow: Launch,
    pub(super) write_worst: [Launch; 2],
    pub(super) replay: [Launch; 2],
    pub(super) sums: Sums,
}

/// What comes before or after a tile kernel, so that its sums are those of rows.
#[derive(Debug)]
pub(super) enum Sums {
    /// After each band: of the backward pass, and of an auxiliary view.
    Slots { gather: Launch, gather_columns: Launch },
    /// Before the first one, the sums being of so many numbers per row.
    Atomics { clear: Launch, numbers: u32 },
}

impl Launches {
    pub(super) fn new(
        device: &Device,
        pipelines: &Pipelines,
        buffers: &Buffers,
        sizes: &Sizes,
    ) -> Self {
        let bind =
            |kernel, names: &[&'static str]| pipelines.launch(device, buffers, kernel, names);
        let keys = ["keys 0", "keys 1"];
        let values = ["values 0", "values 1"];
        let both = |f: &dyn Fn(usize) -> Launch| [f(0), f(1)];
        let [sh0, sh1, sh2, sh3] = SH;
        let in_slots = sizes.accumulation == Accumulation::Slots;
        let (backward, replay, sums_to) = match in_slots {
            true => (Kernel::RasterizeBwd, Kernel::Replay, "records"),
            false => (Kernel::RasterizeBwdAtomic, Kernel::ReplayAtomic, "row sums"),
        };
        Self {
            project: bind(
                Kernel::Project,
                &["frame", "rows", sh0, sh1, sh2, sh3, "splats", "footprints", "depths"],
            ),
            scan_blocks: bind(
                Kernel::ScanBlocks,
                &["frame", "state", "depths", "sums", "block sums"],
            ),
            scan_sums: bind(Kernel::ScanSums, &["frame", "state", "groups", "block sums"]),
            compact: bind(
                Kernel::Compact,
                &["frame", "depths", "keys 0", "values 0", "sums", "block sums"],
            ),
            count_digits: both(&|i| bind(Kernel::CountDigits, &["state", keys[i], "sums"])),
            scatter: both(&|i| {
                let (keys_to, values_to) = (keys[1 - i], values[1 - i]);
                let names = ["state", keys[i], values[i], keys_to, values_to, "sums", "block sums"];
                bind(Kernel::Scatter, &names)
            }),
            scatter_order: bind(
                Kernel::Scatter,
                &["state", "keys 1", "values 1", "keys 0", "order", "sums", "block sums"],
            ),
            count_entries: bind(
                Kernel::CountEntries,
                &["frame", "state", "footprints", "sums", "order"],
            ),
            emit_entries: bind(
                Kernel::EmitEntries,
                &[
                    "frame",
                    "state",
                    "footprints",
                    "keys 0",
                    "sums",
                    "block sums",
                    "order",
                    "row of slot",
                    "slots of row",
                ],
            ),
            count_tiles: bind(
                Kernel::CountTiles,
                &["frame", "state", "footprints", "order", "tile counts"],
            ),
            cut_bands: bind(Kernel::CutBands, &["frame", "state", "tile counts"]),
            find_tiles: both(&|i| {
                bind(Kernel::FindTiles, &["frame", "state", keys[i], "tile starts"])
            }),
            rasterize: both(&|i| {
                let lists = [values[i], "row of slot", "tile starts"];
                let names = [&["frame", "state"], &lists[..], &["splats", "canvas", "finish"]];
                bind(Kernel::Rasterize, &names.concat())
            }),
            similarity: bind(
                Kernel::Similarity,
                &["frame", "canvas", "truth", "mask", "derivatives", "tile sums", "error"],
            ),
            pixel_gradient: bind(
                Kernel::PixelGradient,
                &["frame", "canvas", "truth", "mask", "derivatives", "pixel gradient"],
            ),
            loss_total: bind(Kernel::LossTotal, &["frame", "state", "tile sums"]),
            rasterize_bwd: both(&|i| {
                let lists = [values[i], "row of slot", "tile starts"];
                let pixels = ["splats", "finish", "pixel gradient", sums_to];
                bind(backward, &[&["frame", "state"], &lists[..], &pixels[..]].concat())
            }),
            project_bwd: bind(
                Kernel::ProjectBwd,
                &["frame", "rows", sh0, sh1, sh2, sh3, "row sums", "depths", "gradient"],
            ),
            adam_bands: std::array::from_fn(|i| {
                let own = [SH[i], FIRST_SH[i], SECOND_SH[i], WAITING_SH[i]];
                bind(
                    Kernel::AdamBand,
                    &[&["frame", "state"], &own[..], &["ages", "gradient", "bias"]].concat(),
                )
            }),
            adam_geometry: bind(
                Kernel::AdamGeometry,
                &[
                    "frame",
                    "state",
                    "rows",
                    "first rows",
                    "second rows",
                    "waiting rows",
                    "ages",
                    "gradient",
                    "bias",
                ],
            ),
            accumulate: bind(
                Kernel::Accumulate,
                &["frame", "state", "signals", "gradient", "row sums", "depths", "splats"],
            ),
            measure: bind(Kernel::Measure, &["frame", "state", "signals", "row sums", "depths"]),
            // The sums of the sorts are a buffer of enough numbers that nobody needs then.
            present: bind(Kernel::Present, &["frame", "sums", "rows", "ages"]),
            // The gradients of the rows are a buffer that nobody needs between two steps.
            surface: both(&|i| {
                let lists = [values[i], "row of slot", "tile starts"];
                let names = ["splats", "rows", "ops", "gradient"];
                bind(Kernel::Surface, &[&["frame", "state"], &lists[..], &names[..]].concat())
            }),
            count_errors: both(&|i| {
                bind(Kernel::CountErrors, &["frame", "finish", MAPS[i], "selection"])
            }),
            narrow: bind(Kernel::Narrow, &["selection", "gradient"]),
            write_worst: both(&|i| {
                let names = ["frame", "finish", MAPS[i], "selection", "gradient"];
                bind(Kernel::WriteWorst, &names)
            }),
            replay: both(&|i| {
                let lists = [values[i], "row of slot", "tile starts"];
                let names = ["splats", "pixel gradient", sums_to];
                bind(replay, &[&["frame", "state"], &lists[..], &names[..]].concat())
            }),
            sums: if in_slots {
                let names = ["frame", "depths", "slots of row", "records", "row sums"];
                Sums::Slots {
                    gather: bind(Kernel::Gather, &names),
                    gather_columns: bind(Kernel::GatherColumns, &names),
                }
            } else {
                Sums::Atomics {
                    clear: bind(Kernel::ClearSums, &["frame", "row sums"]),
                    numbers: record_stride(sizes.detail) as u32,
                }
            },
        }
    }
}
