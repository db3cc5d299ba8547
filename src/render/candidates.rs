//! The list of candidates for new rows, the same for every backend: the worst pixels of a view
//! (*Gaussians on a Diet*, arXiv 2604.20046, "compensation").

use std::cmp::Ordering;
use std::collections::HashMap;

use densify_policies::policy::{Candidate, CandidateRequest, ErrorMap, ErrorMode};

use super::{StateError, Tensor};
use densify_core::colour::ColourTransform;
use densify_core::image::Image8;

/// The list, and what goes into it.
#[derive(Debug)]
pub(super) struct Candidates {
    request: Option<CandidateRequest>,
    list: Vec<Candidate>,
    ranking: Vec<Ranked>,
}

/// What a photograph shows of the scene.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shown<'a> {
    pub(super) target: &'a Image8,
    pub(super) background: [f32; 3],
    pub(super) exposure: Option<&'a ColourTransform>,
}

impl<'a> Shown<'a> {
    /// The scene's colour in a pixel (x, y), without the photograph's exposure.
    pub(super) fn colours(self) -> impl Fn(usize, usize) -> [f32; 3] + Sync + 'a {
        let Self { target, background, exposure } = self;
        let back = exposure.map(ColourTransform::inverse);
        move |x, y| {
            let seen = target.composited(x, y, background);
            back.map_or(seen, |back| back.apply(seen))
        }
    }
}

/// Error and number of a pixel of one view.
pub(super) type Ranked = (f32, u32);

/// Pixels ranked beyond those wanted, so that enough remain after spacing.
const SPARE: usize = 16;
/// Numbers of a candidate in a checkpoint.
const NUMBERS: usize = 8;

impl Candidates {
    pub(super) fn new(request: Option<CandidateRequest>) -> Self {
        let capacity = request.map_or(0, |r| r.capacity);
        Self { request, list: Vec::with_capacity(capacity), ranking: Vec::new() }
    }

    /// Bytes of the list, and of the ranking of an image of so many pixels.
    pub(super) fn bytes(request: Option<CandidateRequest>, pixels: usize) -> u64 {
        let ranking = pixels * size_of::<Ranked>();
        request.map_or(0, |r| (r.capacity * size_of::<Candidate>() + ranking) as u64)
    }

    pub(super) fn list(&self) -> &[Candidate] {
        &self.list
    }

    pub(super) fn push(&mut self, candidate: Candidate) {
        self.list.push(candidate);
    }

    pub(super) fn clear(&mut self) {
        self.list.clear();
    }

    /// Whether a policy wants any.
    pub(super) fn is_wanted(&self) -> bool {
        self.request.is_some()
    }

    /// The list as an array of a backend's state.
    pub(super) fn tensor(&self, name: &str) -> Tensor {
        let numbers = |c: &Candidate| {
            let ([x, y, z], [r, g, b]) = (c.position, c.colour);
            [x, y, z, r, g, b, c.pixel_size, c.error]
        };
        let values = self.list.iter().flat_map(numbers).collect();
        Tensor::f32(name, &[self.list.len(), NUMBERS], values)
    }

    /// Takes back what [`tensor`](Self::tensor) returned.
    pub(super) fn restore(&mut self, tensor: Tensor) -> Result<(), StateError> {
        let most = self.request.map_or(0, |r| r.capacity);
        let count = tensor.shape.first().copied().unwrap_or(0);
        if count > most {
            return Err(tensor.error(format!("{count} of them; this run holds {most}")));
        }
        let values = tensor.into_f32(&[count, NUMBERS])?;
        let candidate = |&[x, y, z, r, g, b, pixel_size, error]: &[f32; NUMBERS]| Candidate {
            position: [x, y, z],
            colour: [r, g, b],
            pixel_size,
            error,
        };
        self.list.clear();
        self.list.extend(values.as_chunks().0.iter().map(candidate));
        Ok(())
    }

    /// What to take of the view of `step`, if anything: the request, and how many.
    pub(super) fn open(&self, step: u32, rows: usize) -> Option<(CandidateRequest, usize)> {
        let r = self.request.filter(|r| r.from < step && step < r.until)?;
        let count = rows / r.rows_per_candidate.max(1) as usize;
        let room = r.capacity.saturating_sub(self.list.len());
        Some((r, count.min(room))).filter(|&(_, count)| count > 0)
    }

    /// The `count` worst pixels, worst first; `error(x, y)` is None where no candidate may be.
    /// Equal errors are ordered by pixel number.
    #[cfg_attr(
        not(any(test, feature = "gpu")),
        expect(dead_code, reason = "only the GPU backend asks")
    )]
    pub(super) fn worst(
        &mut self,
        width: usize,
        height: usize,
        count: usize,
        spaced: bool,
        error: impl Fn(usize, usize) -> Option<f32>,
    ) -> Vec<(usize, usize, f32)> {
        let rank = |ranking: &mut Vec<Ranked>, _| {
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

    /// The same, where the pixels that may be among them are known, and their errors: at least
    /// [`ranked`] of the worst.
    #[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "only the GPU backend asks"))]
    pub(super) fn worst_of(
        &mut self,
        size: [usize; 2],
        count: usize,
        spaced: bool,
        known: impl IntoIterator<Item = (f32, u32)>,
    ) -> Vec<(usize, usize, f32)> {
        let known: Vec<Ranked> = known.into_iter().collect();
        let errors: HashMap<u32, f32> = known.iter().map(|&(e, pixel)| (pixel, e)).collect();
        // What is not known is less.
        let error = |x: usize, y: usize| errors.get(&((y * size[0] + x) as u32)).copied();
        let rank = |ranking: &mut Vec<Ranked>, _| {
            *ranking = known;
            ranking.len()
        };
        self.worst_by(size, count, spaced, rank, error)
    }

    /// The same, where `rank(list, n)` writes pixels to the head of the list, the `n` worst among them,
    /// and returns how many.
    pub(super) fn worst_by(
        &mut self,
        [width, height]: [usize; 2],
        count: usize,
        spaced: bool,
        rank: impl FnOnce(&mut Vec<Ranked>, usize) -> usize,
        error: impl Fn(usize, usize) -> Option<f32>,
    ) -> Vec<(usize, usize, f32)> {
        let ranked = ranked(count, spaced);
        let held = rank(&mut self.ranking, ranked);
        let kept = keep_worst(&mut self.ranking[..held], ranked);
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

/// A larger error comes first; of equal ones, the pixel with the lower number.
fn worse(a: &Ranked, b: &Ranked) -> Ordering {
    b.0.total_cmp(&a.0).then(a.1.cmp(&b.1))
}

/// Brings the `most` worst to the head, in any order; returns how many they are.
pub(super) fn keep_worst(ranking: &mut [Ranked], most: usize) -> usize {
    if ranking.len() > most {
        ranking.select_nth_unstable_by(most, worse);
    }
    ranking.len().min(most)
}

/// How many of the worst pixels are looked at for `count` candidates.
pub(super) fn ranked(count: usize, spaced: bool) -> usize {
    if spaced { count.saturating_mul(SPARE) } else { count }
}

/// Whether the error of a pixel needs the loss's error map, and then its weights of |e| and
/// 1 − SSIM.
pub(super) fn error_weights(mode: ErrorMode) -> Option<[f32; 2]> {
    match mode {
        ErrorMode::Gradient => None,
        ErrorMode::L1 => Some(ErrorMap::L1.weights()),
        ErrorMode::L1Dssim => Some(ErrorMap::Loss.weights()),
    }
}
