//! Measures single views for a policy: candidates for new rows while training, and auxiliary views at its events. In
//! training the device lists the pixels with the largest errors, from which the host selects; in auxiliary views the
//! host samples pixels from a copy of the image. The device then finds the surface points of these pixels and, in
//! auxiliary views, computes sums over each row's pixels.

use densify_policies::policy::{
    AuxColumn, AuxRequest, Candidate, CandidateRequest, DepthMode, ErrorMode,
};

use super::GpuBackend;
use super::frame::Frame;
use super::passes::{COLUMNS, ErrorPlace, Search, Shape};
use super::rows::{DEPTH, SPLAT};
use super::sizes::OPS_BYTES;
use crate::candidates::{Photograph, count_to_rank};
use crate::cpu::EXPONENT_SCALE;
use crate::pixel_map::{pixel_map, radius_px, sample_pixels};
use crate::{AuxInput, AuxOutput, BackendError, assert_same_size};

/// A rendered view, with its lists and its image on the device.
pub(super) struct RenderedView<'a> {
    pub(super) frame: Frame,
    pub(super) shape: Shape,
    pub(super) photograph: Photograph<'a>,
}

impl GpuBackend {
    /// The search for candidates in a view of this size; `None` if the result would not fit.
    pub(super) fn search(
        &self,
        request: &CandidateRequest,
        count: usize,
        [width, height, ..]: [u32; 4],
    ) -> Option<Search> {
        // The result begins with its length.
        let ranges = self.sizes.ranges();
        let bytes = ranges.iter().find(|range| range.name == "worst").map_or(0, |r| r.bytes);
        let room = (bytes / 8).saturating_sub(1).min(u32::MAX.into()) as usize;
        let wanted = count_to_rank(count, request.spaced);
        (wanted <= room).then_some(Search {
            pixels: width * height,
            wanted: wanted as u32,
            room: room as u32,
            min_alpha: request.min_alpha,
            error: self.error_place(request),
        })
    }

    fn error_place(&self, request: &CandidateRequest) -> ErrorPlace {
        match request.error {
            ErrorMode::Gradient => ErrorPlace::Gradient,
            ErrorMode::L1 | ErrorMode::L1Dssim if self.sizes.with_error => ErrorPlace::Buffer,
            ErrorMode::L1 | ErrorMode::L1Dssim => ErrorPlace::Canvas,
        }
    }

    /// Adds the pixels with the largest errors to the candidates. `search` is the search that the device has done, if
    /// any.
    pub(super) fn collect_candidates(
        &mut self,
        rendered: &RenderedView<'_>,
        request: &CandidateRequest,
        count: usize,
        search: Option<Search>,
    ) -> Result<(), BackendError> {
        let found = match search {
            Some(search) => self.search_result(&search)?,
            None => None,
        };
        let worst = match found {
            Some(found) => {
                let [width, height, ..] = rendered.frame.image.map(|n| n as usize);
                self.candidates.worst_of([width, height], count, request.spaced, found)
            }
            None => self.worst_of_all(rendered, request, count)?,
        };
        let points = self.surface_points(rendered, &worst, request.depth)?;
        self.candidates.list.extend(points);
        Ok(())
    }

    /// The pixels that a search has found, with their errors; `None` if there are more than fit, as in an image with
    /// the same error everywhere.
    fn search_result(&self, search: &Search) -> Result<Option<Vec<(f32, u32)>>, BackendError> {
        // The pixels wanted, and a few whose errors equal that of the last one.
        let likely = (search.wanted + 63).min(search.room);
        let mut read = self.read("worst", 0, 8 * (1 + u64::from(likely)))?;
        let count = read[0].to_bits();
        if count > search.room {
            return Ok(None);
        }
        if count > likely {
            read = self.read("worst", 0, 8 * (1 + u64::from(count)))?;
        }
        let pairs = read.as_chunks::<2>().0[1..].iter().take(count as usize);
        Ok(Some(pairs.map(|[error, pixel]| (*error, pixel.to_bits())).collect()))
    }

    /// The pixels with the largest errors, selected on the host from a copy of all errors.
    fn worst_of_all(
        &mut self,
        rendered: &RenderedView<'_>,
        request: &CandidateRequest,
        count: usize,
    ) -> Result<Vec<(usize, usize, f32)>, BackendError> {
        let [width, height, ..] = rendered.frame.image.map(|n| n as usize);
        let pixels = width * height;
        // Per pixel: its final transmittance and its last entry.
        let finish = self.read("finish", 0, 8 * pixels as u64)?;
        let place = self.error_place(request);
        let error: Vec<f32> = if place == ErrorPlace::Buffer {
            self.read("error", 0, 4 * pixels as u64)?
        } else {
            let canvas = self.read("canvas", 0, 16 * pixels as u64)?;
            let error = |&[r, g, b, error]: &[f32; 4]| match place {
                ErrorPlace::Gradient => (r * r + g * g + b * b).sqrt(),
                ErrorPlace::Canvas | ErrorPlace::Buffer => error,
            };
            canvas.as_chunks::<4>().0.iter().map(error).collect()
        };
        let at = |x: usize, y: usize| {
            let pixel = y * width + x;
            (1.0 - finish[2 * pixel] >= request.min_alpha).then(|| error[pixel])
        };
        Ok(self.candidates.worst(width, height, count, request.spaced, at))
    }

