//! The passes over a view: forward, image loss, backward, optimiser and candidates. Each splits its work into tasks
//! at fixed places and runs the stages' kernels on them. All are in one file because they share a frame.

use std::ops::Range;
use std::sync::atomic::Ordering::Relaxed;

use densify_policies::policy::{Candidate, CandidateRequest, DepthMode, ErrorMode};
use densify_policies::rng::PolicyRng;
use rayon::prelude::*;

use super::batch::Batch;
use super::blocks::parts;
use super::candidates;
use super::depth_channel::DepthChannel;
use super::depth_gradient::GivenTile;
use super::loss::{ErrorRequests, LossValue};
use super::optimise::{DifferentiatePose, Optimise};
use super::project::{Project, ViewParams};
use super::rasterize::{
    Blending, CANVAS_PLANES, DEPTH, DepthPlane, Rasterize, TRANSMITTANCE, TileCanvas, TilePlace,
    ZERO_PLANE, in_plane,
};
use super::rasterize_bwd::{RasterizeBwd, TileGradient};
use super::records::{Sums, gather, parts as parts_of_records};
use super::regularise::{Noise, Terms};
use super::simd::WIDTH;
use super::tiles::{Grid, TILE, Visible};
use super::{BLOCKS_PER_TASK, CpuBackend, MAX_SIDE, ROWS_PER_TASK};
use crate::candidates::Photograph;
use crate::signals::RecordLayout;
use crate::{BackendError, Rendering, StepInput, StepOutput};
use densify_core::camera::Camera;
use densify_core::image::Image8;
use densify_core::pose::{PoseGradient, TWIST_VALUES};

/// A view between its forward and its backward pass.
pub(super) struct Frame {
    pub(super) view: ViewParams,
    pub(super) grid: Grid,
    pub(super) background: [f32; 3],
    pub(super) bands: Vec<Range<usize>>,
    pub(super) entries: u64,
    pub(super) visible: usize,
}

impl CpuBackend {
    pub(super) fn resize_images(&mut self, grid: &Grid) {
        let tiles = grid.tiles();
        // Never shrinks, so that views of alternating sizes do not initialise the additional tiles each time.
        if self.canvas.len() < tiles {
            self.canvas.resize(tiles, TileCanvas::EMPTY);
            self.gradient.resize(tiles, TileGradient { planes: [ZERO_PLANE; 5] });
        }
    }

    pub(super) fn image_loss(
        &mut self,
        grid: &Grid,
        target: &Image8,
        background: [f32; 3],
        requests: ErrorRequests,
    ) -> LossValue {
        let Self { threads, loss, arch, canvas, gradient, clock, .. } = self;
        let (canvas, gradient) = (&canvas[..grid.tiles()], &mut gradient[..grid.tiles()]);
        let value = threads.install(|| {
            loss.run(threads, *arch, grid, canvas, target, background, gradient, requests)
        });
        clock.lap("loss");
        value
    }

