//! Compiled plans: the slots (places in the parameter arrays) to write, in the order in which a backend does.

use serde::{Deserialize, Serialize};

use crate::edit::{
    Decay, NO_ROTATION, Offspring, OpacityRule, ParentFate, Placement, ScaleRule, Seed, Update,
    in_open_unit,
};
use crate::signals::SignalSet;

/// A compiled plan. Rows `0..rows_before` are live before the edit, rows `0..rows_after` after it. No slot at
/// or beyond the budget is written, nor any before `first_row`.
///
/// In pass 1 a backend executes `families` (it reads the parent once, then writes its children and the parent
/// itself), `updates` and `seeds`: no slot is written twice, and no written slot is read by another entry. In
/// pass 2 it executes `moves`, sorts the rows into [`order`](Self::order), and executes `decay` and
/// `clamp_opacity` on all rows from `first_row` on, and the resets.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RowOps {
    /// The first row that may change; those before it are [frozen](Self::after_frozen).
    pub first_row: usize,
    /// Rows before the edit.
    pub rows_before: usize,
    /// Rows after the edit, <= budget.
    pub rows_after: usize,
    /// The budget the plan was made for.
    pub budget: usize,
    /// Parents with their children; see [`offspring`](Self::offspring).
    pub families: Vec<Family>,
    /// Scale rules and rotations that do not fit into the compact [`Family`], which refers to them by index.
    pub shapes: Vec<(ScaleRule, [f32; 4])>,
    /// Slots of all children, family after family.
    pub child_slots: Vec<u32>,
    /// Rows rewritten in place.
    pub updates: Vec<(u32, Update)>,
    /// Rows added without a parent, with their slots.
    pub seeds: Vec<(u32, Seed)>,
    /// (from, to): live tail rows that fill the holes left by pruned rows; every `from` >=
    /// `rows_after` > every `to`.
    pub moves: Vec<(u32, u32)>,
    /// Reduction of all opacities and scales.
    pub decay: Option<Decay>,
    /// Upper bound for all opacities, in (0, 1); both opacity moments of all rows become zero.
    pub clamp_opacity: Option<f32>,
    /// The signals that are reset in all rows; moved rows keep the others.
    pub reset_signals: SignalSet,
    /// If true, the candidate list is cleared.
    pub reset_candidates: bool,
    /// Numbers of rows changed, for the event log.
    pub counts: EditCounts,
    /// The reason, for the event log: tags joined by `+`.
    pub cause: String,
}

/// One parent and its children, more compact than an [`Offspring`], as there may be millions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Family {
    /// The parent's row.
    pub parent: u32,
    /// Index of its first child in [`RowOps::child_slots`].
    pub first_child: u32,
    children: u32,
    fate: ParentFate,
    placement: Placement,
    shape: Shape,
    opacity: OpacityRule,
}

/// Scales and rotation of a family.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Shape {
    Uniform(f32),
    LongAxis {
        long: f32,
        other: f32,
    },
    /// An index into [`RowOps::shapes`].
    Listed(u32),
}

impl Family {
    /// A family whose shape is appended to `shapes` if it is [detailed](Offspring::is_detailed).
    pub(crate) fn new(
        parent: u32,
        first_child: u32,
        offspring: Offspring,
        shapes: &mut Vec<(ScaleRule, [f32; 4])>,
    ) -> Self {
        let Offspring { children, parent: fate, placement, scale, turn, opacity } = offspring;
        let shape = match (scale, offspring.is_detailed()) {
            (ScaleRule::Uniform(factor), false) => Shape::Uniform(factor),
            (ScaleRule::LongAxis { long, other }, false) => Shape::LongAxis { long, other },
            _ => {
                shapes.push((scale, turn));
                Shape::Listed(shapes.len() as u32 - 1)
            }
        };
        Self { parent, first_child, children, fate, placement, shape, opacity }
    }

    /// Fate of the parent's row.
    pub fn fate(&self) -> ParentFate {
        self.fate
    }
}

/// Numbers of rows changed by an edit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct EditCounts {
    /// Rows pruned.
    pub removed: usize,
    /// Rows added (children and seeds).
    pub added: usize,
    /// Rows rewritten in place (updates and parents that became children).
    pub updated: usize,
    /// Edits refused, mostly for lack of room.
    pub denied: usize,
}

/// A broken invariant of a [`RowOps`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("broken row operations: {0}")]
pub struct BrokenOps(String);

impl RowOps {
    /// True if neither rows nor accumulators change. This includes plans whose edits were all refused; see
    /// [`EditCounts::denied`].
    pub fn is_empty(&self) -> bool {
        !self.edits_rows() && self.reset_signals.is_empty() && !self.reset_candidates
    }

    /// True if any row is added, removed or changed.
    pub fn edits_rows(&self) -> bool {
        !(self.families.is_empty()
            && self.updates.is_empty()
            && self.seeds.is_empty()
            && self.moves.is_empty()
            && self.rows_before == self.rows_after
            && self.decay.is_none()
            && self.clamp_opacity.is_none())
    }

