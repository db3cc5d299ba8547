//! Stage 8: what policies ask for, summed over views. Only requested signals have memory.

use densify_policies::policy::{Needs, Signal, SignalSet, Signals};
use pulp::Simd;
use rayon::prelude::*;

use super::blocks::{Blocks, plane};
use super::parameters::Parameters;
use super::project::{ViewParams, dot, lanes};
use super::project_bwd::BlockGradient;
use super::rasterize_bwd::{Detail, field};
use super::simd::{V, WIDTH, each};
use crate::backend::signal_planes::{SUMS, SignalPlanes};

/// The accumulators of the requested signals.
#[derive(Debug)]
pub(super) struct Accumulators {
    requested: SignalSet,
    layout: SignalPlanes,
    pub(super) blocks: Blocks,
}

#[inline(always)]
fn norm2<S: Simd>(x: V<S>, y: V<S>) -> V<S> {
    (x * x + y * y).sqrt()
}

#[inline(always)]
fn norm3<S: Simd>(v: [V<S>; 3]) -> V<S> {
    dot(v, v).sqrt()
}

impl SignalPlanes {
    /// Adds one view's contribution to the accumulators of a block.
    #[inline(always)]
    pub(in crate::backend::cpu) fn accumulate<S: Simd>(
        &self,
        s: S,
        block: &mut [f32],
        g: &BlockGradient,
        detail: Detail,
        view: &ViewParams,
    ) {
        let half = [V::splat(s, 0.5 * view.width as f32), V::splat(s, 0.5 * view.height as f32)];
        for at in (0..WIDTH).step_by(S::F32_LANES) {
            macro_rules! line {
                ($line:expr) => {
                    V::load(s, &$line[at..])
                };
            }
            macro_rules! sum {
                ($field:expr) => {
                    line!(g.sums[$field])
                };
            }
            let mean = each!(i in 3 => lanes(s, &g.params, plane::MEAN + i, at));
            // Infinite, so 1, where all depths count in full.
            let one = V::splat(s, 1.0);
            let depth = (one / (line!(g.inv_z) * self.full_depth)).min(one);
            let weight = depth * depth;
            for (signal, plane) in SUMS.iter().zip(self.sums) {
                let Some(plane) = plane else { continue };
                let x = match signal {
                    Signal::VisibleCount => line!(g.visible),
                    Signal::ScreenGradient => {
                        weight * norm2(line!(g.mean2d[0]) * half[0], line!(g.mean2d[1]) * half[1])
                    }
                    Signal::ScreenGradientAbs => {
                        let abs = [0, 1].map(|i| line!(g.mean2d_abs[i]) * half[i]);
                        weight * norm2(abs[0], abs[1])
                    }
                    Signal::ColourGradient => {
                        weight * norm3(each!(i in 3 => sum!(field::COLOUR + i)))
                    }
                    Signal::MeanGradientX => mean[0],
                    Signal::MeanGradientY => mean[1],
                    Signal::MeanGradientZ => mean[2],
                    Signal::MeanGradientNorm => norm3(mean),
                    Signal::WeightSum => sum!(field::WEIGHT_SUM),
                    _ => sum!(field::PIXELS),
                };
                let to = &mut block[plane * WIDTH + at..(plane + 1) * WIDTH];
                (V::load(s, to) + x).store(to);
            }
            if let (Some([_, current]), Some(maximum)) = (self.weight_max, detail.maximum()) {
                let to = &mut block[current * WIDTH + at..(current + 1) * WIDTH];
                V::load(s, to).max(sum!(maximum)).store(to);
            }
        }
    }
}

impl Accumulators {
    pub(super) fn new(budget: usize, needs: &Needs) -> Self {
        let layout = SignalPlanes::new(needs);
        Self { requested: needs.signals, layout, blocks: Blocks::zeros(budget, layout.count) }
    }

    pub(super) fn bytes(budget: usize, needs: &Needs) -> u64 {
        Blocks::<f32>::bytes(budget, SignalPlanes::new(needs).count)
    }

    pub(super) fn layout(&self) -> SignalPlanes {
        self.layout
    }