    /// Stages 1–3; `colours`, if given, replace the rows' own colours. Afterwards the canvas holds the image and, if
    /// there is only one band, the lists hold its entries.
    pub(super) fn forward(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        depth_plane: DepthPlane<'_>,
        colours: Option<&[[f32; 3]]>,
    ) -> Result<Frame, BackendError> {
        if camera.width > MAX_SIDE || camera.height > MAX_SIDE {
            return Err(BackendError::ImageTooLarge {
                width: camera.width,
                height: camera.height,
                max: MAX_SIDE,
            });
        }
        let grid = Grid::new(camera.width, camera.height);
        self.resize_images(&grid);
        let view =
            ViewParams::new(camera, self.near, sh_degree.min(self.sh_degree), self.antialiasing);
        let blending = Blending::from(self.shortcuts);
        let Self {
            threads,
            arch,
            lists,
            splats,
            visible: seen,
            params,
            dominant,
            canvas,
            rows,
            clock,
            ..
        } = self;
        let dominant = &dominant[..];
        clock.start();
        let (rows, arch) = (*rows, *arch);
        let params = &params.view(rows);
        threads.install(|| {
            let seen = &mut seen[..rows.div_ceil(WIDTH)];
            let parts = (
                splats[..rows].par_chunks_mut(ROWS_PER_TASK),
                seen.par_chunks_mut(BLOCKS_PER_TASK),
            );
            let tasks = parts.into_par_iter().enumerate();
            let visible_rows = threads.sum("project", tasks, |(task, (splats, seen))| {
                let (params, rows) = (params.task(task), splats.len());
                for pixels in dominant.iter().skip(task * ROWS_PER_TASK).take(rows) {
                    pixels.store(0, Relaxed);
                }
                let (view, log2_reach) = (&view, blending.log2_reach);
                let lanes = &mut *seen;
                let kernel =
                    Project { view, log2_reach, params, rows, splats: &mut *splats, seen: lanes };
                arch.dispatch(kernel);
                if let Some(colours) = colours {
                    let colours = &colours[task * ROWS_PER_TASK..];
                    splats.iter_mut().zip(colours).for_each(|(splat, &c)| splat.colour = c);
                }
                seen.iter().map(|seen| seen.count_ones() as usize).sum()
            });
            clock.lap("project");
            let visible = Visible { splats: &splats[..rows], seen };
            let (bands, entries) = lists.bands(threads, visible, &grid);
            for band in &bands {
                lists.fill(threads, visible, &grid, band.clone(), bands.len() == 1);
                clock.lap("tiles");
                let tiles = canvas[band.clone()].par_iter_mut().enumerate();
                let scratch = || (Vec::new(), Batch::new());
                threads.each_with("rasterize", tiles, scratch, |(sorting, batch), (i, canvas)| {
                    lists.sort(i, sorting);
                    let place = TilePlace::new(&grid, band.start + i);
                    let given = match &depth_plane {
                        DepthPlane::Distance(loss) => Some(GivenTile::new(loss, &place).inverse),
                        _ => None,
                    };
                    arch.dispatch(Rasterize {
                        splats,
                        list: lists.of_tile(i),
                        place,
                        background,
                        depth_plane,
                        given: given.as_ref(),
                        dominant,
                        blending,
                        canvas,
                        batch,
                    });
                });
                clock.lap("rasterize");
            }
            Ok(Frame { view, grid, background, bands, entries, visible: visible_rows })
        })
    }

    /// Stage 5: computes the sum of each row's records, `self.sums`, from `self.gradient`.
    pub(super) fn backward(&mut self, frame: &Frame, layout: RecordLayout, depth: DepthChannel) {
        let Frame { grid, background, bands, .. } = frame;
        let blending = self.shortcuts.into();
        self.reserve_sums(layout);
        let Self {
            threads,
            arch,
            lists,
            splats,
            records,
            sums,
            visible,
            canvas,
            gradient,
            clock,
            rows,
            ..
        } = self;
        let stride = layout.stride();
        threads.install(|| {
            // Rows that no longer exist still have the slots of an older frame.
            let visible = &visible[..rows.div_ceil(WIDTH)];
            for band in bands {
                if bands.len() > 1 {
                    let visible = Visible { splats: &splats[..*rows], seen: visible };
                    lists.refill(threads, visible, grid, band);
                }
                let mut fresh = band.start == 0;
                let cap = records.len() / stride;
                for part in parts_of_records(threads, lists, band.len(), cap) {
                    let tiles = part.tiles.clone();
                    threads.each_with(
                        "rasterize_bwd",
                        tiles,
                        || (Batch::new(), bytemuck::zeroed_box()),
                        |(batch, blended), i| {
                            let tile = band.start + i;
                            arch.dispatch(RasterizeBwd {
                                splats,
                                list: lists.of_tile(i),
                                place: TilePlace::new(grid, tile),
                                background: *background,
                                blending,
                                canvas: &canvas[tile],
                                upstream: &gradient[tile],
                                layout,
                                depth,
                                records: part.records(lists, i, records, stride),
                                batch,
                                blended,
                            });
                        },
                    );
                    clock.lap("rasterize_bwd");
                    let add = |sum: &mut [f32], records: &[_]| gather(sum, layout, records);
                    let to = Sums { sums, stride, fresh, visible };
                    part.gather(threads, lists, records, to, add);
                    fresh = false;
                    clock.lap("gather");
                }
            }
        });
    }

    /// Reallocates the sums if a reader of signals has not given their memory back, or if they are too small for these
    /// records.
    pub(super) fn reserve_sums(&mut self, layout: RecordLayout) {
        let needed = self.visible.len() * WIDTH * layout.stride();
        if self.sums.len() < needed {
            self.sums.resize(needed, 0.0);
        }
    }

