//! Stage 8: accumulates the requested signals over views. Only requested signals have memory.

use std::ops::Range;

use densify_policies::policy::{Needs, SUPPORT_WEIGHT, Signal, SignalKind, SignalSet, Signals};
use pulp::Simd;
use rayon::prelude::*;

use super::blocks::{Blocks, plane};
use super::mask::Masks;
use super::parameters::Parameters;
use super::project::{ViewParams, dot, lanes};
use super::project_bwd::BlockGradient;
use super::rasterize_bwd::field;
use super::simd::{V, WIDTH, each};
use super::threads::Threads;
use super::{BLOCKS_PER_TASK, ROWS_PER_TASK};
use crate::signals::{Field, ParameterSignal, RecordLayout, SignalPlanes, value_of};

/// The accumulators of the requested signals.
#[derive(Debug)]
pub(super) struct Accumulators {
    requested: SignalSet,
    layout: RecordLayout,
    pub(super) planes: SignalPlanes,
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
    pub(in crate::cpu) fn accumulate<S: Simd>(
        &self,
        s: S,
        block: &mut [f32],
        g: &BlockGradient,
        view: &ViewParams,
    ) {
        let focal = 0.5 * (view.focal[0] + view.focal[1]);
        let per_pixel = 1.0 / (view.width * view.height) as f32;
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
            // The quotient is infinite, and clamped to 1, if all depths have full weight (`full_depth` is 0).
            let one = V::splat(s, 1.0);
            let depth = (one / (line!(g.inv_z) * self.full_depth)).min(one);
            let weight = depth * depth;
            let seen = V::zero(s).lt(line!(g.visible));
            for signal in Signal::ALL {
                let Some(plane) = self.current(signal) else { continue };
                let x = match signal {
                    Signal::VisibleCount => line!(g.visible),
                    Signal::ScreenGradient => {
                        weight * norm2(line!(g.mean2d[0]) * half[0], line!(g.mean2d[1]) * half[1])
                    }
                    Signal::ScreenGradientAbs => {
                        let abs = each!(i in 2 => line!(g.mean2d_abs[i]) * half[i]);
                        weight * norm2(abs[0], abs[1])
                    }
                    Signal::ColourGradient => {
                        weight * norm3(each!(i in 3 => sum!(field::COLOUR + i)))
                    }
                    Signal::MeanGradientX => mean[0],
                    Signal::MeanGradientY => mean[1],
                    Signal::MeanGradientZ => mean[2],
                    Signal::MeanGradientNorm => norm3(mean),
                    Signal::WeightMax => sum!(Field::WeightMax.number()),
                    Signal::WeightSum => sum!(Field::WeightSum.number()),
                    Signal::PixelCount => sum!(Field::PixelCount.number()),
                    Signal::WeightedError => sum!(Field::Error.number()),
                    Signal::ErrorScore => V::load(s, &self.scores(g, at..at + S::F32_LANES)[at..]),
                    Signal::WeightMaxRoot => sum!(Field::WeightMax.number()).sqrt(),
                    Signal::Support => {
                        V::splat(s, SUPPORT_WEIGHT).le(sum!(Field::WeightMax.number())).keep(one)
                    }
                    Signal::DepthMin => seen.keep(line!(g.inv_z)),
                    Signal::PixelSizeMin => seen.keep(line!(g.inv_z) * focal),
                    Signal::DominantPixels => line!(g.dominant) * per_pixel,
                    // Computed from the row when the policy reads its signals.
                    Signal::Opacity
                    | Signal::ScaleMax
                    | Signal::ScaleProduct
                    | Signal::Mask
                    | Signal::Age
                    | Signal::Position
                    | Signal::LogScale
                    | Signal::Orientation
                    | Signal::Colour => continue,
                };
                let to = &mut block[plane * WIDTH + at..(plane + 1) * WIDTH];
                let old = V::load(s, to);
                let is_sum = matches!(signal.kind(), SignalKind::Sum | SignalKind::Count);
                (if is_sum { old + x } else { old.max(x) }).store(to);
            }
        }
    }
}

impl SignalPlanes {
    /// [`Signal::ErrorScore`] of one view in the given lanes; scalar, as powers have no vector instruction.
    fn scores(&self, g: &BlockGradient, lanes: Range<usize>) -> [f32; WIDTH] {
        let [errors, weights] =
            [Field::Error, Field::WeightSum].map(|field| &g.sums[field.number()]);
        let mut scores = [0.0; WIDTH];
        for lane in lanes {
            scores[lane] = self.score.of_view(errors[lane], weights[lane]);
        }
        scores
    }
}

