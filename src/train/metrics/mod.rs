//! Image metrics (PSNR, SSIM, FLIP, LPIPS) and errors against a known surface ([`geometry`]).
//!
//! The image metrics compare a rendered image with an 8-bit target, both in sRGB encoding, and sum
//! in `f64`, so that results do not depend on the size of the image or the number of threads.
//! Renders are clamped to `[0, 1]` first, as in a viewer. A target with coverage (alpha) is composited on
//! the background of the render. A mask weights the pixels. It also scales the error of the render
//! before filtering, so that masked pixels do not affect their neighbours.

mod error;
mod flip;
pub mod geometry;
mod lpips;
mod psnr;
mod ssim;

pub use error::{EvaluateError, MetricError};
pub use flip::{flip, flip_map};
pub use lpips::{Lpips, LpipsError, Network};
pub use psnr::{psnr, psnr_between};
pub use ssim::ssim;

use std::ops::Range;
use std::sync::LazyLock;

use rayon::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use densify_core::image::Image8;

/// Number of pixel rows filtered together: few enough that the buffers take only a few megabytes, but so many that the
/// rows around a block, which the neighbouring blocks filter as well, are less than half of the work.
const BLOCK: usize = 32;
/// Largest number of blocks filtered in parallel, so that memory does not grow with the number of processor cores.
/// Blocks have their own threads, because the allocator keeps the buffers of every thread that ever filtered a block.
const PARALLEL_BLOCKS: usize = 4;
static THREADS: LazyLock<Option<ThreadPool>> = LazyLock::new(|| {
    let threads = rayon::current_num_threads().min(PARALLEL_BLOCKS);
    ThreadPoolBuilder::new().num_threads(threads).build().ok()
});

/// Memory for scoring an image of this width with a number of threads `[bytes]`: that of [`flip()`], the metric that
/// needs the most.
pub fn scratch_bytes(width: u32, threads: usize) -> u64 {
    flip::bytes_per_block(u64::from(width)) * threads.min(PARALLEL_BLOCKS) as u64
}

/// Applies a function to each block of rows of pixels in parallel; returns the results in order.
fn by_blocks<T: Send>(height: usize, function: impl Fn(Range<usize>) -> T + Sync) -> Vec<T> {
    let block = |first: usize| first..(first + BLOCK).min(height);
    let blocks: Vec<_> = (0..height).step_by(BLOCK).map(block).collect();
    match &*THREADS {
        Some(pool) => pool.install(|| blocks.into_par_iter().map(&function).collect()),
        None => blocks.into_iter().map(function).collect(),
    }
}

/// Adds up pairs of a weighted error and its weight, in order.
///
/// # Errors
/// When the total weight is 0.
fn total(sums: &[[f64; 2]]) -> Result<[f64; 2], MetricError> {
    let total = sums.iter().fold([0.0; 2], |sum, part| [sum[0] + part[0], sum[1] + part[1]]);
    if total[1] == 0.0 { Err(MetricError::NothingToCompare) } else { Ok(total) }
}

/// A render and a target of the same size.
struct Pair<'a> {
    rendered: &'a [f32],
    target: &'a Image8,
    background: [f64; 3],
    width: usize,
    height: usize,
}

impl<'a> Pair<'a> {
    fn new(
        rendered: &'a [f32],
        target: &'a Image8,
        background: [f32; 3],
    ) -> Result<Self, MetricError> {
        let (width, height) = (target.width as usize, target.height as usize);
        let pixels = width * height;
        let parts = [
            ("target's colours", Some(target.rgb.len()), 3 * pixels),
            ("target's coverage", target.alpha.as_ref().map(Vec::len), pixels),
            ("target's mask", target.mask.as_ref().map(Vec::len), pixels),
            ("render", Some(rendered.len()), 3 * pixels),
        ];
        for (part, found, expected) in parts {
            if let Some(found) = found.filter(|&found| found != expected) {
                let (width, height) = (target.width, target.height);
                return Err(MetricError::Size { part, found, expected, width, height });
            }
        }
        Ok(Self { rendered, target, background: background.map(f64::from), width, height })
    }

    /// Weight that the mask gives pixel `p`, in `[0, 1]`.
    fn weight(&self, p: usize) -> f64 {
        self.target.mask.as_ref().map_or(1.0, |mask| f64::from(mask[p]) / 255.0)
    }

    /// Channel `c` of pixel `p` of the target, composited on the background.
    fn truth(&self, p: usize, c: usize) -> f64 {
        let colour = f64::from(self.target.rgb[3 * p + c]) / 255.0;
        self.target.alpha.as_ref().map_or(colour, |alpha| {
            let coverage = f64::from(alpha[p]) / 255.0;
            coverage * colour + (1.0 - coverage) * self.background[c]
        })
    }

    /// Render minus target in channel `c` of pixel `p`; NaN if the render is NaN.
    fn error(&self, p: usize, c: usize) -> f64 {
        f64::from(self.rendered[3 * p + c]).clamp(0.0, 1.0) - self.truth(p, c)
    }
}
