//! Sizes of all buffers, known before the first is allocated. The ledger lists them.

use densify_policies::policy::{Cadence, ErrorMode, Needs, PixelLoss};
use wgpu::BufferUsages;

use super::frame::{Frame, State, grid};
use super::rows::{Content, Narrow, RowArray, row_arrays};
use super::{exposure, pose, vignette};
use crate::Accumulation;
use crate::cpu::BiasCorrection;
use crate::signals::{Field, RecordLayout, SignalPlanes, counts_dominant};
use crate::{KeptPhotographs, MomentStorage, ParameterStorage, Storage};
use densify_core::budget::RowBudget;
use densify_core::memory::{Ledger, Section};
use densify_shaders::Formats;

/// Number of bytes of an edit's operations that are uploaded at a time.
pub(super) const OPS_BYTES: u64 = 1 << 18;
/// Size of the allocator's blocks, in which it places smaller buffers together `[bytes]`; the smallest that wgpu's
/// allocators have.
pub(super) const ALLOCATOR_BLOCK: u64 = 4 << 20;
/// Largest number of bytes that are on their way to the device at a time.
pub(super) const UPLOAD_BYTES: u64 = 1 << 20;
/// Largest number of bytes read back at a time.
pub(super) const READ_BYTES: u64 = 1 << 20;
/// Items per workgroup of the prefix sums, and of the sorts; see `shaders/tiles.wgsl`.
pub(super) const BLOCK: u64 = 2048;
pub(super) const SORTED: u64 = 1024;
/// Number of values of a digit of the sorts.
const DIGITS: u64 = 256;
/// Largest number of (row, tile) pairs in the tile lists at a time; prefix sums saturate beyond it.
pub(super) const MAX_ENTRIES: u64 = 1 << 28;

/// The smallest buffer that is [rounded](rounded) to a power of two `[bytes]`.
const SMALLEST_ROUNDED: u64 = 64 << 10;

/// The size of a buffer. Sizes that are powers of two, allocated largest first, fill the allocator's blocks completely;
/// others could leave nearly half of each block unused. Larger buffers have memory of their own.
fn rounded(bytes: u64) -> u64 {
    if (SMALLEST_ROUNDED..ALLOCATOR_BLOCK).contains(&bytes) {
        bytes.next_power_of_two()
    } else {
        bytes.next_multiple_of(16)
    }
}

/// The quantities that determine all sizes.
#[derive(Debug, Clone)]
pub(super) struct Sizes {
    pub(super) budget: RowBudget,
    /// Largest number of (row, tile) pairs in memory at a time.
    pub(super) cap: u64,
    pub(super) sh_degree: u8,
    /// Largest image, width and height `[px]`.
    pub(super) image: (u32, u32),
    pub(super) photographs: KeptPhotographs,
    /// Number of planes of the signals.
    pub(super) planes: usize,
    /// Layout of the records and their sums.
    pub(super) records: RecordLayout,
    /// How gradients are accumulated; only [`Accumulation::Slots`] needs records.
    pub(super) accumulation: Accumulation,
    pub(super) storage: Storage,
    /// True if gradients of alpha and depth are computed too.
    pub(super) alpha_and_depth: bool,
    pub(super) cadence: Cadence,
    /// True if the pixels that each row dominates are counted.
    pub(super) counts_dominant: bool,
    /// Pixel term of the loss.
    pub(super) pixel_loss: PixelLoss,
    /// True if rows have masks.
    pub(super) with_masks: bool,
    /// True if the loss writes an error per pixel for candidates besides the one for row scores.
    pub(super) with_error: bool,
    /// True if pixels at edges have more weight.
    pub(super) with_edges: bool,
    /// True if photographs have exposures; vignettes need them, too.
    pub(super) exposures: bool,
    /// True if steps may differentiate the pose.
    pub(super) poses: bool,
    /// True if photographs have vignettes.
    pub(super) vignettes: bool,
    /// True if depth may be in the loss.
    pub(super) depth: bool,
}

/// A buffer to allocate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PlannedBuffer {
    pub(super) name: &'static str,
    pub(super) section: Section,
    /// Line of the ledger.
    pub(super) line: &'static str,
    pub(super) bytes: u64,
    pub(super) usage: BufferUsages,
}

/// Name of the buffer whose [ranges](Sizes::ranges) are used one after the other.
pub(super) const SCRATCH: &str = "scratch";
/// Largest alignment of a range of a buffer that a device may require `[bytes]`.
const ALIGNMENT: u64 = 256;

