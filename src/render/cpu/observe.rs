//! Auxiliary views: training views that are rendered for a policy's edit, with statistics per Gaussian.
//!
//! Blending is [replayed](super::replay). Each row's sums over the pixels that it is blended into, and its largest
//! weight, go to one record per (row, tile); the records of a row are added in order of tile number. Records and sums
//! use the backward pass's buffers, and the pixel map uses the alpha plane of the image gradient.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use densify_policies::policy::{AuxColumn, AuxRequest, Candidate, DepthMode, PixelMap};
use pulp::{Simd, WithSimd};

use super::batch::{BATCH, Batch, CORNER_X, CORNER_Y, LANE_X, LANE_Y};
use super::loss::ErrorRequests;
use super::passes::{Frame, for_each_pixel, scalars};
use super::project::Splat;
use super::rasterize::{
    Blending, DepthPlane, PATCHES, Plane, TRANSMITTANCE, TilePlace, ZERO_PLANE,
};
use super::records::{Sums, TileRecords, gather_all, parts};
use super::replay::{Blended, blend, is_finished};
use super::simd::{V, WIDTH};
use super::surface::MEDIAN;
use super::tiles::{Entry, Grid, Visible};
use super::{AuxInput, AuxOutput, BackendError, CpuBackend};
use crate::assert_same_size;
use crate::candidates::Photograph;
use crate::pixel_map::{pixel_map, radius_px, sample_pixels};
use densify_core::image::Image8;

/// Values per record: sum of the pixel map, number of pixels, sum of blend weights, sum of the pixels' distances from
/// the projected mean, sum of blend weights in front of the surface, largest weight.
const STRIDE: usize = 6;
/// The index of the largest weight, the only value that is not a sum.
const MAXIMUM: usize = STRIDE - 1;
/// The planes of a tile's gradient that temporarily hold the pixel map, and the depth below which a row is in front of
/// the surface.
const MAP: usize = 3;
const FRONT: usize = 2;

/// Bytes for an image of `pixels` pixels: colours, error, edge and luma, and the sampling of points.
pub(super) fn bytes(request: &AuxRequest, pixels: usize) -> u64 {
    let sampling =
        if request.points > 0 { 2 * size_of::<f32>() + size_of::<(f64, u32)>() } else { 0 };
    (pixels * (5 * size_of::<f32>() + 1 + sampling)) as u64
        + u64::from(request.points) * size_of::<Candidate>() as u64
}

impl CpuBackend {
    /// Renders and measures a view.
    pub(super) fn observe_view(&mut self, input: &AuxInput<'_>) -> Result<AuxOutput, BackendError> {
        let AuxInput { camera, target, background, exposure, vignette, request, .. } = *input;
        let unexposed = exposure.map_or(background, |exposure| exposure.behind(background));
        assert_same_size(camera, target);
        // Stage times remain those of training.
        let clock = std::mem::take(&mut self.clock);
        let frame = self.forward(camera, unexposed, input.sh_degree, DepthPlane::Unused, None);
        let measured = frame.map(|frame| {
            if let Some(exposure) = exposure {
                self.expose(&frame.grid, exposure);
            }
            if let Some(vignette) = vignette {
                self.dim(&frame.grid, vignette, target);
            }
            let no_errors = ErrorRequests::default();
            let loss = scalars(self.image_loss(&frame.grid, target, background, no_errors)).loss;
            let points = self.sample_points(&frame, input);
            let columns = if request.columns.is_empty() {
                Vec::new()
            } else {
                self.write_map(&frame.grid, target, background, request.map);
                if request.columns.contains(&AuxColumn::WeightInFront) {
                    self.write_front(&frame, input);
                }
                let columns = self.columns(&frame, &request.columns);
                for gradient in &mut self.gradient {
                    (gradient.planes[MAP], gradient.planes[FRONT]) = (ZERO_PLANE, ZERO_PLANE);
                }
                columns
            };
            AuxOutput { loss, columns, points }
        });
        self.clock = clock;
        measured
    }

