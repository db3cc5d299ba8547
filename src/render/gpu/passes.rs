//! Encodes the passes of a view: forward, image loss, backward, optimiser. The commands depend only on the image's size
//! and the number of bands; everything else is counted on the device.

use densify_policies::policy::MaskTerm;
use wgpu::ComputePass;

use super::clock::Stages;
use super::exposure::groups;
use super::launches::{Launch, Launches};
use super::sizes::{BLOCK, SORTED};
use densify_core::gaussians::logit;

/// Workgroups along the first of two dimensions; see `shaders/shared/view.wgsl`.
const ACROSS: u32 = 32_768;
/// Offsets of indirect dispatch sizes `[bytes]`; see `shaders/tiles.wgsl`.
mod args {
    pub(super) const ENTRIES: u64 = 0;
    pub(super) const STEP: u64 = 12;
    pub(super) const BANDS: u64 = 24;
}
/// The entries of which prefix sums are computed; see `shaders/tiles.wgsl`.
const COUNTS_ALL: u32 = 0;
const COUNTS_BAND: u32 = 1;
const COUNTS_AGAIN: u32 = 2;
/// The items that a sort takes; see `shaders/tiles.wgsl`.
const FIRST_OF_ROWS: u32 = 0;
const ROWS: u32 = 1;
const ENTRIES: u32 = 2;
/// Number of eight-bit digits of a depth.
const DEPTH_DIGITS: u32 = 4;
/// Number of workgroups of `scan_digits`: one per eight values of a digit.
const DIGIT_GROUPS: u32 = 256 / 8;
/// The launch of `scatter` that writes the order of rows.
const TO_ORDER: usize = 4;
/// Band number that stands for the whole image.
const WHOLE: u32 = u32::MAX;

/// Numbers that an auxiliary view sums per row.
pub(super) const COLUMNS: usize = 6;

/// The sizes that determine the commands.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shape {
    pub(super) rows: u32,
    pub(super) tiles: u32,
    /// Number of bands to encode; superfluous ones do nothing.
    pub(super) bands: u32,
}

impl Shape {
    /// Number of eight-bit digits that sort the entries by tile.
    fn tile_digits(&self) -> u32 {
        (u32::BITS - (self.tiles - 1).leading_zeros()).div_ceil(8).max(1)
    }
}

/// The place of the errors of pixels: a buffer of their own, or the canvas, whose first three numbers are the gradient.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ErrorPlace {
    Buffer,
    Gradient,
    Canvas,
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
    pub(super) error: ErrorPlace,
}

/// Takes the dispatches of a view's passes: encodes them, or, in a test, counts them.
pub(super) trait Record<L> {
    /// Begins a stage.
    fn stage(&mut self, name: &'static str);

    /// Dispatches this number of workgroups.
    fn run(&mut self, launch: &L, immediates: [u32; 4], groups: u32);

    /// Dispatches the number of workgroups that the device has counted and stored at byte `at` of the buffer "groups".
    fn run_counted(&mut self, launch: &L, immediates: [u32; 4], at: u64);
}

/// Encodes dispatches into one pass.
pub(super) struct Recorder<'e> {
    pass: ComputePass<'e>,
    groups: &'e wgpu::Buffer,
    pub(super) stages: Stages<'e>,
}

impl<'e> Recorder<'e> {
    pub(super) fn new(pass: ComputePass<'e>, groups: &'e wgpu::Buffer) -> Self {
        Self { pass, groups, stages: Stages::default() }
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
}

impl Record<Launch> for Recorder<'_> {
    fn stage(&mut self, name: &'static str) {
        self.stages.begin(&mut self.pass, name);
    }

    fn run(&mut self, launch: &Launch, immediates: [u32; 4], groups: u32) {
        if groups > 0 {
            self.set(launch, immediates);
            self.pass.dispatch_workgroups(groups.min(ACROSS), groups.div_ceil(ACROSS), 1);
        }
    }

    fn run_counted(&mut self, launch: &Launch, immediates: [u32; 4], at: u64) {
        self.set(launch, immediates);
        self.pass.dispatch_workgroups_indirect(self.groups, at);
    }
}

/// The passes of one view.
pub(super) struct Passes<'a, L = Launch> {
    pub(super) launches: &'a Launches<L>,
    pub(super) shape: Shape,
}

