//! Prunes the rows with the lowest values of a measure over all training views or, as a control, equally many
//! rows at random.
//!
//! Methods that prune a grown model differ in their measure and share this code: the measure is accumulated
//! over the auxiliary views of one event, and the rows with the lowest values are pruned. A control prunes the
//! same number of rows at random, so that a study can isolate the effect of the measure.

use serde::{Deserialize, Serialize};

use crate::plan::EditPlan;
use crate::policy::Snapshot;
use crate::rng::PolicyRng;
use crate::sample::{smallest, weighted};

/// A number per row, accumulated over the auxiliary views of one event. Not part of a policy's saved state, as
/// it is used in the same event and the next one starts from zero.
#[derive(Debug, Default)]
pub struct ViewAccumulator {
    step: u32,
    /// Shape: `[rows]`.
    values: Vec<f32>,
}

impl ViewAccumulator {
    /// Adds the positive values of a view of `step`. Shape: `[rows]`.
    pub fn add(&mut self, step: u32, values: &[f32]) {
        self.combine(step, values, |sum, value| sum + value);
    }

    /// Raises each value to that of a view of `step` if that is larger. Shape: `[rows]`.
    pub fn maximum(&mut self, step: u32, values: &[f32]) {
        self.combine(step, values, f32::max);
    }

    /// Removes and returns the values of this event; `None` if it had no views.
    pub fn take(&mut self, now: &Snapshot<'_>) -> Option<Vec<f32>> {
        let Self { step, values } = std::mem::take(self);
        (step == now.step && values.len() == now.rows()).then_some(values)
    }

    fn combine(&mut self, step: u32, values: &[f32], merge: impl Fn(f32, f32) -> f32) {
        if self.step != step || self.values.len() != values.len() {
            *self = Self { step, values: vec![0.0; values.len()] };
        }
        for (so_far, &value) in self.values.iter_mut().zip(values) {
            // Skips NaN, too.
            if value > 0.0 {
                *so_far = merge(*so_far, value);
            }
        }
    }
}

/// The choice of rows to prune.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Victims {
    /// The rows with the lowest values of the measure.
    Lowest,
    /// The same number of rows, drawn uniformly at random, as a control.
    Random,
}

impl Victims {
    /// Prunes `count` of the rows that have no edit yet; the control does not read `measure`. Keeps at least
    /// one row, as an empty model could never grow again.
    ///
    /// # Panics
    /// For `Lowest`, when `measure` has fewer values than the model has rows.
    pub fn prune(self, plan: &mut EditPlan, measure: &[f32], count: usize, rng: &PolicyRng) {
        let rows_left = plan.rows() - plan.pruned();
        let count = count.min(rows_left.saturating_sub(1));
        let rows = 0..plan.rows() as u32;
        let victims = match self {
            Self::Lowest => {
                smallest(rows.filter(|&row| plan.is_free(row)).collect(), measure, count)
            }
            Self::Random => {
                let chance = |row| if plan.is_free(row) { 1.0 } else { 0.0 };
                weighted(&rows.map(chance).collect::<Vec<f32>>(), count, rng)
            }
        };
        plan.cause("prune");
        plan.prune_all(victims);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::Event;
    use crate::policy::{SignalSet, Signals};

    const NAN: f32 = f32::NAN;

    /// Takes the values at an event of `step` with `rows` rows.
    fn take(gathered: &mut ViewAccumulator, step: u32, rows: usize) -> Option<Vec<f32>> {
        let (scene, signals) =
            (Event::new(1, 1, 1).scene, Signals::zeros(rows, SignalSet::default()));
        gathered.take(&Snapshot { step, scene: &scene, signals: &signals, candidates: &[] })
    }

    #[test]
    fn values_are_gathered_over_the_views_of_one_event() {
        let mut sums = ViewAccumulator::default();
        sums.add(5, &[1.0, 2.0, NAN, -3.0]);
        sums.add(5, &[0.5, NAN, 0.0, 4.0]);
        assert_eq!(take(&mut sums, 5, 4), Some(vec![1.5, 2.0, 0.0, 4.0]));
        // The values are gone after the first call.
        assert_eq!(take(&mut sums, 5, 4), None);
        let mut largest = ViewAccumulator::default();
        largest.maximum(5, &[0.25, NAN, 0.0, -1.0]);
        largest.maximum(5, &[0.125, 0.5, NAN, -2.0]);
        assert_eq!(take(&mut largest, 5, 4), Some(vec![0.25, 0.5, 0.0, 0.0]));
    }

    #[test]
    fn views_of_another_event_do_not_count() {
        let mut sums = ViewAccumulator::default();
        sums.add(5, &[1.0, 2.0]);
        sums.add(6, &[0.5, 0.5]);
        assert_eq!(take(&mut sums, 6, 2), Some(vec![0.5, 0.5]));
        sums.add(6, &[1.0, 2.0]);
        assert_eq!(take(&mut sums, 7, 2), None);
        sums.add(7, &[1.0, 2.0]);
        assert_eq!(take(&mut sums, 7, 3), None);
    }

    /// The rows that `victims` prunes in a plan that has already pruned those in `before`.
    fn pruned(
        victims: Victims,
        measure: &[f32],
        before: &[u32],
        count: usize,
        step: u32,
    ) -> Vec<u32> {
        let rows = measure.len();
        let mut plan = EditPlan::new(rows, rows);
        plan.prune_all(before.iter().copied());
        let is_free: Vec<bool> = (0..rows as u32).map(|row| plan.is_free(row)).collect();
        victims.prune(&mut plan, measure, count, &PolicyRng::new(1, step));
        (0..rows as u32).filter(|&row| is_free[row as usize] && !plan.is_free(row)).collect()
    }

    #[test]
    fn the_lowest_are_pruned_and_one_row_is_kept() {
        let measure = [3.0, 0.0, 5.0, 1.0, 1.0];
        let lowest = |before: &[u32], count| pruned(Victims::Lowest, &measure, before, count, 1);
        // The first of equal rows is pruned.
        assert_eq!(lowest(&[], 2), [1, 3]);
        assert_eq!(lowest(&[1], 2), [3, 4]);
        assert_eq!(lowest(&[], 5), [0, 1, 3, 4]);
        assert_eq!(lowest(&[2, 3, 4], 9), [1]);
        assert_eq!(lowest(&[], 0), [0_u32; 0]);
    }

    #[test]
    fn the_control_draws_every_row_equally_often_and_only_free_ones() {
        // Two of the four free rows: each is drawn in half of the events.
        let measure = [0.0, 9.0, 0.1, 0.2, 0.3];
        let mut times = [0_u32; 5];
        for step in 0..2000 {
            let drawn = pruned(Victims::Random, &measure, &[2], 2, step);
            assert_eq!(drawn.len(), 2, "{drawn:?}");
            drawn.iter().for_each(|&row| times[row as usize] += 1);
        }
        // Five standard deviations of 2,000 draws at ½: 5·√500 = 112.
        let is_half = |times: &u32| times.abs_diff(1000) < 112;
        assert!(times[2] == 0 && [0, 1, 3, 4].iter().all(|&row| is_half(&times[row])), "{times:?}");
        assert_eq!(pruned(Victims::Random, &measure, &[], 9, 1).len(), 4);
    }
}