    /// The surface points of pixels sampled in proportion to their alpha.
    fn sample_points(&mut self, frame: &Frame, input: &AuxInput<'_>) -> Vec<Candidate> {
        if input.request.points == 0 {
            return Vec::new();
        }
        let grid = &frame.grid;
        let mut alpha = vec![0.0; grid.width * grid.height];
        for (tile, canvas) in self.canvas[..grid.tiles()].iter().enumerate() {
            for_each_pixel(grid, tile, |patch, lane, at| {
                alpha[at] = 1.0 - canvas.planes[TRANSMITTANCE][patch][lane];
            });
        }
        let pixels = sample_pixels(&alpha, grid.width, input);
        let photograph = Photograph::from(input);
        self.surface_points(frame, photograph, &pixels, DepthMode::MaxWeight)
    }

    /// Writes the pixel map to its plane of the gradient.
    fn write_map(&mut self, grid: &Grid, target: &Image8, background: [f32; 3], map: PixelMap) {
        let mut rgb = vec![[0.0; 3]; grid.width * grid.height];
        for (tile, canvas) in self.canvas[..grid.tiles()].iter().enumerate() {
            for_each_pixel(grid, tile, |patch, lane, at| {
                rgb[at] = [0, 1, 2].map(|i| canvas.planes[i][patch][lane]);
            });
        }
        let values = pixel_map(&rgb, target, background, map);
        for (tile, gradient) in self.gradient[..grid.tiles()].iter_mut().enumerate() {
            gradient.planes[MAP] = ZERO_PLANE;
            for_each_pixel(grid, tile, |patch, lane, at| {
                gradient.planes[MAP][patch][lane] = values[at];
            });
        }
    }

    /// Writes the depth below which a row is in front of the surface to its plane of the gradient. Overwrites the image.
    fn write_front(&mut self, frame: &Frame, input: &AuxInput<'_>) {
        self.replay_depths(frame);
        let grid = &frame.grid;
        let tiles = self.gradient.iter_mut().zip(&self.canvas);
        for (tile, (gradient, canvas)) in tiles.take(grid.tiles()).enumerate() {
            for_each_pixel(grid, tile, |patch, lane, at| {
                let median = canvas.planes[MEDIAN][patch][lane];
                let surface = input.depth.and_then(|map| map.known_depth(at)).unwrap_or(median);
                gradient.planes[FRONT][patch][lane] = surface * (1.0 - input.request.margin);
            });
        }
    }

    /// Measures the requested columns in the current view.
    fn columns(&mut self, frame: &Frame, wanted: &[AuxColumn]) -> Vec<(AuxColumn, Vec<f32>)> {
        let Frame { grid, bands, .. } = frame;
        let blending = self.shortcuts.into();
        self.reserve_sums(self.signals.layout());
        let Self { threads, arch, lists, splats, records, sums, visible, gradient, rows, .. } =
            self;
        let rows = *rows;
        let sums = &mut sums[..rows * STRIDE];
        let dominant = &self.dominant;
        let is_seen = |row: usize| visible[row / WIDTH] >> (row % WIDTH) & 1 == 1;
        threads.install(|| {
            let visible = &visible[..rows.div_ceil(WIDTH)];
            for band in bands {
                if bands.len() > 1 {
                    let visible = Visible { splats: &splats[..rows], seen: visible };
                    lists.refill(threads, visible, grid, band);
                }
                let mut fresh = band.start == 0;
                for part in parts(threads, lists, band.len(), records.len() / STRIDE) {
                    threads.each_with("replay", part.tiles.clone(), Batch::new, |batch, i| {
                        let tile = band.start + i;
                        arch.dispatch(Replay {
                            splats,
                            list: lists.of_tile(i),
                            place: TilePlace::new(grid, tile),
                            blending,
                            map: &gradient[tile].planes[MAP],
                            front: &gradient[tile].planes[FRONT],
                            records: part.records(lists, i, records, STRIDE),
                            batch,
                        });
                    });
                    let to = Sums { sums, stride: STRIDE, fresh, visible };
                    let add = |sums: &mut [f32], records: &[AtomicU32]| {
                        gather_all::<STRIDE>(sums, true, records);
                    };
                    part.gather(threads, lists, records, to, add);
                    fresh = false;
                }
            }
        });
        let value = |column: AuxColumn, row: usize| match column {
            _ if !is_seen(row) => 0.0,
            AuxColumn::MapSum => sums[row * STRIDE],
            AuxColumn::PixelCount => sums[row * STRIDE + 1],
            AuxColumn::WeightSum => sums[row * STRIDE + 2],
            AuxColumn::DistanceSum => sums[row * STRIDE + 3],
            AuxColumn::WeightInFront => sums[row * STRIDE + 4],
            AuxColumn::WeightMax => sums[row * STRIDE + MAXIMUM],
            AuxColumn::DominantPixels => dominant[row].load(Relaxed) as f32,
            AuxColumn::Depth => splats[row].depth,
            AuxColumn::Radius => radius(&splats[row]),
        };
        wanted.iter().map(|&c| (c, (0..rows).map(|row| value(c, row)).collect())).collect()
    }
}