impl Accumulators {
    /// Accumulators of these rows; `depth` as in [`Setup`](crate::Setup::depth).
    pub(super) fn new(rows: Range<usize>, needs: &Needs, depth: bool) -> Self {
        let (requested, planes) = (needs.signals, SignalPlanes::new(needs));
        let layout = RecordLayout::new(requested, depth);
        Self { requested, layout, planes, blocks: Blocks::zeros(rows, planes.count) }
    }

    pub(super) fn bytes(rows: Range<usize>, needs: &Needs) -> u64 {
        Blocks::<f32>::bytes(rows, SignalPlanes::new(needs).count)
    }

    /// The record layout of the requested signals, and of depth in the loss.
    pub(super) fn layout(&self) -> RecordLayout {
        self.layout
    }

    /// Numbers per row of the buffer that holds summed records in a step and, between steps, the signals being read.
    pub(super) fn sum_width(&self) -> usize {
        self.layout().stride().max(self.requested.width())
    }

    /// Starts a new epoch of the signals that are kept per epoch.
    pub(super) fn begin_epoch(&mut self, threads: &Threads, rows: usize) {
        let cleared = self.planes.begin_epoch();
        self.clear(threads, &cleared, rows);
    }

    /// Resets signals to 0.
    pub(super) fn reset(&mut self, signals: SignalSet, threads: &Threads, rows: usize) {
        self.clear(threads, &self.planes.of_signals(signals), rows);
    }

    fn clear(&mut self, threads: &Threads, planes: &[usize], rows: usize) {
        if planes.is_empty() {
            return;
        }
        let per_block = self.blocks.stride();
        let tasks = self.blocks.of_rows_mut(rows).par_chunks_mut(per_block * BLOCKS_PER_TASK);
        let clear = |blocks: &mut [f32]| {
            for block in blocks.chunks_exact_mut(per_block) {
                for &plane in planes {
                    block[plane * WIDTH..(plane + 1) * WIDTH].fill(0.0);
                }
            }
        };
        threads.install(|| threads.each("clear signals", tasks, clear));
    }

    /// Writes the columns of the wanted signals; 0 for rows without accumulators.
    pub(super) fn read(
        &self,
        threads: &Threads,
        signals: &mut Signals,
        wanted: SignalSet,
        (params, masks, ages): (&Parameters, &Masks, &Blocks<u16>),
    ) {
        for signal in wanted.iter() {
            let Some(column) = signals.get_mut(signal) else { continue };
            let attribute = ParameterSignal::new(signal);
            let planes = self.planes.of_signal(signal);
            let value = |row: usize| -> f32 {
                if signal.kind() == SignalKind::Current {
                    return present(signal, row, params, masks, ages);
                }
                let values = planes.clone().map(|plane| self.blocks.get(row, plane));
                value_of(signal, values.reduce(f32::max).unwrap_or(0.0))
            };
            let of_row = |row: usize, numbers: &mut [f32]| match &attribute {
                Some(attribute) => {
                    for (number, plane) in numbers.iter_mut().zip(attribute.parameters.clone()) {
                        *number = (attribute.convert)(params.get(row, plane));
                    }
                }
                None => numbers.fill(value(row)),
            };
            let width = signal.width();
            let tasks = column.par_chunks_mut(ROWS_PER_TASK * width).enumerate();
            let of_task = |(task, column): (usize, &mut [f32])| {
                if task < self.blocks.first / ROWS_PER_TASK {
                    column.fill(0.0);
                    return;
                }
                for (row, numbers) in (task * ROWS_PER_TASK..).zip(column.chunks_exact_mut(width)) {
                    of_row(row, numbers);
                }
            };
            threads.install(|| threads.each("read signals", tasks, of_task));
        }
    }
}

/// The value of a signal that depends only on the row's current state.
fn present(
    signal: Signal,
    row: usize,
    params: &Parameters,
    masks: &Masks,
    ages: &Blocks<u16>,
) -> f32 {
    let log_scales = || params.get_n::<3>(row, plane::LOG_SCALE);
    match signal {
        Signal::Opacity => 1.0 / (1.0 + (-params.get(row, plane::OPACITY)).exp()),
        Signal::ScaleMax => {
            let [x, y, z] = log_scales();
            x.max(y).max(z).exp()
        }
        Signal::ScaleProduct => {
            let [x, y, z] = log_scales();
            (x + y + z).exp()
        }
        Signal::Mask => masks.value(row),
        Signal::Age => f32::from(ages.get(row, 0)),
        summed => unreachable!("{summed:?} is accumulated, not read from the row"),
    }
}
