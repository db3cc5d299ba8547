//! When each row was made and last edited: for whoever looks at a run, and for nothing else. The optimiser's ages say
//! the second only, and not where a plan keeps them.

use densify_policies::plan::{ParentFate, RowOps};

/// The steps in which the rows were made and last edited; 0 for those that were there in the beginning.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RowHistory {
    made: Vec<u32>,
    edited: Vec<u32>,
}

impl RowHistory {
    /// Bytes per row of the budget.
    pub const BYTES: u64 = 2 * size_of::<u32>() as u64;

    /// Of rows of which only the last edits are known, for at most `budget` rows.
    #[must_use]
    pub fn of(edited: &[u32], budget: usize) -> Self {
        let with_room = || {
            let mut steps = Vec::with_capacity(budget);
            steps.extend_from_slice(edited);
            steps
        };
        Self { made: with_room(), edited: with_room() }
    }

    /// The step in which each row was made. Shape: `[rows]`.
    #[must_use]
    pub fn made(&self) -> &[u32] {
        &self.made
    }

    /// The step in which each row was made, rewritten or updated last. What happens to all rows at once is no edit of
    /// any. Shape: `[rows]`.
    #[must_use]
    pub fn edited(&self) -> &[u32] {
        &self.edited
    }

    /// Follows an edit after `step`, in the order that [`RowOps`] says.
    ///
    /// # Panics
    /// When the plan is for another number of rows: a bug in the caller.
    pub fn follow(&mut self, ops: &RowOps, step: u32) {
        assert_eq!(ops.rows_before, self.made.len(), "a plan for other rows");
        let seeded = ops.seeds.iter().map(|(slot, _)| *slot);
        let new = || ops.child_slots.iter().copied().chain(seeded.clone());
        let slots = new().max().map_or(0, |slot| slot as usize + 1).max(ops.rows_before);
        for steps in [&mut self.made, &mut self.edited] {
            steps.resize(slots.max(ops.rows_after), step);
            new().for_each(|slot| steps[slot as usize] = step);
            for family in &ops.families {
                if family.fate() == ParentFate::BecomesChild {
                    steps[family.parent as usize] = step;
                }
            }
        }
        for (row, _) in &ops.updates {
            self.edited[*row as usize] = step;
        }
        let order = ops.order();
        for steps in [&mut self.made, &mut self.edited] {
            for &(from, to) in &ops.moves {
                steps[to as usize] = steps[from as usize];
            }
            steps.truncate(ops.rows_after);
            if !order.is_empty() {
                let ordered: Vec<u32> = order.iter().map(|&slot| steps[slot as usize]).collect();
                steps.copy_from_slice(&ordered);
            }
        }
    }
}