/// The [radius](radius_px) of a splat `[px]`.
fn radius(splat: &Splat) -> f32 {
    // The splat's conic factor is scaled.
    let scale = super::project::EXPONENT_SCALE;
    radius_px(scale / splat.l1, splat.shear, scale / splat.l3)
}

/// Replays the blending of one tile.
struct Replay<'a> {
    splats: &'a [Splat],
    /// The tile's entries, sorted front to back.
    list: &'a [AtomicU64],
    place: TilePlace,
    /// The settings of the forward pass.
    blending: Blending,
    map: &'a Plane,
    front: &'a Plane,
    /// The records of this tile's entries; only entries in the current [`Part`](super::records::Part) have one.
    records: TileRecords<'a>,
    /// Scratch.
    batch: &'a mut Batch,
}

impl WithSimd for Replay<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { splats, list, place, blending, map, front, records, batch } = self;
        let c = |x: f32| V::splat(s, x);
        let zero = V::zero(s);
        let (mut transmittance, mut unfinished) = place.inside();
        for (n, chunk) in list.chunks(BATCH).enumerate() {
            batch.set(s, splats, chunk, &place);
            for (i, entry) in chunk.iter().enumerate() {
                let splat = &batch.splats[i];
                let (mx, my) = (splat.mean[0] - place.x, splat.mean[1] - place.y);
                let mut todo = batch.patches_of[i] & unfinished;
                let mut sums = [zero; STRIDE];
                while todo != 0 {
                    let p = todo.trailing_zeros() as usize % PATCHES;
                    todo &= todo - 1;
                    for at in (0..WIDTH).step_by(S::F32_LANES) {
                        let Blended { blends, weight, .. } =
                            blend(s, batch, blending, [i, p, at], &mut transmittance[p]);
                        let dx = V::load(s, &LANE_X[at..]) + (CORNER_X[p] - mx);
                        let dy = V::load(s, &LANE_Y[at..]) + (CORNER_Y[p] - my);
                        let distance = (dx * dx + dy * dy).sqrt();
                        sums[0] = sums[0] + blends.keep(V::load(s, &map[p][at..]));
                        sums[1] = sums[1] + blends.keep(c(1.0));
                        sums[2] = sums[2] + weight;
                        sums[3] = sums[3] + blends.keep(distance);
                        let in_front = c(splat.depth).lt(V::load(s, &front[p][at..]));
                        sums[4] = sums[4] + in_front.keep(weight);
                        sums[MAXIMUM] = sums[MAXIMUM].max(weight);
                    }
                    if is_finished(&transmittance[p]) {
                        unfinished &= !(1 << p);
                    }
                }
                let record = records.record(Entry::load(entry), n * BATCH + i);
                for (i, (to, sum)) in record.into_iter().flatten().zip(sums).enumerate() {
                    let total = if i == MAXIMUM { sum.max_lane() } else { sum.sum() };
                    to.store(total.to_bits(), Relaxed);
                }
            }
        }
    }
}
