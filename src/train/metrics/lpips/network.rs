//! The layers of both networks, and their stages: convolutions, feature distances, pooling.

use std::ops::Range;

use rayon::prelude::*;

use super::EPSILON;
use super::convolution::Convolution;
use crate::metrics::THREADS;

/// Number of feature rows in memory at a time, because a whole stage with many channels would be too large.
const STRIP: usize = 64;

/// A network whose features are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Network {
    /// VGG-16 (Simonyan and Zisserman 2014), up to `relu5_3`.
    Vgg,
    /// AlexNet (Krizhevsky 2014), up to its fifth convolution.
    Alex,
}

/// A convolution: its number in the published network, input and output channels, kernel size, stride and padding
/// `[px]`.
pub(super) type Layer = (usize, [usize; 2], usize, usize, usize);

const VGG: [&[Layer]; 5] = [
    &[(0, [3, 64], 3, 1, 1), (2, [64, 64], 3, 1, 1)],
    &[(5, [64, 128], 3, 1, 1), (7, [128, 128], 3, 1, 1)],
    &[(10, [128, 256], 3, 1, 1), (12, [256, 256], 3, 1, 1), (14, [256, 256], 3, 1, 1)],
    &[(17, [256, 512], 3, 1, 1), (19, [512, 512], 3, 1, 1), (21, [512, 512], 3, 1, 1)],
    &[(24, [512, 512], 3, 1, 1), (26, [512, 512], 3, 1, 1), (28, [512, 512], 3, 1, 1)],
];

const ALEX: [&[Layer]; 5] = [
    &[(0, [3, 64], 11, 4, 2)],
    &[(3, [64, 192], 5, 1, 2)],
    &[(6, [192, 384], 3, 1, 1)],
    &[(8, [384, 256], 3, 1, 1)],
    &[(10, [256, 256], 3, 1, 1)],
];

impl Network {
    /// The published name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgg => "VGG-16",
            Self::Alex => "AlexNet",
        }
    }

    /// The convolutions of each stage.
    pub(super) fn stages(self) -> [&'static [Layer]; 5] {
        match self {
            Self::Vgg => VGG,
            Self::Alex => ALEX,
        }
    }

    /// Side of the windows of the max pooling after a stage, which has stride 2; `None` for stages without pooling.
    pub(super) fn pooling(self, stage: usize) -> Option<usize> {
        match self {
            Self::Vgg => (stage < 4).then_some(2),
            Self::Alex => (stage < 2).then_some(3),
        }
    }

    /// Smallest side of an image for which all stages have an output `[px]`.
    pub(super) fn least_side(self) -> usize {
        match self {
            Self::Vgg => 16,
            // 31 → 7 → 3 → 1.
            Self::Alex => 31,
        }
    }
}

/// Values per channel and pixel for some rows of an image. Rows outside the image are 0 in convolutions.
#[derive(Debug)]
pub(super) struct Activation {
    pub(super) channels: usize,
    /// The rows of the whole image that are present.
    pub(super) rows: Range<usize>,
    pub(super) width: usize,
    /// Values. Shape: `[channels, rows, width]`.
    pub(super) values: Vec<f32>,
}

impl Activation {
    pub(super) fn zeros(channels: usize, rows: Range<usize>, width: usize) -> Self {
        let values = vec![0.0; channels * rows.len() * width];
        Self { channels, rows, width, values }
    }

    /// A row of a channel.
    pub(super) fn row(&self, channel: usize, row: usize) -> &[f32] {
        let at = (channel * self.rows.len() + row - self.rows.start) * self.width;
        &self.values[at..at + self.width]
    }
}

/// A stage: convolutions with ReLU, the weights of feature differences, and the pooling before the next stage.
#[derive(Debug)]
pub(super) struct Stage {
    pub(super) convolutions: Vec<Convolution>,
    /// Weights of feature differences. Shape: `[channels]`.
    pub(super) weights: Vec<f32>,
    /// As [`Network::pooling`].
    pub(super) pooling: Option<usize>,
}

