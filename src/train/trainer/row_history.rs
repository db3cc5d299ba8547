//! Records when each row was created and last edited, for display only. (The optimiser's step counts per row do not
//! distinguish creation from edits, and plans may leave them unchanged.)

use densify_policies::plan::{ParentFate, RowOps};

/// The steps in which rows were created and last edited; 0 for initial rows.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RowHistory {
    created: Vec<u32>,
    edited: Vec<u32>,
}

impl RowHistory {
    /// Memory per row of the budget `[bytes]`.
    pub const BYTES: u64 = 2 * size_of::<u32>() as u64;

    /// A history with room for `budget` rows, in which each row counts as created in the step of its last edit, because
    /// the step of its creation is unknown.
    pub fn from_edits(edited: &[u32], budget: usize) -> Self {
        let with_room = || {
            let mut steps = Vec::with_capacity(budget);
            steps.extend_from_slice(edited);
            steps
        };
        Self { created: with_room(), edited: with_room() }
    }

    /// The step in which each row was created. Shape: `[rows]`.
    pub fn created(&self) -> &[u32] {
        &self.created
    }

    /// The step in which each row was last created, rewritten or updated. Changes of all rows at once do not count.
    /// Shape: `[rows]`.
    pub fn edited(&self) -> &[u32] {
        &self.edited
    }

    /// Records an edit after `step`, in the order of operations that [`RowOps`] defines.
    ///
    /// # Panics
    /// When the plan is for another number of rows, which is a bug in the caller.
    pub fn record(&mut self, ops: &RowOps, step: u32) {
        assert_eq!(ops.rows_before, self.created.len(), "the plan is for another number of rows");
        let seeded = ops.seeds.iter().map(|(slot, _)| *slot);
        let new = || ops.child_slots.iter().copied().chain(seeded.clone());
        let slots = new().max().map_or(0, |slot| slot as usize + 1).max(ops.rows_before);
        for steps in [&mut self.created, &mut self.edited] {
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
        for steps in [&mut self.created, &mut self.edited] {
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