    /// The surface points of some pixels (x, y, error) of the view, in order; pixels without a surface are skipped.
    fn surface_points(
        &self,
        rendered: &RenderedView<'_>,
        pixels: &[(usize, usize, f32)],
        mode: DepthMode,
    ) -> Result<Vec<Candidate>, BackendError> {
        let RenderedView { frame, shape, photograph } = rendered;
        let colour = photograph.scene_colours();
        let [width, ..] = frame.image;
        let focal = 0.5 * (frame.lens[0] + frame.lens[1]);
        let is_median = u32::from(mode == DepthMode::Median);
        let mut found = Vec::new();
        // A chunk must fit into the upload (one number per pixel), and its points into the buffer of the rows' sums
        // (four numbers per point).
        let sums = self.sizes.records.stride() * self.sizes.budget.total;
        let room = (OPS_BYTES as usize / 4).min(sums / 4);
        for chunk in pixels.chunks(room) {
            let numbers: Vec<u32> =
                chunk.iter().map(|&(x, y, _)| y as u32 * width + x as u32).collect();
            self.write("ops", bytemuck::cast_slice(&numbers));
            self.continue_view(*shape, |passes, to| {
                passes.surface(to, numbers.len() as u32, is_median, 0);
            });
            let points = self.read("row sums", 0, 16 * chunk.len() as u64)?;
            for (&(x, y, error), &[px, py, pz, depth]) in
                chunk.iter().zip(points.as_chunks::<4>().0)
            {
                let rendered = (depth > 0.0).then_some(([px, py, pz], depth));
                if let Some((position, depth)) = photograph.given_point(x, y).or(rendered) {
                    found.push(Candidate {
                        position,
                        colour: colour(x, y),
                        pixel_size: depth / focal,
                        error,
                    });
                }
            }
        }
        Ok(found)
    }

    /// Measures an auxiliary view.
    pub(super) fn observe_view(&mut self, input: &AuxInput<'_>) -> Result<AuxOutput, BackendError> {
        let AuxInput { camera, target, background, exposure, vignette, request, .. } = *input;
        assert_same_size(camera, target);
        self.fit_image(camera.width, camera.height)?;
        let mut frame = self.frame(camera, background, input.sh_degree);
        frame.draw[3] = self.load_photograph(input.view, target);
        let is_exposed = self.load_camera(&mut frame, exposure, vignette);
        let (state, shape) = self.run(&frame, |passes, to| {
            passes.forward(to);
            let pixels = camera.width * camera.height;
            if is_exposed {
                passes.expose(to, pixels);
            }
            if vignette.is_some() {
                passes.dim(to, pixels);
            }
            passes.loss(to, is_exposed, false);
        })?;
        let loss = state.output().loss;
        let image = self.rendering(camera.width, camera.height, is_exposed)?;
        let photograph = Photograph::from(input);
        let rendered = RenderedView { frame, shape, photograph };
        let points = if request.points == 0 {
            Vec::new()
        } else {
            let pixels = sample_pixels(&image.alpha, camera.width as usize, input);
            self.surface_points(&rendered, &pixels, DepthMode::MaxWeight)?
        };
        let columns = if request.columns.is_empty() {
            Vec::new()
        } else {
            let map = pixel_map(image.rgb.as_chunks::<3>().0, target, background, request.map);
            self.write("canvas", bytemuck::cast_slice(&map));
            let in_front = request.columns.contains(&AuxColumn::WeightInFront);
            if in_front {
                // Depths follow the map in the same buffer; 0: the device is to find the model's own.
                let known = |pixel| input.depth.and_then(|map| map.known_depth(pixel));
                let given: Vec<f32> =
                    (0..map.len()).map(|pixel| known(pixel).unwrap_or(0.0)).collect();
                self.write_at("canvas", 4 * map.len() as u64, &given);
            }
            self.continue_view(shape, |passes, to| {
                if in_front {
                    passes.fronts(to, map.len() as u32, 1.0 - request.margin);
                }
                passes.columns(to);
            });
            self.columns(request)?
        };
        Ok(AuxOutput { loss, columns, points })
    }

    /// Reads the columns that the last passes have computed.
    fn columns(&self, request: &AuxRequest) -> Result<Vec<(AuxColumn, Vec<f32>)>, BackendError> {
        let n = self.rows as u64;
        let sums = self.read("row sums", 0, (4 * COLUMNS) as u64 * n)?;
        let splats = self.read("splats", 0, (4 * SPLAT) as u64 * n)?;
        let counted = if self.sizes.counts_dominant { n } else { 0 };
        let dominant = self.read("dominant", 0, 4 * counted)?;
        let value = |column: AuxColumn, row: usize| {
            let splat = &splats[SPLAT * row..SPLAT * (row + 1)];
            if splat[DEPTH] <= 0.0 {
                return 0.0;
            }
            match column {
                AuxColumn::MapSum => sums[COLUMNS * row],
                AuxColumn::PixelCount => sums[COLUMNS * row + 1],
                AuxColumn::WeightSum => sums[COLUMNS * row + 2],
                AuxColumn::DistanceSum => sums[COLUMNS * row + 3],
                AuxColumn::WeightInFront => sums[COLUMNS * row + 4],
                AuxColumn::WeightMax => sums[COLUMNS * row + 5],
                AuxColumn::DominantPixels => dominant[row].to_bits() as f32,
                AuxColumn::Depth => splat[DEPTH],
                AuxColumn::Radius => {
                    let [l1, shear, l3] = [2, 3, 4].map(|i| splat[i]);
                    radius_px(EXPONENT_SCALE / l1, shear, EXPONENT_SCALE / l3)
                }
            }
        };
        let values = |c: &AuxColumn| (*c, (0..self.rows).map(|row| value(*c, row)).collect());
        Ok(request.columns.iter().map(values).collect())
    }
}
