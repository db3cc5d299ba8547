//! The score of `taming`: the importance of a row in badly rendered views.
//!
//! The terms of the row itself (gradient, opacity, size) are the same in all views, so only the factor
//! they share, 50 times the loss L of a view, is summed over the views in which the row is visible: Σ 50·L.

use super::TamingParams;
use crate::policy::{AuxColumn, AuxView, PolicyResult, Signal, Snapshot};

/// Factor on a view's loss in the published code. It matters only relative to the 10⁻⁶ added to scores in pruning.
const VIEW_WEIGHT: f32 = 50.0;

/// Sums over the views of the current event. Shape: `[rows]` each.
#[derive(Debug, Default)]
pub(super) struct Score {
    step: u32,
    /// Σ 50·L·(terms of the view).
    view_terms: Vec<f32>,
    /// Σ 50·L.
    loss_sums: Vec<f32>,
}

/// The columns of each view that the score combines.
pub(super) const COLUMNS: [AuxColumn; 6] = [
    AuxColumn::Depth,
    AuxColumn::Radius,
    AuxColumn::DistanceSum,
    AuxColumn::MapSum,
    AuxColumn::PixelCount,
    AuxColumn::WeightSum,
];

impl Score {
    /// Adds one view.
    pub(super) fn add(&mut self, view: &AuxView<'_>, params: &TamingParams) -> PolicyResult {
        if self.step != view.step || self.loss_sums.len() != view.rows {
            let zeros = vec![0.0; view.rows];
            *self = Self { step: view.step, view_terms: zeros.clone(), loss_sums: zeros };
        }
        let weights = [
            params.depth_weight,
            params.radius_weight,
            params.distance_weight,
            params.map_weight,
            params.count_weight,
            params.blend_weight,
        ];
        let mut sum = vec![0.0; view.rows];
        for (weight, column) in weights.into_iter().zip(COLUMNS) {
            add_term(&mut sum, weight as f32, view.column(column)?);
        }
        let weight = VIEW_WEIGHT * view.loss;
        let shown = view.column(AuxColumn::Radius)?.iter().map(|radius| *radius > 0.0);
        let scores = self.view_terms.iter_mut().zip(&mut self.loss_sums);
        for ((is_shown, sum), (terms, losses)) in shown.zip(sum).zip(scores) {
            if is_shown {
                *terms += weight * sum;
                *losses += weight;
            }
        }
        Ok(())
    }

    /// The score of every row; 0 if no view was added at this step.
    pub(super) fn total(
        self,
        now: &Snapshot<'_>,
        gradient: &[f32],
        params: &TamingParams,
    ) -> PolicyResult<Vec<f32>> {
        if self.step != now.step || self.loss_sums.len() != now.rows() {
            return Ok(vec![0.0; now.rows()]);
        }
        let mut row_terms = vec![0.0; now.rows()];
        add_term(&mut row_terms, params.gradient_weight as f32, gradient);
        add_term(&mut row_terms, params.opacity_weight as f32, now.signal(Signal::Opacity)?);
        add_term(&mut row_terms, params.scale_weight as f32, now.signal(Signal::ScaleProduct)?);
        let parts = self.view_terms.iter().zip(&self.loss_sums).zip(row_terms);
        Ok(parts.map(|((terms, losses), row_terms)| terms + losses * row_terms).collect())
    }
}

/// Adds to each sum `weight` · x / (median of the positive x) if x, the value of the same row, is positive.
fn add_term(sums: &mut [f32], weight: f32, values: &[f32]) {
    let Some(median) = median_of_positive(values) else { return };
    for (sum, &x) in sums.iter_mut().zip(values) {
        let term = weight * (x / median);
        if x > 0.0 && term.is_finite() {
            *sum += term;
        }
    }
}

/// The lower median of the positive values.
fn median_of_positive(values: &[f32]) -> Option<f32> {
    let mut positive: Vec<f32> = values.iter().copied().filter(|x| *x > 0.0).collect();
    let middle = positive.len().checked_sub(1)? / 2;
    Some(*positive.select_nth_unstable_by(middle, f32::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn terms_are_relative_to_the_median_of_the_positive_values() {
        // Positive: 1, 2, 4, 8; the lower median is 2.
        let mut sums = vec![1.0; 7];
        add_term(&mut sums, 10.0, &[8.0, -1.0, 1.0, 0.0, 4.0, f32::NAN, 2.0]);
        assert_eq!(sums, [41.0, 1.0, 6.0, 1.0, 21.0, 1.0, 11.0]);
        let before = sums.clone();
        add_term(&mut sums, 10.0, &[0.0; 7]);
        add_term(&mut sums, 10.0, &[f32::INFINITY; 7]);
        assert_eq!(sums, before);
        assert_eq!(median_of_positive(&[]), None);
        assert_eq!(median_of_positive(&[5.0, 3.0, 9.0]), Some(5.0));
    }
}
