//! The scores of `fastgs`: in how many wrong pixels of several views a row takes part.

use crate::policy::{AuxColumn, AuxView, PolicyResult, Snapshot};

/// Sums over the views of one event. Not saved, as each event starts from zero.
#[derive(Debug, Default)]
pub(super) struct ViewScores {
    step: u32,
    views: u32,
    /// Σ over views of the number of wrong pixels that the row is blended into. Shape: `[rows]`.
    wrong: Vec<f32>,
    /// The same, each view weighted by its loss. Shape: `[rows]`.
    weighted: Vec<f32>,
}

impl ViewScores {
    /// Adds one view.
    pub(super) fn add(&mut self, view: &AuxView<'_>) -> PolicyResult {
        if self.step != view.step || self.wrong.len() != view.rows {
            let zeros = vec![0.0; view.rows];
            *self = Self { step: view.step, views: 0, weighted: zeros.clone(), wrong: zeros };
        }
        self.views += 1;
        let sums = self.wrong.iter_mut().zip(&mut self.weighted);
        for ((wrong, weighted), &pixels) in sums.zip(view.column(AuxColumn::MapSum)?) {
            let loss = pixels * view.loss;
            if pixels > 0.0 && loss.is_finite() {
                *wrong += pixels;
                *weighted += loss;
            }
        }
        Ok(())
    }

    /// True for rows with more than `least` wrong pixels in the mean over views, rounded down (importance score,
    /// equation 10 of the paper). Shape: `[rows]`.
    pub(super) fn is_important(&self, now: &Snapshot<'_>, least: u32) -> Vec<bool> {
        if !self.belongs_to(now) {
            return vec![false; now.rows()];
        }
        let views = self.views as f32;
        self.wrong.iter().map(|wrong| (wrong / views).floor() > least as f32).collect()
    }

    /// The weighted sums, scaled to 0..1 by their minimum and maximum (pruning score, equation 12); 0 if they are all
    /// equal. Shape: `[rows]`.
    pub(super) fn pruning(&self, now: &Snapshot<'_>) -> Vec<f32> {
        if !self.belongs_to(now) {
            return vec![0.0; now.rows()];
        }
        let low = self.weighted.iter().copied().fold(f32::INFINITY, f32::min);
        let high = self.weighted.iter().copied().fold(0.0, f32::max);
        let range = high - low;
        let scaled = |sum: &f32| if range > 0.0 { (sum - low) / range } else { 0.0 };
        // A sum may have overflowed.
        self.weighted
            .iter()
            .map(scaled)
            .map(|score| if score.is_nan() { 0.0 } else { score })
            .collect()
    }

    fn belongs_to(&self, now: &Snapshot<'_>) -> bool {
        self.step == now.step && self.wrong.len() == now.rows() && self.views > 0
    }
}
