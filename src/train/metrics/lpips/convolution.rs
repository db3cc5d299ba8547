//! Convolution followed by ReLU, as products of small matrices.
//!
//! Sixteen pixels are processed together. The kernel's inputs for them are gathered once and then multiplied by the
//! weights of six outputs at a time, whose 6×16 sums stay in registers.

use std::ops::Range;

use pulp::Arch;
use rayon::prelude::*;

use super::network::Activation;
use crate::metrics::THREADS;

/// Number of pixels processed together.
const PIXELS: usize = 16;
/// Number of outputs processed together.
const OUTPUTS: usize = 6;

/// A convolution followed by ReLU.
#[derive(Debug)]
pub(super) struct Convolution {
    /// Numbers of input and output channels.
    pub(super) channels: [usize; 2],
    side: usize,
    stride: usize,
    padding: usize,
    /// Weights, padded with zeros for outputs beyond the last. Shape: `[outputs / 6, input channels · side · side, 6]`.
    weights: Vec<[f32; OUTPUTS]>,
    /// Biases. Shape: `[outputs]`.
    bias: Vec<f32>,
}

impl Convolution {
    /// A convolution with published weights. Shapes: `[outputs, inputs, side, side]`, `[outputs]`.
    pub(super) fn new(
        channels: [usize; 2],
        (side, stride, padding): (usize, usize, usize),
        weights: &[f32],
        bias: Vec<f32>,
    ) -> Self {
        let inputs = channels[0] * side * side;
        let groups = channels[1].div_ceil(OUTPUTS);
        let weight = |output: usize, at: usize| {
            if output < channels[1] { weights[output * inputs + at] } else { 0.0 }
        };
        let weights = (0..groups)
            .flat_map(|group| (0..inputs).map(move |at| (group, at)))
            .map(|(group, at)| std::array::from_fn(|i| weight(group * OUTPUTS + i, at)))
            .collect();
        Self { channels, side, stride, padding, weights, bias }
    }

    /// Side of the result for an image of this side `[px]`; 0 if the image is too small.
    pub(super) fn output_side(&self, side: usize) -> usize {
        (side + 2 * self.padding).checked_sub(self.side).map_or(0, |rest| rest / self.stride + 1)
    }

    /// The rows of an image of this height on which `rows` of the result depend.
    pub(super) fn input_rows(&self, rows: &Range<usize>, height: usize) -> Range<usize> {
        let first = (rows.start * self.stride).saturating_sub(self.padding);
        let end =
            (rows.end.saturating_sub(1) * self.stride + self.side).saturating_sub(self.padding);
        first..end.min(height)
    }

    /// Computes `rows` of the result. `image` must contain the rows on which they depend, except those outside the
    /// whole image, which count as 0.
    pub(super) fn run(&self, image: &Activation, rows: Range<usize>) -> Activation {
        let width = self.output_side(image.width);
        let pixels = rows.len() * width;
        let chunks = pixels.div_ceil(PIXELS);
        let arch = Arch::new();
        let chunk = |chunk: usize| {
            let pixels = chunk * PIXELS..((chunk + 1) * PIXELS).min(pixels);
            let place = |pixel: usize| (rows.start + pixel / width, pixel % width);
            let inputs = self.gather(image, pixels.map(place));
            arch.dispatch(|| self.multiply(&inputs))
        };
        let all = || (0..chunks).into_par_iter().map(chunk).collect::<Vec<_>>();
        let by_chunk = match &*THREADS {
            Some(pool) => pool.install(all),
            None => all(),
        };
        let mut result = Activation::zeros(self.channels[1], rows, width);
        for (output, (channel, &bias)) in
            result.values.chunks_exact_mut(pixels.max(1)).zip(&self.bias).enumerate()
        {
            for (pixels, chunk) in channel.chunks_mut(PIXELS).zip(&by_chunk) {
                for (pixel, sum) in pixels.iter_mut().zip(&chunk[output]) {
                    let value = sum + bias;
                    // `max` would lose a NaN.
                    *pixel = if value < 0.0 { 0.0 } else { value };
                }
            }
        }
        result
    }

    /// Gathers the kernel's inputs for up to 16 pixels (row, column) of the result, with 0 outside the image. Shape:
    /// `[input channels · side · side, 16]`.
    fn gather(
        &self,
        image: &Activation,
        pixels: impl Iterator<Item = (usize, usize)>,
    ) -> Vec<[f32; PIXELS]> {
        let area = self.side * self.side;
        let mut inputs = vec![[0.0; PIXELS]; self.channels[0] * area];
        for (lane, (row, column)) in pixels.enumerate() {
            for y in 0..self.side {
                let row = (row * self.stride + y).checked_sub(self.padding);
                let Some(row) = row.filter(|row| image.rows.contains(row)) else { continue };
                for x in 0..self.side {
                    let column = (column * self.stride + x).checked_sub(self.padding);
                    let Some(column) = column.filter(|&column| column < image.width) else {
                        continue;
                    };
                    let first = (row - image.rows.start) * image.width + column;
                    let plane = image.rows.len() * image.width;
                    let values = image.values[first..].iter().step_by(plane);
                    let to = inputs[y * self.side + x..].iter_mut().step_by(area);
                    for (to, &value) in to.zip(values) {
                        to[lane] = value;
                    }
                }
            }
        }
        inputs
    }

    /// The products of all weights with the gathered inputs of up to 16 pixels. Shape: `[outputs padded to 6, 16]`.
    #[inline(always)]
    fn multiply(&self, inputs: &[[f32; PIXELS]]) -> Vec<[f32; PIXELS]> {
        let mut result = Vec::with_capacity(self.weights.len() / inputs.len().max(1) * OUTPUTS);
        for weights in self.weights.chunks_exact(inputs.len()) {
            let mut sums = [[0.0_f32; PIXELS]; OUTPUTS];
            for (weights, inputs) in weights.iter().zip(inputs) {
                for (sums, &weight) in sums.iter_mut().zip(weights) {
                    for (sum, &value) in sums.iter_mut().zip(inputs) {
                        *sum = weight.mul_add(value, *sum);
                    }
                }
            }
            result.extend(sums);
        }
        result
    }
}
