//! The list of candidates for new rows, shared by both backends: surface points of the pixels with the largest error
//! (*Gaussians on a Diet*, arXiv 2604.20046, "compensation").

use std::cmp::Ordering;
use std::collections::HashMap;

use densify_policies::policy::{Candidate, CandidateRequest, ErrorMap, ErrorMode};

use super::{AuxInput, StateError, StepInput, Tensor};
use densify_core::camera::Camera;
use densify_core::colour::ColourTransform;
use densify_core::image::Image8;
use densify_core::image::depth::DepthMap;
use densify_core::vignette::Vignette;
use glam::DVec2;

/// The candidates collected so far, and the request that selects them.
#[derive(Debug)]
pub(super) struct Candidates {
    pub(super) request: Option<CandidateRequest>,
    pub(super) list: Vec<Candidate>,
    ranking: Vec<RankedPixel>,
}

/// A photograph with the camera, background, exposure, vignette and given depth of its view.
#[derive(Debug, Clone, Copy)]
pub(super) struct Photograph<'a> {
    camera: &'a Camera,
    target: &'a Image8,
    background: [f32; 3],
    exposure: Option<&'a ColourTransform>,
    vignette: Option<&'a Vignette>,
    depth: Option<&'a DepthMap>,
}

impl<'a> From<&StepInput<'a>> for Photograph<'a> {
    fn from(input: &StepInput<'a>) -> Self {
        let StepInput { camera, target, background, exposure, vignette, depth, .. } = *input;
        let depth = depth.map(|depth| depth.map);
        Self { camera, target, background, exposure, vignette, depth }
    }
}

impl<'a> From<&AuxInput<'a>> for Photograph<'a> {
    fn from(input: &AuxInput<'a>) -> Self {
        let AuxInput { camera, target, background, exposure, vignette, depth, .. } = *input;
        Self { camera, target, background, exposure, vignette, depth }
    }
}

impl<'a> Photograph<'a> {
    /// A function that returns the scene's colour at a pixel (x, y), with the vignette and the exposure undone.
    pub(super) fn scene_colours(self) -> impl Fn(usize, usize) -> [f32; 3] + Sync + 'a {
        let Self { target, background, exposure, vignette, .. } = self;
        let inverse = exposure.map(ColourTransform::inverse);
        move |x, y| {
            let seen = target.composited(x, y, background);
            let seen =
                vignette.map_or(seen, |vignette| vignette.undo(x, y, target.alpha_at(x, y), seen));
            inverse.map_or(seen, |inverse| inverse.apply(seen))
        }
    }

    /// The point at the given depth of a pixel (x, y) `[scene units]`, and this depth; `None` where it is unknown.
    pub(super) fn given_point(&self, x: usize, y: usize) -> Option<([f32; 3], f32)> {
        let depth = self.depth?.known_depth(y * self.camera.width as usize + x)?;
        let centre = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
        Some((self.camera.unproject(centre, depth.into()).as_vec3().to_array(), depth))
    }
}

/// The error of a pixel and its number, y·width + x.
pub(super) type RankedPixel = (f32, u32);

/// Number of pixels ranked per candidate, so that enough remain after spacing, which keeps only local maxima.
const RANKED_PER_CANDIDATE: usize = 16;
/// Values per candidate in a checkpoint.
const VALUES: usize = 8;

impl Candidates {
    pub(super) fn new(request: Option<CandidateRequest>) -> Self {
        let capacity = request.map_or(0, |r| r.capacity);
        Self { request, list: Vec::with_capacity(capacity), ranking: Vec::new() }
    }

    /// Bytes of the list, and of the ranking of an image's pixels.
    pub(super) fn bytes(request: Option<CandidateRequest>, pixels: usize) -> u64 {
        let ranking = pixels * size_of::<RankedPixel>();
        request.map_or(0, |r| (r.capacity * size_of::<Candidate>() + ranking) as u64)
    }

    /// The list as a state array.
    pub(super) fn tensor(&self, name: &str) -> Tensor {
        let numbers = |c: &Candidate| {
            let ([x, y, z], [r, g, b]) = (c.position, c.colour);
            [x, y, z, r, g, b, c.pixel_size, c.error]
        };
        let values = self.list.iter().flat_map(numbers).collect();
        Tensor::f32(name, &[self.list.len(), VALUES], values)
    }

    /// Restores the list from [`tensor`](Self::tensor).
    pub(super) fn restore(&mut self, tensor: Tensor) -> Result<(), StateError> {
        let capacity = self.request.map_or(0, |r| r.capacity);
        let count = tensor.shape.first().copied().unwrap_or(0);
        if count > capacity {
            let problem = format!("it has {count} candidates; this run holds at most {capacity}");
            return Err(tensor.error(problem));
        }
        let values = tensor.into_f32(&[count, VALUES])?;
        let candidate = |&[x, y, z, r, g, b, pixel_size, error]: &[f32; VALUES]| Candidate {
            position: [x, y, z],
            colour: [r, g, b],
            pixel_size,
            error,
        };
        self.list.clear();
        self.list.extend(values.as_chunks().0.iter().map(candidate));
        Ok(())
    }

