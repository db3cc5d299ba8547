//! The edits of a policy as data: the only way to change the number of rows.
//!
//! A policy writes into an [`EditPlan`]; the plan compiles to [`RowOps`]; a backend applies them.
//! Every call preserves two invariants, so no plan can break them: each row has at most one edit, and the number
//! of rows never exceeds the budget, not even during the edit. A refused call changes nothing, returns the
//! reason, and is counted.

use crate::edit::in_open_unit;
pub use crate::edit::{
    COLOUR_MAX, Decay, MIN_DECAYED_OPACITY, NO_ROTATION, Offspring, OpacityRule, ParentFate,
    Placement, Reset, ScaleRule, Seed, Update,
};
use crate::needs::Needs;
pub use crate::ops::{BrokenOps, EditCounts, Family, RowOps};
use crate::signals::{Signal, SignalSet};

/// The reason why a plan refused an edit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// The edit would need more rows than the budget leaves.
    #[error("no room: the budget is used up")]
    NoRoom,
    /// The row already has an edit in this plan.
    #[error("the row already has an edit in this plan")]
    Taken,
    /// The model has no such row.
    #[error("no such row")]
    NoSuchRow,
    /// A number in this field of the edit is not finite or out of its range.
    #[error("`{0}` is not finite or out of range")]
    BadValue(&'static str),
    /// The edit needs [`Needs::detailed_edits`], or it is a decay of seen rows only and needs
    /// [`Signal::VisibleCount`].
    #[error(
        "not declared: updates, rotations, and scales that are set or change separately for each axis need \
         `detailed_edits` in the policy's needs, and a decay of seen rows needs the signal `visible_count`"
    )]
    Undeclared,
}

/// The edit of a row. An untouched row takes only this byte in a plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RowEdit {
    None,
    Pruned,
    Grown,
    Updated,
}

/// Maximum memory of a plan per row, without seeds `[bytes]`: the edit's byte, and either a family, its shape and
/// its child's slot for every second row (as each family has a child), or an update of each row.
pub fn bytes_per_row(needs: &Needs) -> usize {
    let family = size_of::<Family>() + size_of::<u32>();
    let rows = if needs.detailed_edits {
        let shape = size_of::<(ScaleRule, [f32; 4])>();
        size_of::<(u32, Update)>().max((family + shape).div_ceil(2))
    } else {
        family.div_ceil(2)
    };
    size_of::<RowEdit>() + rows
}

/// The edits of one event.
///
/// Rows are identified by their index before the edit. `rows − pruned + added <= budget` holds after every
/// call, so at the budget a policy prunes first, then grows. (A plan that starts above its budget has
/// no [`room`](Self::room) and can only shrink.)
#[derive(Debug)]
pub struct EditPlan {
    budget: usize,
    edits: Vec<RowEdit>,
    pruned: usize,
    added: usize,
    denied: usize,
    detailed_edits: bool,
    has_visible_count: bool,
    was_undeclared: bool,
    families: Vec<Family>,
    shapes: Vec<(ScaleRule, [f32; 4])>,
    updates: Vec<(u32, Update)>,
    seeds: Vec<Seed>,
    decay: Option<Decay>,
    clamp_opacity: Option<f32>,
    reset_signals: SignalSet,
    reset_candidates: bool,
    cause: String,
}

impl EditPlan {
    /// An empty plan for a model of `rows` rows with a limit of `budget` rows. It refuses detailed edits unless
    /// [allowed](Self::allowing).
    pub fn new(rows: usize, budget: usize) -> Self {
        Self {
            budget,
            edits: vec![RowEdit::None; rows],
            pruned: 0,
            added: 0,
            denied: 0,
            detailed_edits: false,
            has_visible_count: false,
            was_undeclared: false,
            families: Vec::new(),
            shapes: Vec::new(),
            updates: Vec::new(),
            seeds: Vec::new(),
            decay: None,
            clamp_opacity: None,
            reset_signals: SignalSet::default(),
            reset_candidates: false,
            cause: String::new(),
        }
    }

    /// Allows the edits that `needs` declares.
    #[must_use]
    pub fn allowing(self, needs: &Needs) -> Self {
        let has_visible_count = needs.signals.contains(Signal::VisibleCount);
        Self { detailed_edits: needs.detailed_edits, has_visible_count, ..self }
    }

    /// Rows before the edit.
    pub fn rows(&self) -> usize {
        self.edits.len()
    }