/// A range of the buffer [`SCRATCH`], which is bound like a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ScratchRange {
    pub(super) name: &'static str,
    /// Line of the ledger that it would have as a buffer.
    pub(super) line: &'static str,
    /// First byte in the buffer.
    pub(super) at: u64,
    pub(super) bytes: u64,
}

impl Sizes {
    pub(super) fn new(
        budget: RowBudget,
        cap: u64,
        sh_degree: u8,
        image: (u32, u32),
        needs: &Needs,
        depth: bool,
        accumulation: Accumulation,
    ) -> Self {
        let records = RecordLayout::new(needs.signals, depth);
        Self {
            budget,
            cap,
            sh_degree,
            image,
            photographs: KeptPhotographs::default(),
            planes: SignalPlanes::new(needs).count,
            records,
            accumulation,
            storage: Storage::default(),
            alpha_and_depth: false,
            cadence: needs.cadence,
            counts_dominant: counts_dominant(needs),
            pixel_loss: needs.pixel_loss,
            with_masks: needs.mask.is_some(),
            with_edges: records.has(Field::Error) && needs.error_score.edge > 0.0,
            with_error: records.has(Field::Error)
                && needs.candidates.is_some_and(|r| r.error != ErrorMode::Gradient),
            exposures: false,
            poses: false,
            vignettes: false,
            depth,
        }
    }

    /// True if gradients may be summed over several iterations before an optimiser step: `[geometry and band 0, bands
    /// 1–3]`.
    pub(super) fn may_wait(&self) -> [bool; 2] {
        let Cadence { all, sh_rest } = self.cadence;
        [all > 1, all > 1 || sh_rest > 1]
    }

    /// Largest number of rows that are not frozen, >= 1.
    pub(super) fn trained(&self) -> u64 {
        self.budget.trainable().max(1) as u64
    }

    /// First row that is stored in an array, and the largest number of stored rows.
    pub(super) fn row_range(&self, array: &RowArray) -> [u64; 2] {
        if array.content.traits().is_for_training {
            [self.budget.frozen as u64, self.trained()]
        } else {
            [0, self.budget.total as u64]
        }
    }

    /// Every array with an entry per row.
    pub(super) fn row_arrays(&self) -> Vec<RowArray> {
        let in_slots = self.accumulation == Accumulation::Slots;
        let [slots, counts, masks] =
            [in_slots, self.counts_dominant, self.with_masks].map(usize::from);
        let others = [2 * slots, self.planes, self.records.stride(), counts, masks];
        let formats = self.formats();
        let narrow =
            Narrow { moments: formats.moments_in_bytes, parameters: formats.parameters_in_16_bits };
        row_arrays(self.sh_degree, self.may_wait(), narrow, others)
    }

    /// The choices that the kernels depend on.
    pub(super) fn formats(&self) -> Formats {
        Formats {
            accumulation: self.accumulation,
            moments_in_bytes: self.storage.moments == MomentStorage::Both8,
            parameters_in_16_bits: self.storage.parameters == ParameterStorage::F16,
        }
    }