    /// Adds the worst pixels of the view to the candidates.
    pub(super) fn collect_candidates(
        &mut self,
        frame: &Frame,
        photograph: Photograph<'_>,
        request: &CandidateRequest,
        count: usize,
    ) {
        let Frame { grid, .. } = frame;
        let Self { threads, canvas, gradient, loss, candidates, .. } = self;
        let place =
            |x: usize, y: usize| (y / TILE * grid.columns + x / TILE, in_plane(x % TILE, y % TILE));
        let error = |x: usize, y: usize| {
            let (tile, (patch, lane)) = place(x, y);
            let alpha = 1.0 - canvas[tile].planes[TRANSMITTANCE][patch][lane];
            (alpha >= request.min_alpha).then(|| match request.error {
                ErrorMode::Gradient => {
                    let g = |channel: usize| gradient[tile].planes[channel][patch][lane];
                    (g(0) * g(0) + g(1) * g(1) + g(2) * g(2)).sqrt()
                }
                ErrorMode::L1 | ErrorMode::L1Dssim => loss.error_at(x, y),
            })
        };
        let size = [grid.width, grid.height];
        let rank = |ranking: &mut Vec<_>, most| {
            threads.install(|| candidates::rank(threads, ranking, size, most, error))
        };
        let worst = candidates.worst_by(size, count, request.spaced, rank, error);
        let points = self.surface_points(frame, photograph, &worst, request.depth);
        self.candidates.list.extend(points);
    }

    /// The surface points of pixels (x, y, error) of the view, in order; pixels without a surface are skipped.
    pub(super) fn surface_points(
        &mut self,
        frame: &Frame,
        photograph: Photograph<'_>,
        pixels: &[(usize, usize, f32)],
        mode: DepthMode,
    ) -> Vec<Candidate> {
        let Frame { grid, bands, view, .. } = frame;
        let colour = photograph.scene_colours();
        let shortcuts = self.shortcuts;
        let Self { threads, lists, splats, params, visible, .. } = self;
        let visible = Visible { splats: &splats[..self.rows], seen: visible };
        let tile = |x: usize, y: usize| y / TILE * grid.columns + x / TILE;
        let focal = 0.5 * (view.focal[0] + view.focal[1]);
        let mut points: Vec<Option<Candidate>> = vec![None; pixels.len()];
        for band in bands {
            let is_in_band = |x: usize, y: usize| band.contains(&tile(x, y));
            if bands.len() > 1 && pixels.iter().any(|&(x, y, _)| is_in_band(x, y)) {
                threads.install(|| lists.refill(threads, visible, grid, band));
            }
            let lists = &*lists;
            let tasks = points.par_iter_mut().zip(pixels);
            let point_of =
                |(point, &(x, y, error)): (&mut Option<Candidate>, &(usize, usize, f32))| {
                    if !is_in_band(x, y) {
                        return;
                    }
                    let at = [x as f32 + 0.5, y as f32 + 0.5];
                    let list = lists.of_tile(tile(x, y) - band.start);
                    let rendered = || {
                        candidates::surface_row(splats, list, at, shortcuts, mode)
                            .and_then(|row| candidates::closest_approach(params, row, view, at))
                            .map(|(position, depth)| (position.to_array(), depth))
                    };
                    let surface = photograph.given_point(x, y).or_else(rendered);
                    *point = surface.map(|(position, depth)| Candidate {
                        position,
                        colour: colour(x, y),
                        pixel_size: depth / focal,
                        error,
                    });
                };
            threads.install(|| threads.each("surface points", tasks, point_of));
        }
        points.into_iter().flatten().collect()
    }

    pub(super) fn rendering(&self, frame: &Frame) -> Rendering {
        let grid = &frame.grid;
        let pixels = grid.width * grid.height;
        let mut out = Rendering {
            width: grid.width as u32,
            height: grid.height as u32,
            rgb: vec![0.0; 3 * pixels],
            alpha: vec![0.0; pixels],
            depth: vec![0.0; pixels],
        };
        for (tile, canvas) in self.canvas[..grid.tiles()].iter().enumerate() {
            for_each_pixel(grid, tile, |patch, lane, at| {
                for channel in 0..3 {
                    out.rgb[3 * at + channel] = canvas.planes[channel][patch][lane];
                }
                out.alpha[at] = 1.0 - canvas.planes[TRANSMITTANCE][patch][lane];
                out.depth[at] = canvas.planes[DEPTH][patch][lane];
            });
        }
        out
    }