    /// Maximum number of rows of the model.
    pub fn budget(&self) -> usize {
        self.budget
    }

    /// Number of rows that may still be added: budget − (rows − pruned + added).
    pub fn room(&self) -> usize {
        // Slots are u32 on every backend, whatever the budget.
        self.budget.min(u32::MAX as usize).saturating_sub(self.rows() - self.pruned + self.added)
    }

    /// Rows pruned so far.
    pub fn pruned(&self) -> usize {
        self.pruned
    }

    /// True if `row` exists and has no edit yet.
    pub fn is_free(&self, row: u32) -> bool {
        self.edits.get(row as usize) == Some(&RowEdit::None)
    }

    /// Removes `row`. Its slot can be reused within this plan.
    ///
    /// # Errors
    /// [`Refused::NoSuchRow`], [`Refused::Taken`].
    pub fn prune(&mut self, row: u32) -> Result<(), Refused> {
        self.claim(row, None, 0, RowEdit::Pruned)?;
        self.pruned += 1;
        Ok(())
    }

    /// Prunes `rows`; refusals are counted like those of [`prune`](Self::prune).
    pub fn prune_all(&mut self, rows: impl IntoIterator<Item = u32>) {
        for row in rows {
            let _ = self.prune(row);
        }
    }

    /// Clones or splits `parent`.
    ///
    /// # Errors
    /// [`Refused::Undeclared`], [`Refused::NoSuchRow`], [`Refused::Taken`], [`Refused::BadValue`], and
    /// [`Refused::NoRoom`] when there is not room for all the children.
    pub fn grow(&mut self, parent: u32, offspring: Offspring) -> Result<(), Refused> {
        let children = offspring.children as usize;
        let is_detailed = offspring.is_detailed();
        if is_detailed {
            self.check_declared(self.detailed_edits)?;
        }
        self.claim(parent, offspring.bad_field(), children, RowEdit::Grown)?;
        // Reserve the maximum at once: reallocating would briefly need twice the memory.
        let max_families = (self.rows() - self.pruned).min(self.room());
        if self.families.is_empty() {
            self.families.reserve_exact(max_families);
        }
        if is_detailed && self.shapes.is_empty() {
            self.shapes.reserve_exact(max_families);
        }
        let first_child = self.children() as u32;
        self.families.push(Family::new(parent, first_child, offspring, &mut self.shapes));
        self.added += children;
        Ok(())
    }

    /// Rewrites `row` in place, if [`Needs::detailed_edits`] allows it.
    ///
    /// # Errors
    /// [`Refused::Undeclared`], [`Refused::NoSuchRow`], [`Refused::Taken`], [`Refused::BadValue`].
    pub fn update(&mut self, row: u32, update: Update) -> Result<(), Refused> {
        self.check_declared(self.detailed_edits)?;
        self.claim(row, update.bad_field(), 0, RowEdit::Updated)?;
        if self.updates.is_empty() {
            self.updates.reserve_exact(self.rows() - self.pruned - self.families.len());
        }
        self.updates.push((row, update));
        Ok(())
    }

    /// Adds a row without a parent.
    ///
    /// # Errors
    /// [`Refused::BadValue`], [`Refused::NoRoom`].
    pub fn append(&mut self, seed: Seed) -> Result<(), Refused> {
        self.check(seed.bad_field(), 1)?;
        self.added += 1;
        self.seeds.push(seed);
        Ok(())
    }

    /// Reduces the opacities and scales of all rows, or only of [seen](Decay::seen_only) ones. A decay applies after
    /// all other edits except [`clamp_opacity`](Self::clamp_opacity), and new rows count as not seen. A later
    /// call replaces an earlier one.
    ///
    /// # Errors
    /// [`Refused::BadValue`], [`Refused::Undeclared`].
    pub fn decay(&mut self, decay: Decay) -> Result<(), Refused> {
        self.check_declared(self.has_visible_count || !decay.seen_only)?;
        self.check(decay.bad_field(), 0)?;
        self.decay = Some(decay);
        Ok(())
    }

    /// Limits the opacity of all rows, after all other edits. If called several times, the lowest limit
    /// applies. Both optimiser moments of all opacities become zero.
    ///
    /// # Errors
    /// [`Refused::BadValue`] when `max` is not in (0, 1).
    pub fn clamp_opacity(&mut self, max: f32) -> Result<(), Refused> {
        self.check((!in_open_unit(max)).then_some("max"), 0)?;
        self.clamp_opacity = Some(self.clamp_opacity.map_or(max, |lowest| lowest.min(max)));
        Ok(())
    }

