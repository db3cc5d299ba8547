//! Encodes the passes of a view: forward, image loss, backward, optimiser. The commands depend only on the image's size
//! and the number of bands; everything else is counted on the device.

use densify_policies::policy::MaskTerm;
use wgpu::ComputePass;

use super::clock::Stages;
use super::exposure::groups;
use super::launches::{Launch, Launches};
use super::sizes::BLOCK;
use densify_core::gaussians::logit;

/// Workgroups along the first of two dimensions; see `shaders/shared/view.wgsl`.
const ACROSS: u32 = 32_768;
/// Offsets of indirect dispatch sizes `[bytes]`; see `shaders/tiles.wgsl`.
mod args {
    pub(super) const ROWS: u64 = 0;
    pub(super) const ROW_BLOCKS: u64 = 12;
    pub(super) const ROW_DIGITS: u64 = 24;
    pub(super) const ENTRY_BLOCKS: u64 = 36;
    pub(super) const ENTRY_DIGITS: u64 = 48;
}
/// Quantities of which prefix sums are computed; see `shaders/tiles.wgsl`.
const FLAGS: u32 = 0;
const COUNTS_ALL: u32 = 1;
const COUNTS_BAND: u32 = 2;
const COUNTS_AGAIN: u32 = 3;
const DIGITS_OF_ROWS: u32 = 4;
const DIGITS_OF_ENTRIES: u32 = 5;
/// The launch of `scatter` that writes the order of rows.
const TO_ORDER: usize = 4;
/// Band number that stands for the whole image.
const WHOLE: u32 = u32::MAX;

/// Numbers that an auxiliary view sums per row.
const COLUMNS: u32 = 5;

/// The sizes that determine the commands.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shape {
    pub(super) rows: u32,
    pub(super) tiles: u32,
    /// Number of bands to encode; superfluous ones do nothing.
    pub(super) bands: u32,
}

impl Shape {
    /// Number of four-bit digits that sort the entries by tile.
    fn tile_digits(&self) -> u32 {
        (u32::BITS - (self.tiles - 1).leading_zeros()).div_ceil(4).max(1)
    }
}

/// A search for the pixels of a view with the largest errors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Search {
    /// Number of pixels of the image.
    pub(super) pixels: u32,
    /// Number of pixels wanted.
    pub(super) wanted: u32,
    /// Largest number of pixels that the result can hold.
    pub(super) room: u32,
    /// Smallest alpha of a pixel that may be selected.
    pub(super) min_alpha: f32,
    /// True if the error is the length of the loss's gradient.
    pub(super) of_gradient: bool,
}

/// Encodes dispatches into one pass.
pub(super) struct Recorder<'e> {
    pass: ComputePass<'e>,
    pub(super) stages: Stages<'e>,
}

impl<'e> Recorder<'e> {
    pub(super) fn new(pass: ComputePass<'e>) -> Self {
        Self { pass, stages: Stages::default() }
    }

    /// Encodes the beginning of a stage.
    fn stage(&mut self, name: &'static str) {
        self.stages.begin(&mut self.pass, name);
    }

    /// Ends the pass and returns the names of its stages; the last, empty name marks the end.
    pub(super) fn end(mut self) -> Vec<&'static str> {
        self.stage("");
        self.stages.names
    }

    fn set(&mut self, launch: &Launch, immediates: [u32; 4]) {
        self.pass.set_pipeline(&launch.pipeline);
        self.pass.set_bind_group(0, &launch.bindings, &[]);
        self.pass.set_immediates(0, bytemuck::bytes_of(&immediates));
    }

    /// Dispatches this number of workgroups.
    pub(super) fn run(&mut self, launch: &Launch, immediates: [u32; 4], groups: u32) {
        if groups > 0 {
            self.set(launch, immediates);
            self.pass.dispatch_workgroups(groups.min(ACROSS), groups.div_ceil(ACROSS), 1);
        }
    }

    /// Dispatches the number of workgroups that the device has counted.
    fn run_counted(
        &mut self,
        launch: &Launch,
        immediates: [u32; 4],
        groups: &wgpu::Buffer,
        at: u64,
    ) {
        self.set(launch, immediates);
        self.pass.dispatch_workgroups_indirect(groups, at);
    }
}

/// The passes of one view.
pub(super) struct Passes<'a> {
    pub(super) launches: &'a Launches,
    pub(super) groups: &'a wgpu::Buffer,
    pub(super) shape: Shape,
}