impl<L> Passes<'_, L> {
    /// Sorts by one digit, stably; `items`: see [`FIRST_OF_ROWS`].
    fn sort_digit(&self, to: &mut impl Record<L>, digit: u32, items: u32, scatter: &L) {
        let l = self.launches;
        // The values of the first digit are the indices of the rows, or, with slots, of the entries.
        let of_indices = items == FIRST_OF_ROWS || l.in_slots && items == ENTRIES && digit == 0;
        let immediates = [8 * digit, items, u32::from(of_indices), 0];
        let count = l.nth("count_digits", (digit % 2) as usize);
        // At least one group, which counts the rows on screen.
        let blocks = self.shape.rows.div_ceil(SORTED as u32).max(1);
        if items == ENTRIES {
            to.run_counted(count, immediates, args::ENTRIES);
        } else {
            to.run(count, immediates, blocks);
        }
        to.run(l.get("scan_digits"), immediates, DIGIT_GROUPS);
        if items == ENTRIES {
            to.run_counted(scatter, immediates, args::ENTRIES);
        } else {
            to.run(scatter, immediates, blocks);
        }
    }

    /// Stages 1–3. Afterwards the canvas holds the image, and the lists hold the entries of the last band.
    pub(super) fn forward(&self, to: &mut impl Record<L>) {
        let l = self.launches;
        let Shape { rows, bands, .. } = self.shape;
        to.stage("project");
        to.run(l.get("project"), [0; 4], rows.div_ceil(256));
        if l.counts_dominant {
            to.run(l.get("clear_dominant"), [0; 4], rows.div_ceil(256));
        }
        to.stage("sort by depth");
        for digit in 0..DEPTH_DIGITS {
            let is_last = digit == DEPTH_DIGITS - 1;
            let number = if is_last { TO_ORDER } else { 3 * (digit as usize % 2) };
            let items = if digit == 0 { FIRST_OF_ROWS } else { ROWS };
            self.sort_digit(to, digit, items, l.nth("scatter", number));
        }
        to.stage("tiles");
        self.count(to, WHOLE, COUNTS_ALL);
        if bands > 1 {
            to.run(l.get("count_tiles"), [0; 4], rows.div_ceil(256));
            to.run(l.get("cut_bands"), [0, bands, 0, 0], 1);
        }
        for band in 0..bands {
            self.lists(to, band, COUNTS_BAND);
            to.stage("rasterize");
            to.run(l.get("rasterize"), [band, 0, 0, 0], self.shape.tiles);
        }
    }

    /// Counts the entries of a band.
    fn count(&self, to: &mut impl Record<L>, band: u32, sum: u32) {
        let l = self.launches;
        let Shape { rows, bands, .. } = self.shape;
        to.run(l.get("count_entries"), [band, 0, 0, 0], rows.div_ceil(256));
        to.run(l.get("scan_blocks"), [sum, 0, 0, 0], rows.div_ceil(BLOCK as u32));
        to.run(l.get("scan_sums"), [sum, bands, 0, 0], 1);
    }

    /// Builds the tile lists of a band. If there is only one, its entries are already counted.
    fn lists(&self, to: &mut impl Record<L>, band: u32, sum: u32) {
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
        to.run(emit, [tiles, 0, 0, 0], self.shape.rows.div_ceil(256));
        for digit in 0..digits {
            let [keys, values] = [is_odd(digit), is_odd(digits - digit)];
            self.sort_digit(to, digit, ENTRIES, l.nth("scatter", 2 * keys + values));
        }
        let groups = (self.shape.tiles + 1).div_ceil(256);
        to.run(l.nth("find_tiles", is_odd(digits)), [0; 4], groups);
    }

    /// Applies the photograph's exposure to a copy of the rendered image.
    pub(super) fn expose(&self, to: &mut impl Record<L>, pixels: u32) {
        to.run(self.launches.get("expose"), [0; 4], groups(pixels.into()) as u32);
    }

    /// Backpropagates the gradients of an exposed image to the canvas, and sums the derivatives with respect to the
    /// exposure.
    pub(super) fn expose_bwd(&self, to: &mut impl Record<L>, pixels: u32) {
        let l = self.launches;
        to.run(l.get("expose_bwd"), [0; 4], groups(pixels.into()) as u32);
        to.run(l.get("total_exposure"), [0; 4], 1);
    }

    /// Dims an exposed image as the photograph's vignette does.
    pub(super) fn dim(&self, to: &mut impl Record<L>, pixels: u32) {
        to.run(self.launches.get("dim"), [0; 4], groups(pixels.into()) as u32);
    }

    /// Backpropagates the gradients of a dimmed image to those of the exposed one, and sums the derivatives with
    /// respect to the vignette.
    pub(super) fn dim_bwd(&self, to: &mut impl Record<L>, pixels: u32) {
        let l = self.launches;
        to.run(l.get("dim_bwd"), [0; 4], groups(pixels.into()) as u32);
        to.run(l.get("total_vignette"), [0; 4], 1);
    }

    /// Stage 4 of an image with or without an exposure. If `differentiates`, dL/dpixel replaces the image.
    pub(super) fn loss(&self, to: &mut impl Record<L>, is_exposed: bool, differentiates: bool) {
        let l = self.launches;
        let image = usize::from(is_exposed);
        to.stage("loss");
        for channel in 0..3 {
            to.run(l.nth("similarity", image), [channel, 0, 0, 0], self.shape.tiles);
            if differentiates {
                to.run(l.nth("pixel_gradient", image), [channel, 0, 0, 0], self.shape.tiles);
            }
        }
        // The last gradient includes the means over the image.
        if !differentiates {
            to.run(l.get("total"), [0; 4], 1);
        }
    }

    /// Writes the given inverse depth from which the forward pass takes distances.
    pub(super) fn place_depth(&self, to: &mut impl Record<L>, pixels: u32) {
        to.run(self.launches.get("place_depth"), [0; 4], groups(pixels.into()) as u32);
    }

    /// Depth in the loss, with these numbers of `shaders/depth_gradient.wgsl`.
    pub(super) fn depth_gradient(&self, to: &mut impl Record<L>, pixels: u32, numbers: [f32; 4]) {
        let l = self.launches;
        let immediates = numbers.map(f32::to_bits);
        to.stage("depth_gradient");
        to.run(l.get("depth_gradient"), immediates, groups(pixels.into()) as u32);
        to.run(l.get("total_depth"), [0; 4], 1);
    }

    /// Stage 5: sums the pixels' gradients per row.
    pub(super) fn backward(&self, to: &mut impl Record<L>) {
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
    pub(super) fn differentiate(&self, to: &mut impl Record<L>, with_pose: bool) {
        let l = self.launches;
        to.stage("project_bwd");
        if with_pose {
            to.run_counted(l.get("project_bwd_pose"), [0; 4], args::STEP);
            to.run(l.get("total_pose"), [0; 4], 1);
        } else {
            to.run_counted(l.get("project_bwd"), [0; 4], args::STEP);
        }
    }

    /// Stages 6 to 8. Colours step before the geometry, as their gradient depends on it. The weight in `mask` is
    /// already divided by the number of rows in training.
    pub(super) fn optimise(
        &self,
        to: &mut impl Record<L>,
        sh_degree: u8,
        [with_pose, signals]: [bool; 2],
        mask: Option<MaskTerm>,
    ) {
        let l = self.launches;
        self.differentiate(to, with_pose);
        if signals {
            to.run_counted(l.get("accumulate"), [0; 4], args::STEP);
        }
        if let Some(MaskTerm { start, rate, weight, threshold }) = mask {
            let immediates = [start, rate, weight, logit(threshold)].map(f32::to_bits);
            to.run_counted(l.get("step_masks"), immediates, args::STEP);
        }
        to.stage("adam");
        for band in 0..=usize::from(sh_degree) {
            let [first, coefficients] = [(band * band) as u32, (2 * band + 1) as u32];
            let immediates = [first, coefficients, 0, 0];
            let at = args::BANDS + 12 * band as u64;
            to.run_counted(l.nth("adam_band", band), immediates, at);
        }
        to.run_counted(l.get("adam_geometry"), [0; 4], args::STEP);
    }

    /// Writes the pixels with the largest errors to the range "worst": their number, then the error bits and the index
    /// of each, as many as fit. Pixels whose error equals that of the last one wanted are included.
    pub(super) fn worst(&self, to: &mut impl Record<L>, search: &Search) {
        let l = self.launches;
        let &Search { pixels, wanted, room, min_alpha, error } = search;
        let (groups, map) = (pixels.div_ceil(256), usize::from(error != ErrorPlace::Buffer));
        let immediates = |a, b| [a, b, min_alpha.to_bits(), error as u32];
        to.run(l.get("narrow"), [0, wanted, 0, 0], 1);
        for shift in [24, 16, 8, 0] {
            to.run(l.nth("count_errors", map), immediates(shift, u32::from(shift == 24)), groups);
            to.run(l.get("narrow"), [1, 0, 0, 0], 1);
        }
        to.run(l.nth("write_worst", map), immediates(0, room), groups);
        to.run(l.get("narrow"), [2, 0, 0, 0], 1);
    }

    /// Finds the surface points of the pixels whose indices are uploaded, from index `first` on.
    pub(super) fn surface(&self, to: &mut impl Record<L>, pixels: u32, mode: u32, first: u32) {
        for band in 0..self.shape.bands {
            if self.shape.bands > 1 {
                self.lists(to, band, COUNTS_AGAIN);
            }
            let immediates = [band, pixels, mode, first];
            to.run(self.launches.get("surface"), immediates, pixels.div_ceil(256));
        }
    }

    /// Completes the depths that follow the pixel map with those of the model, and multiplies all by `factor`.
    pub(super) fn fronts(&self, to: &mut impl Record<L>, pixels: u32, factor: f32) {
        for band in 0..self.shape.bands {
            if self.shape.bands > 1 {
                self.lists(to, band, COUNTS_AGAIN);
            }
            let immediates = [band, pixels, factor.to_bits(), 0];
            to.run(self.launches.get("find_front"), immediates, pixels.div_ceil(256));
        }
    }

    /// Computes the columns of an auxiliary view: for each row, sums over the pixels that it is blended into.
    pub(super) fn columns(&self, to: &mut impl Record<L>) {
        let l = self.launches;
        let groups = self.shape.rows.div_ceil(256);
        if !l.in_slots {
            to.run(l.get("clear_sums"), [COLUMNS as u32, 0, 0, 0], groups);
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

#[cfg(test)]
mod tests;