    /// Shifts all rows by `frozen`, for a model with this number of frozen rows before those that the plan was
    /// made for.
    #[must_use]
    pub fn after_frozen(mut self, frozen: usize) -> Self {
        let shift = frozen as u32;
        self.first_row += frozen;
        self.rows_before += frozen;
        self.rows_after += frozen;
        self.budget += frozen;
        for family in &mut self.families {
            family.parent += shift;
        }
        self.child_slots.iter_mut().for_each(|slot| *slot += shift);
        self.updates.iter_mut().for_each(|(row, _)| *row += shift);
        self.seeds.iter_mut().for_each(|(slot, _)| *slot += shift);
        for (from, to) in &mut self.moves {
            *from += shift;
            *to += shift;
        }
        self
    }

    /// The final order of rows: row i of the model is the one in slot `order[i]` after the moves. A permutation
    /// of `0..rows_after`, or empty if the rows are already in order.
    ///
    /// Rows keep their order, each followed by its children; seeds come last. Initially, neighbours in memory
    /// are neighbours in space; this order preserves that, which makes steps faster.
    pub fn order(&self) -> Vec<u32> {
        // Sort key of each slot: the row's index before the edit, or its parent's, and a bit for children.
        let mut origin: Vec<u64> = (0..self.rows_after as u64).map(|row| row << 1).collect();
        for &(from, to) in &self.moves {
            origin[to as usize] = u64::from(from) << 1;
        }
        for family in &self.families {
            for &slot in self.children(family) {
                origin[slot as usize] = u64::from(family.parent) << 1 | 1;
            }
        }
        for (slot, _) in &self.seeds {
            origin[*slot as usize] = u64::MAX;
        }
        if origin.is_sorted() {
            return Vec::new();
        }
        let mut order: Vec<u32> = (0..self.rows_after as u32).collect();
        // Slots ascend among siblings and among seeds.
        order.sort_unstable_by_key(|&slot| (origin[slot as usize], slot));
        order
    }

    /// The slots of `family`'s children.
    ///
    /// # Panics
    /// When `family` does not belong to this plan.
    pub fn children(&self, family: &Family) -> &[u32] {
        &self.child_slots[family.first_child as usize..][..family.children as usize]
    }

    /// The offspring of `family`.
    ///
    /// # Panics
    /// When `family` does not belong to this plan.
    pub fn offspring(&self, family: &Family) -> Offspring {
        self.find_offspring(family).expect("a family of this plan")
    }

    fn find_offspring(&self, family: &Family) -> Option<Offspring> {
        let Family { children, fate: parent, placement, opacity, .. } = *family;
        let (scale, turn) = match family.shape {
            Shape::Uniform(factor) => (ScaleRule::Uniform(factor), NO_ROTATION),
            Shape::LongAxis { long, other } => (ScaleRule::LongAxis { long, other }, NO_ROTATION),
            Shape::Listed(index) => *self.shapes.get(index as usize)?,
        };
        Some(Offspring { children, parent, placement, scale, turn, opacity })
    }

    /// Panics if [`check`](Self::check) fails: executing the plan would exceed the budget or corrupt
    /// the model.
    ///
    /// # Panics
    /// With the reason that the check reports.
    pub fn assert_valid(&self) {
        if let Err(broken) = self.check() {
            panic!("{broken}");
        }
    }

    /// Checks all invariants: rows within the budget, no slot written twice, no written slot read by
    /// another entry, rows `0..rows_after` dense, values in range, counts correct. Takes linear time and
    /// one bit per row.
    ///
    /// # Errors
    /// The first broken invariant, with the values.
    pub fn check(&self) -> Result<(), BrokenOps> {
        self.check_totals()?;
        let slots = self.rows_before.max(self.rows_after);
        let mut claimed = Slots::new(slots);
        self.check_families(&mut claimed)?;
        for (row, update) in &self.updates {
            validate(update.bad_field(), || format!("update of row {row}"))?;
            self.check_live("updated row", *row)?;
            claimed.claim("updated row", *row)?;
        }
        for (slot, seed) in &self.seeds {
            validate(seed.bad_field(), || format!("seed in slot {slot}"))?;
            self.check_new_slot("seed", *slot)?;
            claimed.claim("seed", *slot)?;
        }
        self.check_moves(&mut claimed)
    }