    /// Resets an accumulator, after all other edits.
    pub fn reset(&mut self, accumulator: Reset) {
        match accumulator {
            Reset::Signals => self.reset(Reset::Only(Signal::ALL.into())),
            Reset::Only(signals) => {
                let resettable = signals.iter().filter(|signal| signal.is_resettable()).collect();
                self.reset_signals = self.reset_signals.union(resettable);
            }
            Reset::Candidates => self.reset_candidates = true,
        }
    }

    /// Adds `tag` to the reasons in the event log, which are joined by `+`. Repeated tags are ignored.
    pub fn cause(&mut self, tag: &str) {
        if tag.is_empty() || self.cause.split('+').any(|known| known == tag) {
            return;
        }
        if !self.cause.is_empty() {
            self.cause.push('+');
        }
        self.cause.push_str(tag);
    }

    /// Assigns slots to the edits.
    ///
    /// Children, family by family in the order of the calls, then seeds, fill the slots of pruned rows
    /// in ascending order, then slots from `rows` upward. The last rows move into the holes that
    /// remain, in unchanged order.
    pub fn compile(self) -> RowOps {
        let rows_before = self.rows();
        let rows_after = rows_before - self.pruned + self.added;
        let is_pruned = |&slot: &usize| self.edits[slot] == RowEdit::Pruned;
        // Slots in `0..rows_after` without a live row: the first ones take the new rows, the others
        // (only if the model shrinks) take rows from the tail.
        let mut holes = (0..rows_before).filter(is_pruned).chain(rows_before..).map(|s| s as u32);

        let child_slots: Vec<u32> = holes.by_ref().take(self.children()).collect();
        // Seeds come first in the zip, so that no hole is consumed without a seed to fill it.
        let seeds = self.seeds.iter().zip(holes.by_ref()).map(|(&seed, slot)| (slot, seed));
        let seeds: Vec<(u32, Seed)> = seeds.collect();
        let live_tail = (rows_after..rows_before).filter(|slot| !is_pruned(slot));
        let moves: Vec<(u32, u32)> = live_tail.map(|s| s as u32).zip(holes).collect();

        let rewritten = |f: &&Family| f.fate() == ParentFate::BecomesChild;
        let counts = EditCounts {
            removed: self.pruned,
            added: self.added,
            updated: self.updates.len() + self.families.iter().filter(rewritten).count(),
            denied: self.denied,
        };
        let ops = RowOps {
            first_row: 0,
            rows_before,
            rows_after,
            budget: self.budget,
            families: self.families,
            shapes: self.shapes,
            child_slots,
            updates: self.updates,
            seeds,
            moves,
            decay: self.decay,
            clamp_opacity: self.clamp_opacity,
            reset_signals: self.reset_signals,
            reset_candidates: self.reset_candidates,
            counts,
            cause: self.cause,
        };
        ops.assert_valid();
        ops
    }

    /// True if an edit was refused because the policy did not declare it.
    pub(crate) fn was_undeclared(&self) -> bool {
        self.was_undeclared
    }

    fn check_declared(&mut self, is_declared: bool) -> Result<(), Refused> {
        if is_declared {
            return Ok(());
        }
        self.was_undeclared = true;
        self.refuse(Refused::Undeclared)
    }

    /// Number of rows added by families, without seeds.
    fn children(&self) -> usize {
        self.added - self.seeds.len()
    }

    /// Records the edit of `row`, if it has none yet, the edit's values are valid and there is room.
    fn claim(
        &mut self,
        row: u32,
        bad_field: Option<&'static str>,
        children: usize,
        edit: RowEdit,
    ) -> Result<(), Refused> {
        match self.edits.get(row as usize) {
            None => return self.refuse(Refused::NoSuchRow),
            Some(RowEdit::None) => self.check(bad_field, children)?,
            Some(_) => return self.refuse(Refused::Taken),
        }
        self.edits[row as usize] = edit;
        Ok(())
    }

    fn check(&mut self, bad_field: Option<&'static str>, new_rows: usize) -> Result<(), Refused> {
        match bad_field {
            Some(field) => self.refuse(Refused::BadValue(field)),
            None if new_rows > self.room() => self.refuse(Refused::NoRoom),
            None => Ok(()),
        }
    }

    fn refuse(&mut self, reason: Refused) -> Result<(), Refused> {
        self.denied += 1;
        Err(reason)
    }
}

#[cfg(test)]
mod tests;
