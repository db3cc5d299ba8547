//! Weights of the pixel errors from which rows are scored: a power of the error, increased at edges.

use densify_policies::policy::ErrorScore;
use rayon::prelude::*;

use super::super::threads::Threads;
use super::STRIP;
use crate::pixel_map::{edge_at, edge_factor, luma_line};
use densify_core::image::Image8;

/// The edges of the current image, if they are used.
#[derive(Debug, Default)]
pub(super) struct PixelWeights {
    /// Luma and edge strength. Shape: `[height, width]` each.
    luma: Vec<u8>,
    edges: Vec<u8>,
    /// The weight that one unit of edge strength adds to a pixel.
    per_edge: f32,
    width: usize,
}

impl PixelWeights {
    /// Bytes for an image of `pixels` pixels.
    pub(super) fn bytes(pixels: usize, score: &ErrorScore) -> u64 {
        if score.edge > 0.0 { 2 * pixels as u64 } else { 0 }
    }

    /// Measures the edges of an image, if they are used.
    pub(super) fn measure(
        &mut self,
        threads: &Threads,
        target: &Image8,
        background: [f32; 3],
        score: &ErrorScore,
    ) {
        self.per_edge = 0.0;
        if score.edge <= 0.0 {
            return;
        }
        let [width, height] = [target.width, target.height].map(|side| side as usize);
        let pixels = width * height;
        self.width = width;
        for plane in [&mut self.luma, &mut self.edges] {
            if plane.len() < pixels {
                plane.resize(pixels, 0);
            }
        }
        let strips = self.luma[..pixels].par_chunks_mut(STRIP * width).enumerate();
        threads.each("luma", strips, |(i, strip)| {
            for (y, line) in (i * STRIP..).zip(strip.chunks_exact_mut(width)) {
                luma_line(target, background, y, line);
            }
        });
        let luma = &self.luma[..pixels];
        let strips = self.edges[..pixels].par_chunks_mut(STRIP * width).enumerate();
        let sums = threads.collect("edges", strips, |(i, strip)| {
            let mut sum = 0_u64;
            for (at, edge) in (i * STRIP * width..).zip(strip) {
                *edge = edge_at(luma, [width, height], at);
                sum += u64::from(*edge);
            }
            sum
        });
        self.per_edge = edge_factor(score.edge, sums.iter().sum(), pixels);
    }

    /// Applies power and edge weights to the errors of an image row.
    pub(super) fn apply(&self, score: &ErrorScore, y: usize, line: &mut [f32]) {
        if !score.is_plain_map() {
            for error in &mut *line {
                *error = power(error.max(0.0), score.power);
            }
        }
        if self.per_edge > 0.0 {
            for (error, &edge) in line.iter_mut().zip(&self.edges[y * self.width..]) {
                *error *= 1.0 + self.per_edge * f32::from(edge);
            }
        }
    }
}

/// Raises x to a power, quickly if the power is 1, 2 or 4.
fn power(x: f32, power: f32) -> f32 {
    match power {
        1.0 => x,
        2.0 => x * x,
        4.0 => (x * x) * (x * x),
        _ => x.powf(power),
    }
}