    /// Which record fields the requested signals need.
    pub(super) fn detail(&self) -> Detail {
        let any = |signals: &[Signal]| signals.iter().any(|&s| self.requested.contains(s));
        if any(&[Signal::ScreenGradientAbs, Signal::WeightSum, Signal::PixelCount]) {
            Detail::All
        } else if any(&[Signal::WeightMax, Signal::FreshWeightMax]) {
            Detail::WeightMax
        } else {
            Detail::Gradients
        }
    }

    /// Numbers per row where gradients of splats are summed in a step, and the requested signals lie
    /// while they are read.
    pub(super) fn sums(&self) -> usize {
        self.detail().stride().max(self.requested.count())
    }

    /// Whether views are to be measured.
    pub(super) fn measures(&self) -> bool {
        self.layout.fresh_weight_max.is_some()
    }

    /// Counts one more view for the largest weight of fresh views.
    ///
    /// `sums` has one record per row. Shape: `[rows, self.detail().stride()]`.
    pub(super) fn measure(&mut self, rows: usize, sums: &[f32], visible: &[u16]) {
        let detail = self.detail();
        let (Some(plane), Some(field)) = (self.layout.fresh_weight_max, detail.maximum()) else {
            return;
        };
        let per_block = self.blocks.stride();
        (
            self.blocks.of_rows_mut(rows).par_chunks_mut(per_block),
            sums.par_chunks(WIDTH * detail.stride()),
            visible,
        )
            .into_par_iter()
            .for_each(|(block, sums, &seen)| {
                let line = &mut block[plane * WIDTH..(plane + 1) * WIDTH];
                let records = sums.chunks_exact(detail.stride());
                for (lane, (most, record)) in line.iter_mut().zip(records).enumerate() {
                    if seen >> lane & 1 == 1 {
                        *most = most.max(record[field]);
                    }
                }
            });
    }

    /// Forgets the views measured so far.
    pub(super) fn forget_measured(&mut self, rows: usize) {
        if let Some(plane) = self.layout.fresh_weight_max {
            for row in 0..rows {
                self.blocks.set(row, plane, 0.0);
            }
        }
    }

    /// The current epoch's largest weights become the previous one's.
    pub(super) fn begin_epoch(&mut self, rows: usize) {
        if let Some([previous, current]) = self.layout.weight_max {
            for row in 0..rows {
                self.blocks.set(row, previous, self.blocks.get(row, current));
                self.blocks.set(row, current, 0.0);
            }
        }
    }

    /// Sums start anew; the largest weights stay.
    pub(super) fn reset(&mut self, rows: usize) {
        for plane in self.layout.sums.into_iter().flatten() {
            for row in 0..rows {
                self.blocks.set(row, plane, 0.0);
            }
        }
    }

    /// Writes the columns of the wanted signals.
    pub(super) fn read(
        &self,
        signals: &mut Signals,
        wanted: SignalSet,
        params: &Parameters,
        ages: &[u16],
    ) {
        for signal in wanted.iter() {
            let value = |row: usize| -> f32 {
                match signal {
                    Signal::WeightMax => {
                        self.layout.weight_max.map_or(0.0, |[previous, current]| {
                            self.blocks.get(row, previous).max(self.blocks.get(row, current))
                        })
                    }
                    Signal::FreshWeightMax => self
                        .layout
                        .fresh_weight_max
                        .map_or(0.0, |plane| self.blocks.get(row, plane)),
                    Signal::Opacity => 1.0 / (1.0 + (-params.get(row, plane::OPACITY)).exp()),
                    Signal::ScaleMax => {
                        let [x, y, z] = params.get_n::<3>(row, plane::LOG_SCALE);
                        x.max(y).max(z).exp()
                    }
                    Signal::ScaleProduct => {
                        let [x, y, z] = params.get_n::<3>(row, plane::LOG_SCALE);
                        (x + y + z).exp()
                    }
                    Signal::Age => f32::from(ages[row]),
                    sum => SUMS
                        .iter()
                        .position(|&s| s == sum)
                        .and_then(|i| self.layout.sums[i])
                        .map_or(0.0, |plane| self.blocks.get(row, plane)),
                }
            };
            if let Some(column) = signals.get_mut(signal) {
                for (row, slot) in column.iter_mut().enumerate() {
                    *slot = value(row);
                }
            }
        }
    }
}