    fn check_totals(&self) -> Result<(), BrokenOps> {
        let Self { first_row, rows_before, rows_after, budget, counts, .. } = self;
        let added = self.child_slots.len() + self.seeds.len();
        require(rows_after <= budget || (rows_after <= rows_before && added == 0), || {
            format!("{rows_after} rows after, budget {budget}")
        })?;
        let removable = rows_before.saturating_sub(*first_row);
        require(counts.removed <= removable, || {
            format!("{} of {removable} rows removed", counts.removed)
        })?;
        let expected = rows_before.checked_sub(counts.removed).map(|kept| kept + added);
        require(expected == Some(*rows_after) && counts.added == added, || {
            format!(
                "{rows_before} rows before, {counts:?}, {added} added; this does not give {rows_after} rows after"
            )
        })?;
        let is_rewritten = |family: &&Family| family.fate == ParentFate::BecomesChild;
        let updated = self.updates.len() + self.families.iter().filter(is_rewritten).count();
        require(counts.updated == updated, || format!("{updated} updated, but {counts:?}"))?;
        validate(self.decay.and_then(|decay| decay.bad_field()), || "the decay".to_owned())?;
        require(self.clamp_opacity.is_none_or(in_open_unit), || {
            format!("opacity bound {:?}", self.clamp_opacity)
        })
    }

    fn check_families(&self, claimed: &mut Slots) -> Result<(), BrokenOps> {
        let mut first_child = 0;
        for family in &self.families {
            let parent = family.parent;
            let bad_field = self.find_offspring(family).map_or(Some("shape"), |o| o.bad_field());
            validate(bad_field, || format!("family of row {parent}"))?;
            require(family.first_child as usize == first_child, || {
                format!("family of row {parent} starts at child {}", family.first_child)
            })?;
            first_child += family.children as usize;
            self.check_live("parent", parent)?;
            claimed.claim("parent", parent)?;
        }
        require(self.child_slots.len() == first_child, || {
            format!("{} child slots for {first_child} children", self.child_slots.len())
        })?;
        for &slot in &self.child_slots {
            self.check_new_slot("child", slot)?;
            claimed.claim("child", slot)?;
        }
        Ok(())
    }

    /// Checks that every move ends in a hole, every parent and updated row of the tail is moved, and all rows
    /// from `rows_before` upward are new.
    fn check_moves(&self, claimed: &mut Slots) -> Result<(), BrokenOps> {
        let Self { rows_before, rows_after, .. } = self;
        let mut moved = Slots::new(*rows_before);
        for &(from, to) in &self.moves {
            require((*rows_after..*rows_before).contains(&(from as usize)), || {
                format!("move from row {from}, not in the tail {rows_after}..{rows_before}")
            })?;
            require((self.first_row..*rows_after).contains(&(to as usize)), || {
                format!("move to row {to}, which is not in {}..{rows_after}", self.first_row)
            })?;
            moved.claim("moved row", from)?;
            claimed.claim("hole", to)?;
        }
        let parents = self.families.iter().map(|family| family.parent);
        for row in parents.chain(self.updates.iter().map(|update| update.0)) {
            require((row as usize) < *rows_after || moved.contains(row), || {
                format!("row {row} is kept and not moved, but is not before row {rows_after}")
            })?;
        }
        let seeds = self.seeds.iter().map(|seed| &seed.0);
        let new_slots = self.child_slots.iter().chain(seeds);
        let appended = new_slots.filter(|&&slot| slot as usize >= *rows_before).count();
        require(appended == rows_after.saturating_sub(*rows_before), || {
            format!(
                "{appended} rows added from row {rows_before} on, which does not give {rows_after} rows after"
            )
        })
    }

    fn check_live(&self, role: &str, row: u32) -> Result<(), BrokenOps> {
        let Self { first_row, rows_before, .. } = self;
        require((*first_row..*rows_before).contains(&(row as usize)), || {
            format!("{role} {row} is not in rows {first_row}..{rows_before}")
        })
    }

    fn check_new_slot(&self, role: &str, slot: u32) -> Result<(), BrokenOps> {
        let Self { first_row, rows_after, budget, .. } = self;
        require((*first_row..*rows_after.min(budget)).contains(&(slot as usize)), || {
            format!(
                "{role} in slot {slot}, which is not in {first_row}..{rows_after} or is beyond the budget {budget}"
            )
        })
    }
}

fn validate(bad_field: Option<&'static str>, item: impl Fn() -> String) -> Result<(), BrokenOps> {
    require(bad_field.is_none(), || {
        format!("{} has a bad {}", item(), bad_field.unwrap_or_default())
    })
}

fn require(holds: bool, message: impl FnOnce() -> String) -> Result<(), BrokenOps> {
    if holds { Ok(()) } else { Err(BrokenOps(message())) }
}

/// A set of slots, one bit each.
struct Slots(Vec<u64>);

impl Slots {
    fn new(slots: usize) -> Self {
        Self(vec![0; slots.div_ceil(64)])
    }

    fn contains(&self, slot: u32) -> bool {
        self.0.get(slot as usize / 64).is_some_and(|word| word >> (slot % 64) & 1 == 1)
    }

    /// Adds `slot`; an error if another entry has claimed it.
    fn claim(&mut self, role: &str, slot: u32) -> Result<(), BrokenOps> {
        let is_new = !self.contains(slot);
        require(is_new, || format!("{role} {slot} is used by another entry"))?;
        self.0[slot as usize / 64] |= 1 << (slot % 64);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
