//! Victims: the rows that fall where others want their place.

use super::{Diet, Importance};
use crate::plan::EditPlan;
use crate::policy::{PolicyError, Signal, Snapshot};
use crate::sample::smallest;

impl Diet {
    /// The signal that says how important a row is.
    pub(super) fn importance(&self) -> Signal {
        match self.params.importance {
            Importance::Epochs => Signal::WeightMax,
            Importance::Fresh => Signal::FreshWeightMax,
        }
    }

    /// Prunes the `count` least important rows that have no fate yet and are not `spared`; as many
    /// as there are, if they are fewer.
    pub(super) fn prune_victims(
        &self,
        now: &Snapshot<'_>,
        plan: &mut EditPlan,
        count: usize,
        spared: &dyn Fn(u32) -> bool,
    ) -> Result<(), PolicyError> {
        if count == 0 {
            return Ok(());
        }
        let importance = now.signal(self.importance())?;
        let protects = self.protected_age > 0.0;
        let age = if protects { now.signal(Signal::Age)? } else { &[] };
        let eligible = (0..now.rows() as u32).filter(|&row| plan.is_free(row) && !spared(row));
        let (mut newborn, grown): (Vec<u32>, Vec<u32>) =
            eligible.partition(|&row| protects && age[row as usize] < self.protected_age);
        let mut victims = smallest(grown, importance, count);
        let missing = count - victims.len();
        if missing > 0 {
            newborn.sort_unstable_by(|&a, &b| {
                let (a_row, b_row) = (a as usize, b as usize);
                let older_first = age[b_row].total_cmp(&age[a_row]);
                older_first.then(importance[a_row].total_cmp(&importance[b_row])).then(a.cmp(&b))
            });
            victims.extend(newborn.into_iter().take(missing));
        }
        for row in victims {
            let _ = plan.prune(row);
        }
        Ok(())
    }
}