    /// The buffer with the gradients of pixels: the loss replaces the image.
    pub(super) fn pixel_gradient(&self) -> &'static str {
        if self.alpha_and_depth { "pixel gradient" } else { "canvas" }
    }

    /// The arrays that hold the model.
    pub(super) fn parameters(&self) -> Vec<RowArray> {
        let mut arrays = self.row_arrays();
        arrays.retain(|array| matches!(array.content, Content::Geometry | Content::Colour));
        arrays
    }

    /// Bytes of the rows' sums.
    fn row_sums_bytes(&self) -> u64 {
        4 * self.records.stride() as u64 * self.budget.total as u64
    }

    /// The name of the buffer or range for the derivatives of the loss: they borrow the rows' sums, which are unused
    /// before the backward pass, if these are large enough.
    pub(super) fn derivatives(&self) -> &'static str {
        let has_range = self.ranges().iter().any(|range| range.name == "derivatives");
        if has_range { "derivatives" } else { "row sums" }
    }

    /// The ranges of [`SCRATCH`]. Three uses follow each other in a step: sorting rows and entries, the loss, and the
    /// pixels with the largest errors.
    pub(super) fn ranges(&self) -> Vec<ScratchRange> {
        let range = |line, name, at, bytes: u64| {
            let bytes = bytes.max(16).next_multiple_of(16);
            ScratchRange { name, line, at, bytes }
        };
        let numbers = (4 * self.cap).next_multiple_of(ALIGNMENT);
        let sorted = ["keys 0", "keys 1", "values"];
        let mut all: Vec<_> = (0..)
            .zip(sorted)
            .map(|(i, name)| range("entries", name, i * numbers, 4 * self.cap))
            .collect();
        let (width, height) = self.image;
        // The entries of each row, or each digit's items in each block.
        let sums = (self.budget.total as u64).max(DIGITS * self.cap.div_ceil(SORTED));
        all.push(range("sums", "sums", 3 * numbers, 4 * sums));
        let derivatives = 12 * u64::from(width) * u64::from(height);
        if derivatives > self.row_sums_bytes() {
            all.push(range("loss", "derivatives", 0, derivatives));
        }
        // As long as the longest of the others, which a kernel can bind.
        let largest = all.iter().map(|range| range.bytes).max().unwrap_or(0);
        all.insert(0, range("loss", "worst", 0, largest));
        all
    }

    /// Every buffer.
    pub(super) fn planned(&self) -> Vec<PlannedBuffer> {
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
        let mut all = Vec::new();
        let mut add = |section, line, name, bytes: u64| {
            let bytes = rounded(bytes.max(16));
            all.push(PlannedBuffer { name, section, line, bytes, usage: storage });
        };
        let cap = self.cap;
        for array in self.row_arrays() {
            let traits = array.content.traits();
            let [_, rows] = self.row_range(&array);
            add(traits.section, traits.line, array.name, rows * array.row_bytes());
        }
        add(Section::Model, Content::Ages.traits().line, "bias", BiasCorrection::bytes());
        add(Section::Tiles, "entries", "list", 4 * cap);
        if self.accumulation == Accumulation::Slots {
            add(Section::Tiles, "entries", "row of slot", 4 * cap);
            let bytes = 4 * self.records.stride() as u64 * cap;
            add(Section::Tiles, "gradients per entry", "records", bytes);
        }
        let blocks = (self.budget.total as u64).div_ceil(BLOCK).max(DIGITS);
        add(Section::Tiles, "sums", "block sums", 4 * blocks);
        let (width, height) = self.image;
        let pixels = u64::from(width) * u64::from(height);
        let tiles = u64::from(grid(width, height)[1]);
        add(Section::Tiles, "tiles", "state", size_of::<State>() as u64 + 4 * (tiles + 2));
        add(Section::Tiles, "tiles", "tile starts", 4 * (tiles + 1));
        add(Section::Tiles, "tiles", "tile counts", 4 * tiles);
        add(Section::Renderer, "image and image gradient", "canvas", 16 * pixels);
        // Followed by the channel of depth.
        let finish = if self.depth { 16 } else { 8 };
        add(Section::Renderer, "image and image gradient", "finish", finish * pixels);
        if self.alpha_and_depth {
            add(Section::Renderer, "image and image gradient", "pixel gradient", 32 * pixels);
        }
        if self.with_edges {
            add(Section::Renderer, "loss", "edges", 4 * pixels);
        }
        if self.depth {
            add(Section::Images, "given depth on the device", "given depth", 4 * pixels);
        }
        let scratch = self.ranges().iter().map(|range| range.at + range.bytes).max();
        add(Section::Renderer, "sorts and loss", SCRATCH, scratch.unwrap_or(0));
        add(Section::Renderer, "loss", "tile sums", 8 * tiles);
        if self.with_error {
            add(Section::Renderer, "loss", "error", 4 * pixels);
        }
        // Allocated even without exposures: the loss always binds it together with `error`, to which it writes. The
        // placeholder can stand in for only one of the two.
        add(Section::Renderer, "small buffers", "exposure", exposure::TRANSFORM);
        if self.exposures {
            add(Section::Renderer, "exposure", "exposed", 16 * pixels);
            let sums = exposure::SUMS * exposure::groups(pixels);
            add(Section::Renderer, "exposure", "exposure sums", sums);
            add(Section::Renderer, "exposure", "exposure total", exposure::SUMS);
        }
        if self.poses {
            let sums = pose::SUMS * (self.budget.total as u64).div_ceil(pose::GROUP);
            add(Section::Renderer, "gradient of the pose", "pose sums", sums);
            add(Section::Renderer, "gradient of the pose", "pose total", pose::SUMS);
        }
        if self.vignettes {
            add(Section::Renderer, "vignette", "vignette", vignette::PARAMETERS);
            let sums = vignette::SUMS * exposure::groups(pixels);
            add(Section::Renderer, "vignette", "vignette sums", sums);
            add(Section::Renderer, "vignette", "vignette total", vignette::SUMS);
        }
        add(Section::Images, "photograph on the device", "truth", 4 * pixels);
        add(Section::Images, "photograph on the device", "mask", pixels.next_multiple_of(4));
        let kept = self.photographs.count as u64 * self.photograph_bytes().iter().sum::<u64>();
        if kept > 0 {
            add(Section::Images, "photographs kept on the device", "photographs", kept);
        }
        add(Section::Policy, "operations of an edit", "ops", OPS_BYTES);
        add(Section::Renderer, "small buffers", "placeholder", 16);
        add(Section::Renderer, "small buffers", "selection", 4 * (4 + 256));
        let mut add_as = |line, name, bytes, usage| {
            all.push(PlannedBuffer { name, section: Section::Renderer, line, bytes, usage });
        };
        let frame = size_of::<Frame>() as u64;
        add_as("small buffers", "frame", frame, BufferUsages::UNIFORM | BufferUsages::COPY_DST);
        add_as("small buffers", "groups", 128, BufferUsages::STORAGE | BufferUsages::INDIRECT);
        let staging = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        add_as("copies to the host", "read", READ_BYTES, staging);
        all
    }

    /// Size of each photograph kept on the device, and of its mask `[bytes]`.
    pub(super) fn photograph_bytes(&self) -> [u64; 2] {
        KeptPhotographs::bytes(self.image, self.photographs.with_masks)
    }

    /// Memory that the allocator takes beyond the buffers: copies of what is uploaded, and unused parts of blocks. Of the
    /// device's blocks, only two are not full, one with the buffers of [`SMALLEST_ROUNDED`] and more, and one with the
    /// others. Of the blocks for transfers, two that follow each other are at least half full together.
    fn beyond_buffers() -> [(&'static str, u64); 2] {
        let of_transfers = UPLOAD_BYTES + READ_BYTES;
        let unused = 2 * ALLOCATOR_BLOCK + of_transfers + ALLOCATOR_BLOCK;
        [("uploads", UPLOAD_BYTES), ("unused parts of blocks", unused)]
    }

    /// The ledger: bytes per purpose.
    pub(super) fn ledger(&self) -> Ledger {
        let mut ledger = Ledger::default();
        for PlannedBuffer { section, line, bytes, .. } in self.planned() {
            ledger.add_on_device(section, line, bytes);
        }
        for (line, bytes) in Self::beyond_buffers() {
            ledger.add_on_device(Section::Renderer, line, bytes);
        }
        ledger
    }
}