    /// The request and the number of candidates to collect in the view of `step`, if any.
    pub(super) fn due(&self, step: u32, rows: usize) -> Option<(CandidateRequest, usize)> {
        let r = self.request.filter(|r| r.from < step && step < r.until)?;
        let count = rows / r.rows_per_candidate.max(1) as usize;
        let room = r.capacity.saturating_sub(self.list.len());
        Some((r, count.min(room))).filter(|&(_, count)| count > 0)
    }

    /// The `count` pixels with the largest error, in descending order, ties by pixel number; only local maxima if
    /// `spaced`. `error(x, y)` is `None` where no candidate is allowed.
    #[cfg_attr(
        not(any(test, feature = "gpu")),
        expect(dead_code, reason = "used by the GPU backend only")
    )]
    pub(super) fn worst(
        &mut self,
        width: usize,
        height: usize,
        count: usize,
        spaced: bool,
        error: impl Fn(usize, usize) -> Option<f32>,
    ) -> Vec<(usize, usize, f32)> {
        let rank = |ranking: &mut Vec<RankedPixel>, _| {
            ranking.clear();
            for y in 0..height {
                for x in 0..width {
                    if let Some(e) = error(x, y).filter(|&e| e > 0.0) {
                        ranking.push((e, (y * width + x) as u32));
                    }
                }
            }
            ranking.len()
        };
        self.worst_by([width, height], count, spaced, rank, &error)
    }

    /// Like [`worst`](Self::worst), for a list of pixels with their errors that includes at least the
    /// [`count_to_rank`] worst pixels of the image.
    #[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "used by the GPU backend only"))]
    pub(super) fn worst_of(
        &mut self,
        size: [usize; 2],
        count: usize,
        spaced: bool,
        known: impl IntoIterator<Item = (f32, u32)>,
    ) -> Vec<(usize, usize, f32)> {
        let known: Vec<RankedPixel> = known.into_iter().collect();
        let errors: HashMap<u32, f32> = known.iter().map(|&(e, pixel)| (pixel, e)).collect();
        // Pixels that are not listed have smaller errors.
        let error = |x: usize, y: usize| errors.get(&((y * size[0] + x) as u32)).copied();
        let rank = |ranking: &mut Vec<RankedPixel>, _| {
            *ranking = known;
            ranking.len()
        };
        self.worst_by(size, count, spaced, rank, error)
    }

    /// Like [`worst`](Self::worst), for a function `rank(list, n)` that writes at least the `n` worst pixels to the
    /// head of the list and returns how many it has written.
    pub(super) fn worst_by(
        &mut self,
        [width, height]: [usize; 2],
        count: usize,
        spaced: bool,
        rank: impl FnOnce(&mut Vec<RankedPixel>, usize) -> usize,
        error: impl Fn(usize, usize) -> Option<f32>,
    ) -> Vec<(usize, usize, f32)> {
        let wanted = count_to_rank(count, spaced);
        let written = rank(&mut self.ranking, wanted);
        let kept = keep_worst(&mut self.ranking[..written], wanted);
        let ranking = &mut self.ranking[..kept];
        ranking.sort_unstable_by(worse);
        let is_peak = |e: f32, pixel: u32| {
            let (x, y) = (pixel as usize % width, pixel as usize / width);
            let (x0, x1) = (x.saturating_sub(1), (x + 1).min(width - 1));
            let (y0, y1) = (y.saturating_sub(1), (y + 1).min(height - 1));
            (y0..=y1).all(|ny| {
                (x0..=x1).all(|nx| {
                    let other = (error(nx, ny).unwrap_or(0.0), (ny * width + nx) as u32);
                    other.1 == pixel || worse(&(e, pixel), &other).is_lt()
                })
            })
        };
        ranking
            .iter()
            .filter(|&&(e, pixel)| !spaced || is_peak(e, pixel))
            .take(count)
            .map(|&(e, pixel)| (pixel as usize % width, pixel as usize / width, e))
            .collect()
    }
}

/// Orders by descending error, then by pixel number.
fn worse(a: &RankedPixel, b: &RankedPixel) -> Ordering {
    b.0.total_cmp(&a.0).then(a.1.cmp(&b.1))
}

/// Moves the `count` worst pixels, or all if there are fewer, to the head in any order, and returns their number.
pub(super) fn keep_worst(ranking: &mut [RankedPixel], count: usize) -> usize {
    if ranking.len() > count {
        ranking.select_nth_unstable_by(count, worse);
    }
    ranking.len().min(count)
}

/// The number of pixels to rank for `count` candidates.
pub(super) fn count_to_rank(count: usize, spaced: bool) -> usize {
    if spaced { count.saturating_mul(RANKED_PER_CANDIDATE) } else { count }
}

/// The weights of |e| and 1 − SSIM in the loss's error map; `None` if the error is the gradient instead.
pub(super) fn error_weights(mode: ErrorMode) -> Option<[f32; 2]> {
    match mode {
        ErrorMode::Gradient => None,
        ErrorMode::L1 => Some(ErrorMap::L1.weights()),
        ErrorMode::L1Dssim => Some(ErrorMap::Loss.weights()),
    }
}