impl Passes<'_> {
    /// Sorts by one digit, stably. `items` is 1 for entries and 0 for rows.
    fn sort_digit(&self, to: &mut Recorder<'_>, digit: u32, items: u32, scatter: &Launch) {
        let l = self.launches;
        let source = (digit % 2) as usize;
        let (blocks, digits, sum) = if items == 1 {
            (args::ENTRY_BLOCKS, args::ENTRY_DIGITS, DIGITS_OF_ENTRIES)
        } else {
            (args::ROW_BLOCKS, args::ROW_DIGITS, DIGITS_OF_ROWS)
        };
        // With slots, the values of the first digit are the indices of the entries.
        let of_indices = l.in_slots && items == 1 && digit == 0;
        let immediates = [4 * digit, items, u32::from(of_indices), 0];
        to.run_counted(l.nth("count_digits", source), immediates, self.groups, blocks);
        to.run_counted(l.get("scan_blocks"), [sum, 0, 0, 0], self.groups, digits);
        to.run(l.get("scan_sums"), [sum, 0, 0, 0], 1);
        to.run_counted(scatter, immediates, self.groups, blocks);
    }

    /// Stages 1–3. Afterwards the canvas holds the image, and the lists hold the entries of the last band.
    pub(super) fn forward(&self, to: &mut Recorder<'_>) {
        let l = self.launches;
        let Shape { rows, bands, .. } = self.shape;
        to.stage("project");
        to.run(l.get("project"), [0; 4], rows.div_ceil(256));
        if l.counts_dominant {
            to.run(l.get("clear_dominant"), [0; 4], rows.div_ceil(256));
        }
        to.run(l.get("scan_blocks"), [FLAGS, 0, 0, 0], rows.div_ceil(BLOCK as u32));
        to.run(l.get("scan_sums"), [FLAGS, bands, 0, 0], 1);
        to.run(l.get("compact"), [0; 4], rows.div_ceil(256));
        to.stage("sort by depth");
        for digit in 0..8 {
            let number = if digit == 7 { TO_ORDER } else { 3 * (digit as usize % 2) };
            self.sort_digit(to, digit, 0, l.nth("scatter", number));
        }
        to.stage("tiles");
        self.count(to, WHOLE, COUNTS_ALL);
        if bands > 1 {
            to.run_counted(l.get("count_tiles"), [0; 4], self.groups, args::ROWS);
            to.run(l.get("cut_bands"), [0, bands, 0, 0], 1);
        }
        for band in 0..bands {
            self.lists(to, band, COUNTS_BAND);
            to.stage("rasterize");
            to.run(l.get("rasterize"), [band, 0, 0, 0], self.shape.tiles);
        }
    }

    /// Counts the entries of a band.
    fn count(&self, to: &mut Recorder<'_>, band: u32, sum: u32) {
        let l = self.launches;
        to.run_counted(l.get("count_entries"), [band, 0, 0, 0], self.groups, args::ROWS);
        to.run_counted(l.get("scan_blocks"), [sum, 0, 0, 0], self.groups, args::ROW_BLOCKS);
        to.run(l.get("scan_sums"), [sum, self.shape.bands, 0, 0], 1);
    }

    /// Builds the tile lists of a band. If there is only one, its entries are already counted.
    fn lists(&self, to: &mut Recorder<'_>, band: u32, sum: u32) {
        let l = self.launches;
        to.stage("tiles");
        let several = self.shape.bands > 1;
        if several {
            self.count(to, band, sum);
        }
        let tiles = if several { band } else { WHOLE };
        // Keys and values alternate between two ranges each; the last values are the lists.
        let digits = self.shape.tile_digits();
        let is_odd = |number: u32| number as usize % 2;
        let emit = l.nth("emit_entries", is_odd(digits));
        to.run_counted(emit, [tiles, 0, 0, 0], self.groups, args::ROWS);
        for digit in 0..digits {
            let [keys, values] = [is_odd(digit), is_odd(digits - digit)];
            self.sort_digit(to, digit, 1, l.nth("scatter", 2 * keys + values));
        }
        let groups = (self.shape.tiles + 1).div_ceil(256);
        to.run(l.nth("find_tiles", is_odd(digits)), [0; 4], groups);
    }

    /// Applies the photograph's exposure to the rendered image.
    pub(super) fn expose(&self, to: &mut Recorder<'_>, pixels: u32) {
        to.run(self.launches.get("expose"), [0; 4], groups(pixels.into()) as u32);
    }

    /// Backpropagates the gradients of an exposed image, and sums the derivatives with respect to the exposure.
    pub(super) fn expose_bwd(&self, to: &mut Recorder<'_>, pixels: u32) {
        let l = self.launches;
        to.run(l.get("expose_bwd"), [0; 4], groups(pixels.into()) as u32);
        to.run(l.get("total_exposure"), [0; 4], 1);
    }

    /// Stage 4. `error_weights`: the weights of |e| and of 1 − SSIM in the error of a pixel, first for candidates, then
    /// for signals.
    pub(super) fn loss(&self, to: &mut Recorder<'_>, error_weights: [[f32; 2]; 2]) {
        let l = self.launches;
        let [[a, b], [c, d]] = error_weights.map(|weights| weights.map(f32::to_bits));
        to.stage("loss");
        to.run(l.get("similarity"), [a, b, c, d], self.shape.tiles);
        to.run(l.get("pixel_gradient"), [0; 4], self.shape.tiles);
        to.run(l.get("total"), [0; 4], 1);
    }

    /// Writes the given inverse depth from which the forward pass takes distances.
    pub(super) fn place_depth(&self, to: &mut Recorder<'_>, pixels: u32) {
        to.run(self.launches.get("place_depth"), [0; 4], groups(pixels.into()) as u32);
    }

    /// Depth in the loss, with these numbers of `shaders/depth_gradient.wgsl`.
    pub(super) fn depth_gradient(&self, to: &mut Recorder<'_>, pixels: u32, numbers: [f32; 4]) {
        let l = self.launches;
        let immediates = numbers.map(f32::to_bits);
        to.stage("depth_gradient");
        to.run(l.get("depth_gradient"), immediates, groups(pixels.into()) as u32);
        to.run(l.get("total_depth"), [0; 4], 1);
    }

    /// Stage 5: sums the pixels' gradients per row.
    pub(super) fn backward(&self, to: &mut Recorder<'_>) {
        let l = self.launches;
        let Shape { rows, tiles, bands } = self.shape;
        let groups = rows.div_ceil(256);
        to.stage("rasterize_bwd");
        if !l.in_slots {
            to.run(l.get("clear_sums"), [l.record, 0, 0, 0], groups);
        }
        for band in 0..bands {
            if bands > 1 {
                self.lists(to, band, COUNTS_AGAIN);
                to.stage("rasterize_bwd");
            }
            to.run(l.get("rasterize_bwd"), [band, 0, 0, 0], tiles);
            if l.in_slots {
                to.run(l.get("gather"), [band, 0, 0, 0], groups);
            }
        }
    }

    /// Stage 6.
    pub(super) fn differentiate(&self, to: &mut Recorder<'_>) {
        to.stage("project_bwd");
        to.run(self.launches.get("project_bwd"), [0; 4], self.shape.rows.div_ceil(256));
    }

    /// Stages 6 to 8. Colours step before the geometry, as their gradient depends on it. The weight in `mask` is
    /// already divided by the number of rows in training.
    pub(super) fn optimise(
        &self,
        to: &mut Recorder<'_>,
        sh_degree: u8,
        signals: bool,
        mask: Option<MaskTerm>,
    ) {
        let l = self.launches;
        let groups = self.shape.rows.div_ceil(256);
        self.differentiate(to);
        if signals {
            to.run(l.get("accumulate"), [0; 4], groups);
        }
        if let Some(MaskTerm { start, rate, weight, threshold }) = mask {
            let immediates = [start, rate, weight, logit(threshold)].map(f32::to_bits);
            to.run(l.get("step_masks"), immediates, groups);
        }
        to.stage("adam");
        for band in 0..=usize::from(sh_degree) {
            let [first, coefficients] = [(band * band) as u32, (2 * band + 1) as u32];
            let pairs = self.shape.rows * (3 * coefficients).div_ceil(2);
            let immediates = [first, coefficients, 0, 0];
            to.run(l.nth("adam_band", band), immediates, pairs.div_ceil(256));
        }
        to.run(l.get("adam_geometry"), [0; 4], groups);
    }

    /// Writes the pixels with the largest errors to the range of the rows' gradients: their number, then the error
    /// bits and the index of each, as many as fit. Pixels whose error equals that of the last one wanted are included.
    pub(super) fn worst(&self, to: &mut Recorder<'_>, search: &Search) {
        let l = self.launches;
        let &Search { pixels, wanted, room, min_alpha, of_gradient } = search;
        let (groups, map) = (pixels.div_ceil(256), usize::from(of_gradient));
        let immediates = |a, b| [a, b, min_alpha.to_bits(), u32::from(of_gradient)];
        to.run(l.get("narrow"), [0, wanted, 0, 0], 1);
        for shift in [24, 16, 8, 0] {
            to.run(l.nth("count_errors", map), immediates(shift, u32::from(shift == 24)), groups);
            to.run(l.get("narrow"), [1, 0, 0, 0], 1);
        }
        to.run(l.nth("write_worst", map), immediates(0, room), groups);
        to.run(l.get("narrow"), [2, 0, 0, 0], 1);
    }

    /// Finds the surface points of the pixels whose indices are uploaded, from index `first` on.
    pub(super) fn surface(&self, to: &mut Recorder<'_>, pixels: u32, mode: u32, first: u32) {
        for band in 0..self.shape.bands {
            if self.shape.bands > 1 {
                self.lists(to, band, COUNTS_AGAIN);
            }
            let immediates = [band, pixels, mode, first];
            to.run(self.launches.get("surface"), immediates, pixels.div_ceil(256));
        }
    }

    /// Computes the columns of an auxiliary view: for each row, sums over the pixels that it is blended into.
    pub(super) fn columns(&self, to: &mut Recorder<'_>) {
        let l = self.launches;
        let groups = self.shape.rows.div_ceil(256);
        if !l.in_slots {
            to.run(l.get("clear_sums"), [COLUMNS, 0, 0, 0], groups);
        }
        for band in 0..self.shape.bands {
            if self.shape.bands > 1 {
                self.lists(to, band, COUNTS_AGAIN);
            }
            to.run(l.get("replay"), [band, 0, 0, 0], self.shape.tiles);
            if l.in_slots {
                to.run(l.get("gather_columns"), [band, 0, 0, 0], groups);
            }
        }
    }
}
