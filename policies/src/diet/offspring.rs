//! The children of a candidate: an optionally shifted clone, or a split.

use super::{CloneOpacity, Diet, DietParams, POSITION_GRADIENT, Shift, Split};
use crate::adc::{clone_at, split_by, split_long_axis};
use crate::plan::{Offspring, OpacityRule, ParentFate, ScaleRule};
use crate::policy::{PolicyResult, Signal, Snapshot};

impl Diet {
    /// The children of a candidate.
    pub(super) fn offspring(&self, now: &Snapshot<'_>, row: usize) -> PolicyResult<Offspring> {
        if now.signal(Signal::ScaleMax)?[row] > self.scene_units(self.params.small, now.scene) {
            let DietParams { split_factor, split_share, child_opacity, .. } = self.params;
            return Ok(match self.params.split {
                Split::Random => split_by(split_factor as f32),
                Split::LongAxis => split_long_axis(split_share as f32, child_opacity as f32),
            });
        }
        let clone = clone_at(self.shift(now, row)?);
        match self.params.clone_opacity {
            CloneOpacity::Unchanged => Ok(clone),
            CloneOpacity::Conserve => {
                let scale = conserving_scale(now.signal(Signal::Opacity)?[row]);
                Ok(Offspring {
                    parent: ParentFate::BecomesChild,
                    scale: ScaleRule::Uniform(scale),
                    opacity: OpacityRule::Conserved,
                    ..clone
                })
            }
        }
    }

    /// Offset of a clone from its parent `[scene units]`.
    fn shift(&self, now: &Snapshot<'_>, row: usize) -> PolicyResult<[f32; 3]> {
        let read = |signal| now.signal(signal).map(|column| column[row]);
        if self.params.shift == Shift::None {
            return Ok([0.0; 3]);
        }
        let [x, y, z] = POSITION_GRADIENT;
        let sum = [read(x)?, read(y)?, read(z)?];
        let factor = match self.params.shift {
            Shift::None => 0.0,
            Shift::Paper => 1.0,
            Shift::Code => read(Signal::VisibleCount)?.powi(-2),
            Shift::Descent => {
                // Rounding must not make the sum of lengths less than the length of the sum.
                let length = sum.iter().map(|v| v * v).sum::<f32>().sqrt();
                let lengths = read(Signal::MeanGradientNorm)?.max(length);
                -(self.params.kappa as f32) * read(Signal::ScaleMax)? / lengths
            }
        };
        let shift = sum.map(|v| factor * v);
        // Not finite if no view saw the row.
        Ok(if shift.iter().all(|v| v.is_finite()) { shift } else { [0.0; 3] })
    }
}

/// The factor on the scales of two Gaussians of opacity 1 − √(1 − o) that together render like one of
/// opacity o (Kheradmand et al. 2024, equation 9, for N = 2).
pub(super) fn conserving_scale(opacity: f32) -> f32 {
    let shared = 1.0 - (1.0 - opacity).sqrt();
    let factor = opacity / (2.0 * shared - shared * shared * std::f32::consts::FRAC_1_SQRT_2);
    // 0/0 where opacity vanishes: the limit is 1.
    if factor.is_finite() && factor > 0.0 { factor } else { 1.0 }
}