    /// Stages 6–8 in one pass over the rows, so that gradients stay in the cache. Returns the gradient with respect to
    /// the pose, if the step asks for it.
    pub(super) fn optimise(
        &mut self,
        frame: &Frame,
        input: &StepInput<'_>,
        layout: RecordLayout,
    ) -> Option<PoseGradient> {
        let Self {
            threads, arch, params, moments, masks, ages, signals, sums, visible, bias, ..
        } = self;
        let dominant = &self.dominant[..self.rows.min(self.dominant.len())];
        let (rows, frozen, arch) = (self.rows, self.budget.frozen, *arch);
        let trained = self.budget.trained(rows);
        let terms = Terms::new(input.loss_terms, trained);
        let noise = input.noise.map(|term| Noise::new(term, input));
        let due = self.summed.advance(input);
        let planes = signals.planes;
        let signal_stride = signals.blocks.stride();
        let rounding_rng = PolicyRng::new(input.seed, input.step);
        // Tasks that have only frozen rows are skipped.
        let first_row = moments.first();
        let blocks = first_row / WIDTH..rows.div_ceil(WIDTH);
        let tasks = blocks.len().div_ceil(BLOCKS_PER_TASK);
        let per_task = signal_stride * BLOCKS_PER_TASK;
        let sums = &sums[first_row * layout.stride()..blocks.end * WIDTH * layout.stride()];
        let parts = (
            params.tasks(rows).skip(first_row / ROWS_PER_TASK),
            moments.tasks(rows),
            masks.tasks(rows, trained),
            ages.of_rows_mut(rows).par_chunks_mut(ROWS_PER_TASK),
            parts(signals.blocks.of_rows_mut(rows), per_task, tasks),
            sums.par_chunks(ROWS_PER_TASK * layout.stride()),
            visible[blocks].par_chunks(BLOCKS_PER_TASK),
            self.summed.tasks(rows, tasks).enumerate(),
        );
        let name = "project_bwd + adam";
        let view = ViewParams { differentiates_pose: input.pose, ..frame.view };
        let run = |(params, moments, masks, ages, signals, sums, visible, (task, summed))| {
            let first_row = first_row + task * ROWS_PER_TASK;
            arch.dispatch(Optimise {
                params,
                moments,
                masks,
                rounding_rng: &rounding_rng,
                ages,
                signals,
                planes,
                dominant,
                sums,
                layout,
                visible,
                view: &view,
                rates: &input.rates,
                bias,
                summed,
                due,
                terms,
                noise,
                first_row,
                frozen: frozen.saturating_sub(first_row),
                rows: rows - first_row,
            })
        };
        if !input.pose {
            threads.install(|| threads.each(name, parts, |part| _ = run(part)));
            return None;
        }
        Some(total_twist(threads.install(|| threads.collect(name, parts, run))))
    }

    /// The gradient with respect to the pose, without a step.
    pub(super) fn pose_gradient(&mut self, frame: &Frame, layout: RecordLayout) -> PoseGradient {
        let Self { threads, arch, params, sums, visible, rows, .. } = self;
        let view = ViewParams { differentiates_pose: true, ..frame.view };
        let params = params.view(*rows);
        let parts = (
            visible[..rows.div_ceil(WIDTH)].par_chunks(BLOCKS_PER_TASK),
            sums.par_chunks(ROWS_PER_TASK * layout.stride()),
        );
        let run = |(task, (visible, sums))| {
            let params = params.task(task);
            arch.dispatch(DifferentiatePose { params, sums, layout, visible, view: &view })
        };
        let parts = parts.into_par_iter().enumerate();
        total_twist(threads.install(|| threads.collect("project_bwd", parts, run)))
    }
}

/// The sum of the derivatives of all tasks, in order.
fn total_twist(parts: Vec<[f64; TWIST_VALUES]>) -> PoseGradient {
    let mut total = [0.0; TWIST_VALUES];
    for part in parts {
        for (total, part) in total.iter_mut().zip(part) {
            *total += part;
        }
    }
    PoseGradient::from_array(total)
}

/// Calls `f(patch, lane, pixel of the image)` for every pixel of a tile inside the image.
pub(super) fn for_each_pixel(grid: &Grid, tile: usize, f: impl FnMut(usize, usize, usize)) {
    TilePlace::new(grid, tile).for_each_pixel(grid.width, f);
}

pub(super) fn scalars(value: LossValue) -> StepOutput {
    StepOutput {
        loss: value.loss() as f32,
        l1: value.l1 as f32,
        ssim: value.ssim as f32,
        ..StepOutput::default()
    }
}

const _: () = assert!(CANVAS_PLANES == 5, "a tile's gradient mirrors its canvas");
