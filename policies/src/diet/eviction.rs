//! Eviction: pruning the least important rows to make room for others.

use super::Diet;
use crate::plan::EditPlan;
use crate::policy::{PolicyResult, Signal, Snapshot};
use crate::sample::smallest;

impl Diet {
    /// Prunes the `count` least important rows that have no edit yet and are not `exempt`, or all such rows if
    /// there are fewer. Protected (new) rows are pruned only if there are not enough others, the oldest first.
    pub(super) fn evict(
        &self,
        now: &Snapshot<'_>,
        plan: &mut EditPlan,
        importance: &[f32],
        (count, exempt): (usize, &dyn Fn(u32) -> bool),
    ) -> PolicyResult {
        if count == 0 {
            return Ok(());
        }
        let protects = self.protected_age > 0.0;
        let age = if protects { now.signal(Signal::Age)? } else { &[] };
        let eligible = (0..now.rows() as u32).filter(|&row| plan.is_free(row) && !exempt(row));
        let (mut new, old): (Vec<u32>, Vec<u32>) =
            eligible.partition(|&row| protects && age[row as usize] < self.protected_age);
        let mut evicted = smallest(old, importance, count);
        let missing = count - evicted.len();
        if missing > 0 {
            new.sort_unstable_by(|&a, &b| {
                let (a_row, b_row) = (a as usize, b as usize);
                let older_first = age[b_row].total_cmp(&age[a_row]);
                older_first.then(importance[a_row].total_cmp(&importance[b_row])).then(a.cmp(&b))
            });
            evicted.extend(new.into_iter().take(missing));
        }
        plan.prune_all(evicted);
        Ok(())
    }
}
