//! Edits as data: the only way to change the number of rows.
//!
//! A policy writes into an [`EditPlan`]; the plan compiles to [`RowOps`]; a backend applies them.
//! The plan keeps its invariants on every call, so that a plan over budget cannot be expressed:
//! each row has one fate, and the number of rows after the edit, and at every instant of it, is at
//! most the budget. A refused call changes nothing, returns why, and is counted.

use crate::edit::in_open_unit;
pub use crate::edit::{
    Offspring, OpacityRule, ParentFate, Placement, Reset, ScaleRule, Seed, Update,
};
pub use crate::ops::{BrokenOps, EditCounts, Family, RowOps};

/// Why a plan refused an edit. A value, never a panic; each refusal is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// The edit would need more rows than the budget leaves.
    #[error("no room: the budget is used up")]
    NoRoom,
    /// The row already has a fate in this plan.
    #[error("the row already has a fate in this plan")]
    Taken,
    /// The model has no such row.
    #[error("no such row")]
    NoSuchRow,
    /// A number in the edit is not finite or out of its range.
    #[error("a value is not finite or out of range")]
    BadValue,
}

/// What a plan does with a row. One byte per row is all that a plan holds for untouched rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    Free,
    Pruned,
    Grown,
    Updated,
}

/// Most that a plan takes for each row, seeds apart `[bytes]`: a fate, and either an update of each row
/// or, as each family has a child, a family with its child's slot for every second one.
pub const BYTES_PER_ROW: usize = size_of::<Fate>() + {
    let updates = size_of::<(u32, Update)>();
    let families = (size_of::<Family>() + size_of::<u32>()).div_ceil(2);
    if updates > families { updates } else { families }
};

/// The edits of one event.
///
/// Rows are named by their index before the edit. At every call
/// `rows − pruned + grown <= budget` holds, so that a policy at its budget prunes first, then
/// grows. (A plan that starts above its budget has no [`room`](Self::room) and can only shrink.)
#[derive(Debug)]
pub struct EditPlan {
    budget: usize,
    fates: Vec<Fate>,
    pruned: usize,
    born: usize,
    denied: usize,
    families: Vec<Family>,
    updates: Vec<(u32, Update)>,
    seeds: Vec<Seed>,
    clamp_opacity: Option<f32>,
    reset_signals: bool,
    reset_candidates: bool,
    cause: String,
}

impl EditPlan {
    /// An empty plan for a model of `rows` rows that may never have more than `budget`.
    #[must_use]
    pub fn new(rows: usize, budget: usize) -> Self {
        Self {
            budget,
            fates: vec![Fate::Free; rows],
            pruned: 0,
            born: 0,
            denied: 0,
            families: Vec::new(),
            updates: Vec::new(),
            seeds: Vec::new(),
            clamp_opacity: None,
            reset_signals: false,
            reset_candidates: false,
            cause: String::new(),
        }
    }