impl Stage {
    /// The distance between the features of two images in this stage, and the inputs of the next stage.
    pub(super) fn run(&self, images: &[Activation; 2]) -> (f64, [Activation; 2]) {
        let [mut height, mut width] = [images[0].rows.end, images[0].width];
        for convolution in &self.convolutions {
            [height, width] = [height, width].map(|side| convolution.output_side(side));
        }
        let pooled = |side: usize| self.pooling.map_or(side, |window| (side - window) / 2 + 1);
        let channels = self.weights.len();
        let mut next =
            [(); 2].map(|()| Activation::zeros(channels, 0..pooled(height), pooled(width)));
        let mut sum = 0.0;
        for first in (0..height).step_by(STRIP) {
            let strip = first..(first + STRIP).min(height);
            // Windows larger than the stride extend into the next strip.
            let beyond = self.pooling.map_or(0, |window| window - 2);
            let rows = first..(strip.end + beyond).min(height);
            let features = images.each_ref().map(|image| self.features(image, rows.clone()));
            sum += self.distance(&features, strip.clone());
            for (features, next) in features.iter().zip(&mut next) {
                self.pool(features, strip.clone(), next);
            }
        }
        (sum / (width * height) as f64, next)
    }

    /// Computes `rows` of the features of an image.
    fn features(&self, image: &Activation, rows: Range<usize>) -> Activation {
        let mut heights = vec![image.rows.end];
        for convolution in &self.convolutions {
            heights.push(convolution.output_side(heights[heights.len() - 1]));
        }
        // The rows that each convolution must compute, from the last one backwards.
        let mut needed = vec![rows];
        for (convolution, &height) in self.convolutions.iter().zip(&heights).rev() {
            needed.push(convolution.input_rows(&needed[needed.len() - 1], height));
        }
        needed.pop();
        let mut features: Option<Activation> = None;
        for (convolution, rows) in self.convolutions.iter().zip(needed.into_iter().rev()) {
            features = Some(convolution.run(features.as_ref().unwrap_or(image), rows));
        }
        features.expect("every stage has a convolution")
    }

    /// The sum of weighted squared differences of unit-length features over `rows`.
    fn distance(&self, [a, b]: &[Activation; 2], rows: Range<usize>) -> f64 {
        let row = |row: usize| -> f64 {
            let mut sums = vec![[0.0_f32; 2]; a.width];
            for channel in 0..a.channels {
                for (sum, (a, b)) in
                    sums.iter_mut().zip(a.row(channel, row).iter().zip(b.row(channel, row)))
                {
                    sum[0] += a * a;
                    sum[1] += b * b;
                }
            }
            let inverse_lengths: Vec<[f32; 2]> =
                sums.iter().map(|sums| sums.map(|sum| 1.0 / (sum.sqrt() + EPSILON))).collect();
            let mut distance = 0.0;
            for (channel, &weight) in self.weights.iter().enumerate() {
                let mut sum = 0.0_f64;
                let values = a.row(channel, row).iter().zip(b.row(channel, row));
                for (inverse, (a, b)) in inverse_lengths.iter().zip(values) {
                    sum += f64::from(a * inverse[0] - b * inverse[1]).powi(2);
                }
                distance += f64::from(weight) * sum;
            }
            distance
        };
        let rows = || rows.into_par_iter().map(row).collect::<Vec<f64>>();
        let by_row = match &*THREADS {
            Some(pool) => pool.install(rows),
            None => rows(),
        };
        by_row.iter().sum()
    }

    /// Pools the features whose windows begin in `strip` into the input of the next stage.
    fn pool(&self, features: &Activation, strip: Range<usize>, next: &mut Activation) {
        let (width, height) = (next.width, next.rows.len());
        for channel in 0..features.channels {
            let to = &mut next.values[channel * height * width..][..height * width];
            let Some(window) = self.pooling else {
                for row in strip.clone() {
                    to[row * width..][..width].copy_from_slice(features.row(channel, row));
                }
                continue;
            };
            for (row, to) in to.chunks_exact_mut(width).enumerate() {
                if !strip.contains(&(2 * row)) {
                    continue;
                }
                to.fill(f32::NEG_INFINITY);
                for row in 2 * row..2 * row + window {
                    let from = features.row(channel, row);
                    for (x, to) in to.iter_mut().enumerate() {
                        for &value in &from[2 * x..2 * x + window] {
                            // `max` would lose a NaN.
                            if value > *to || value.is_nan() {
                                *to = value;
                            }
                        }
                    }
                }
            }
        }
    }
}