#[cfg(test)]
mod tests {
    use densify_policies::policy::{CandidateRequest, DepthMode, Signal};

    use super::*;
    use crate::{MomentStorage, ParameterStorage};

    /// Signals and candidates as the policy `diet` has them by default.
    fn needs() -> Needs {
        let signals = [
            Signal::VisibleCount,
            Signal::ScreenGradient,
            Signal::ColourGradient,
            Signal::MeanGradientX,
            Signal::MeanGradientY,
            Signal::MeanGradientZ,
            Signal::MeanGradientNorm,
            Signal::WeightMax,
        ];
        let candidates = CandidateRequest {
            from: 0,
            until: 1,
            rows_per_candidate: 1,
            capacity: 1,
            error: ErrorMode::L1Dssim,
            depth: DepthMode::Median,
            min_alpha: 0.0,
            spaced: false,
        };
        Needs {
            signals: signals.into_iter().collect(),
            candidates: Some(candidates),
            ..Needs::default()
        }
    }

    /// All memory on the device per row, for a million rows and images of 1.6 megapixels: with moments in f32 and in
    /// bytes, and with `--preset tiny-memory`. docs/memory.md has the figures.
    #[test]
    fn a_million_rows_take_the_documented_bytes() {
        const ROWS: usize = 1_000_000;
        let bytes_per_row = |pairs: u64, storage, accumulation| {
            let cap = pairs * ROWS as u64;
            let mut sizes =
                Sizes::new(ROWS.into(), cap, 3, (1600, 1000), &needs(), false, accumulation);
            assert_eq!((sizes.planes, sizes.records.stride()), (9, 10));
            sizes.storage = storage;
            sizes.ledger().on_device().div_ceil(ROWS as u64)
        };
        let both8 = Storage { moments: MomentStorage::Both8, ..Storage::default() };
        let smallest = Storage { parameters: ParameterStorage::F16, ..both8 };
        let cas = Accumulation::SubgroupCas;
        let found = [(4, Storage::default()), (4, both8), (1, smallest)]
            .map(|(pairs, storage)| bytes_per_row(pairs, storage, cas));
        assert_eq!(found, [985, 633, 477]);
        // Records, the rows of slots, and the slots of rows.
        let in_slots = bytes_per_row(4, Storage::default(), Accumulation::Slots);
        assert_eq!(in_slots - found[0], 4 * (40 + 4) + 8);
    }
}
