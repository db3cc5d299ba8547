//! The two networks as tables, and a stage of them: convolutions, the distance of features, pooling.

use std::ops::Range;

use rayon::prelude::*;

use super::EPSILON;
use super::convolution::Convolution;
use crate::metrics::THREADS;

/// Rows of features that are in memory at a time: a stage of many channels never exists as a whole.
const STRIP: usize = 64;

/// A network whose features are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Network {
    /// VGG-16 (Simonyan and Zisserman 2014), up to `relu5_3`.
    Vgg,
    /// AlexNet (Krizhevsky 2014), up to its fifth convolution.
    Alex,
}

/// A convolution of the table: its number in the published network, channels in and out, side, step and
/// padding `[px]`.
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
    /// Its name as published.
    #[must_use]
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

    /// The pooling between two stages: the largest value of windows of this side, 2 apart; `None` after
    /// stages that end without.
    pub(super) fn pooling(self, stage: usize) -> Option<usize> {
        match self {
            Self::Vgg => (stage < 4).then_some(2),
            Self::Alex => (stage < 2).then_some(3),
        }
    }

    /// Smallest side of an image of which something is left after all stages `[px]`.
    #[must_use]
    pub fn least_side(self) -> usize {
        match self {
            Self::Vgg => 16,
            // 31 → 7 → 3 → 1.
            Self::Alex => 31,
        }
    }
}

/// Numbers per channel and pixel, for some rows of an image. Rows outside of the image are 0 to a
/// convolution.
#[derive(Debug)]
pub(super) struct Activation {
    pub(super) channels: usize,
    /// Rows of the whole that are here.
    pub(super) rows: Range<usize>,
    pub(super) width: usize,
    /// Shape: `[channels, rows, width]`.
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

/// A stage: convolutions, each followed by a rectifier, the weights of the features' differences, and how
/// the next stage's input is made.
#[derive(Debug)]
pub(super) struct Stage {
    pub(super) convolutions: Vec<Convolution>,
    /// Shape: `[channels]`.
    pub(super) weights: Vec<f32>,
    /// Side of the windows whose largest value the next stage sees, 2 apart.
    pub(super) pooling: Option<usize>,
}

impl Stage {
    /// The distance of two images by this stage's features, and what the next stage sees of them.
    pub(super) fn run(&self, images: &[Activation; 2]) -> (f64, [Activation; 2]) {
        let [mut height, mut width] = [images[0].rows.end, images[0].width];
        for convolution in &self.convolutions {
            [height, width] = [height, width].map(|side| convolution.side_of(side));
        }
        let pooled = |side: usize| self.pooling.map_or(side, |window| (side - window) / 2 + 1);
        let channels = self.weights.len();
        let mut next =
            [(); 2].map(|()| Activation::zeros(channels, 0..pooled(height), pooled(width)));
        let mut sum = 0.0;
        for first in (0..height).step_by(STRIP) {
            let own = first..(first + STRIP).min(height);
            // Windows reach into the next strip by what they are longer than their distance.
            let beyond = self.pooling.map_or(0, |window| window - 2);
            let rows = first..(own.end + beyond).min(height);
            let features = images.each_ref().map(|image| self.features(image, rows.clone()));
            sum += self.distance(&features, own.clone());
            for (features, next) in features.iter().zip(&mut next) {
                self.pool(features, own.clone(), next);
            }
        }
        (sum / (width * height) as f64, next)
    }

    /// Some rows of the features of an image.
    fn features(&self, image: &Activation, rows: Range<usize>) -> Activation {
        let mut heights = vec![image.rows.end];
        for convolution in &self.convolutions {
            heights.push(convolution.side_of(heights[heights.len() - 1]));
        }
        // What each convolution must see for the next one to have what it needs.
        let mut wanted = vec![rows];
        for (convolution, &height) in self.convolutions.iter().zip(&heights).rev() {
            wanted.push(convolution.seen(&wanted[wanted.len() - 1], height));
        }
        wanted.pop();
        let mut features: Option<Activation> = None;
        for (convolution, rows) in self.convolutions.iter().zip(wanted.into_iter().rev()) {
            features = Some(convolution.run(features.as_ref().unwrap_or(image), rows));
        }
        features.expect("every stage has a convolution")
    }

    /// Σ over the pixels of some rows of the weighed squared difference of unit features.
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
            let lengths: Vec<[f32; 2]> =
                sums.iter().map(|sums| sums.map(|sum| 1.0 / (sum.sqrt() + EPSILON))).collect();
            let mut distance = 0.0;
            for (channel, &weight) in self.weights.iter().enumerate() {
                let mut of_channel = 0.0_f64;
                for (lengths, (a, b)) in
                    lengths.iter().zip(a.row(channel, row).iter().zip(b.row(channel, row)))
                {
                    of_channel += f64::from(a * lengths[0] - b * lengths[1]).powi(2);
                }
                distance += f64::from(weight) * of_channel;
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

    /// What the next stage sees of these rows.
    fn pool(&self, features: &Activation, own: Range<usize>, next: &mut Activation) {
        let (width, height) = (next.width, next.rows.len());
        for channel in 0..features.channels {
            let to = &mut next.values[channel * height * width..][..height * width];
            let Some(window) = self.pooling else {
                for row in own.clone() {
                    to[row * width..][..width].copy_from_slice(features.row(channel, row));
                }
                continue;
            };
            for (row, to) in to.chunks_exact_mut(width).enumerate() {
                if !own.contains(&(2 * row)) {
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