    /// Rows before the edit.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.fates.len()
    }

    /// Most rows there may ever be.
    #[must_use]
    pub fn budget(&self) -> usize {
        self.budget
    }

    /// How many more rows this plan can bear: budget − (rows − pruned + grown).
    #[must_use]
    pub fn room(&self) -> usize {
        // Slots are u32 on every backend, whatever the budget says.
        self.budget.min(u32::MAX as usize).saturating_sub(self.rows() - self.pruned + self.born)
    }

    /// Rows pruned so far.
    #[must_use]
    pub fn pruned(&self) -> usize {
        self.pruned
    }

    /// Edits refused so far.
    #[must_use]
    pub fn denied(&self) -> usize {
        self.denied
    }

    /// Whether `row` exists and has no fate yet.
    #[must_use]
    pub fn is_free(&self, row: u32) -> bool {
        self.fates.get(row as usize) == Some(&Fate::Free)
    }

    /// Removes `row`. Its slot is free at once, within this plan.
    ///
    /// # Errors
    /// [`Refused::NoSuchRow`], [`Refused::Taken`].
    pub fn prune(&mut self, row: u32) -> Result<(), Refused> {
        self.claim(row, true, 0, Fate::Pruned)?;
        self.pruned += 1;
        Ok(())
    }

    /// Lets `parent` have children: a clone or a split.
    ///
    /// # Errors
    /// [`Refused::NoSuchRow`], [`Refused::Taken`], [`Refused::BadValue`], and [`Refused::NoRoom`]
    /// when there is not room for all the children.
    pub fn grow(&mut self, parent: u32, offspring: Offspring) -> Result<(), Refused> {
        let children = offspring.children as usize;
        self.claim(parent, offspring.is_valid(), children, Fate::Grown)?;
        if self.families.is_empty() {
            // As many as there can be, if no more rows are pruned: growing step by step, the array
            // would be there twice while it is moved.
            self.families.reserve_exact((self.rows() - self.pruned).min(self.room()));
        }
        let first_child = self.born_in_families() as u32;
        self.families.push(Family { parent, first_child, offspring });
        self.born += children;
        Ok(())
    }

    /// Rewrites `row` in place.
    ///
    /// # Errors
    /// [`Refused::NoSuchRow`], [`Refused::Taken`], [`Refused::BadValue`].
    pub fn update(&mut self, row: u32, update: Update) -> Result<(), Refused> {
        self.claim(row, update.is_valid(), 0, Fate::Updated)?;
        self.updates.push((row, update));
        Ok(())
    }

    /// Adds a row that has no parent.
    ///
    /// # Errors
    /// [`Refused::BadValue`], [`Refused::NoRoom`].
    pub fn append(&mut self, seed: Seed) -> Result<(), Refused> {
        self.check(seed.is_valid(), 1)?;
        self.born += 1;
        self.seeds.push(seed);
        Ok(())
    }

    /// Bounds the opacity of all rows, after all other edits. Of several bounds the lowest holds.
    ///
    /// # Errors
    /// [`Refused::BadValue`] when `max` is not in (0, 1).
    pub fn clamp_opacity(&mut self, max: f32) -> Result<(), Refused> {
        self.check(in_open_unit(max), 0)?;
        self.clamp_opacity = Some(self.clamp_opacity.map_or(max, |lowest| lowest.min(max)));
        Ok(())
    }

    /// Starts an accumulator anew, after all other edits.
    pub fn reset(&mut self, what: Reset) {
        match what {
            Reset::Signals => self.reset_signals = true,
            Reset::Candidates => self.reset_candidates = true,
        }
    }

    /// Says why, for the event log. Several tags are joined by `+`; one said twice counts once.
    pub fn cause(&mut self, tag: &str) {
        if tag.is_empty() || self.cause.split('+').any(|said| said == tag) {
            return;
        }
        if !self.cause.is_empty() {
            self.cause.push('+');
        }
        self.cause.push_str(tag);
    }

    /// Turns the edits into slots.
    ///
    /// Children, family after family in the order of the calls, then seeds, fill the slots of
    /// pruned rows in ascending order, then slots from `rows` upward. Live rows from the tail move
    /// into the holes that are left, the order among them unchanged.
    #[must_use]
    pub fn compile(self) -> RowOps {
        let rows_before = self.rows();
        let rows_after = rows_before - self.pruned + self.born;
        let is_pruned = |&slot: &usize| self.fates[slot] == Fate::Pruned;
        // Every slot in `0..rows_after` that holds no live row: the first `born` of them are for
        // the newborn, the rest (only where the model shrinks) for rows of the tail.
        let mut holes = (0..rows_before).filter(is_pruned).chain(rows_before..).map(|s| s as u32);

        let child_slots: Vec<u32> = holes.by_ref().take(self.born_in_families()).collect();
        // Seeds lead the zip: it must not draw a hole when there is no seed left to fill it.
        let seeds = self.seeds.iter().zip(holes.by_ref()).map(|(&seed, slot)| (slot, seed));
        let seeds: Vec<(u32, Seed)> = seeds.collect();
        let live_tail = (rows_after..rows_before).filter(|slot| !is_pruned(slot));
        let moves: Vec<(u32, u32)> = live_tail.map(|s| s as u32).zip(holes).collect();

        let rewritten = |f: &&Family| f.offspring.parent == ParentFate::BecomesChild;
        let counts = EditCounts {
            removed: self.pruned,
            added: self.born,
            updated: self.updates.len() + self.families.iter().filter(rewritten).count(),
            denied: self.denied,
        };
        let ops = RowOps {
            rows_before,
            rows_after,
            budget: self.budget,
            families: self.families,
            child_slots,
            updates: self.updates,
            seeds,
            moves,
            clamp_opacity: self.clamp_opacity,
            reset_signals: self.reset_signals,
            reset_candidates: self.reset_candidates,
            counts,
            cause: self.cause,
        };
        ops.assert_valid();
        ops
    }

    fn born_in_families(&self) -> usize {
        self.born - self.seeds.len()
    }

    /// Gives `row` its fate, if it is free, the edit's values are good and there is room.
    fn claim(&mut self, row: u32, good: bool, children: usize, fate: Fate) -> Result<(), Refused> {
        match self.fates.get(row as usize) {
            None => return self.refuse(Refused::NoSuchRow),
            Some(Fate::Free) => self.check(good, children)?,
            Some(_) => return self.refuse(Refused::Taken),
        }
        self.fates[row as usize] = fate;
        Ok(())
    }

    fn check(&mut self, good: bool, births: usize) -> Result<(), Refused> {
        match (good, births <= self.room()) {
            (false, _) => self.refuse(Refused::BadValue),
            (true, false) => self.refuse(Refused::NoRoom),
            (true, true) => Ok(()),
        }
    }

    fn refuse(&mut self, why: Refused) -> Result<(), Refused> {
        self.denied += 1;
        Err(why)
    }
}

#[cfg(test)]
mod tests;
