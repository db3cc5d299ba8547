//! Reports of steps and of edits.

use densify_policies::plan::RowOps;
use serde::{Deserialize, Serialize};

use densify_render::StepOutput;

/// The result of a step.
#[derive(Debug, Clone, PartialEq)]
pub struct StepReport {
    /// Iteration, 1-based.
    pub step: u32,
    /// Index of the training view.
    pub view: usize,
    /// Loss and other scalars of the step.
    pub output: StepOutput,
    /// Number of rows after the step.
    pub rows: usize,
    /// The edits of this step: removal of rows with non-finite values, removal by the automatic budget, and the
    /// policy's edit.
    pub events: Vec<EditEvent>,
}

/// An edit of the rows. All counts are numbers of rows.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EditEvent {
    /// Iteration, 1-based.
    pub step: u32,
    /// Rows before.
    pub before: usize,
    /// Rows pruned.
    pub removed: usize,
    /// Rows added.
    pub added: usize,
    /// Rows rewritten in place.
    pub updated: usize,
    /// Edits that the plan refused, mostly because of the budget.
    pub denied: usize,
    /// Rows after.
    pub after: usize,
    /// The reason, if the policy or the trainer named one.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub cause: String,
}

impl EditEvent {
    pub(super) fn new(step: u32, ops: &RowOps) -> Self {
        Self {
            step,
            before: ops.rows_before,
            removed: ops.counts.removed,
            added: ops.counts.added,
            updated: ops.counts.updated,
            denied: ops.counts.denied,
            after: ops.rows_after,
            cause: ops.cause.clone(),
        }
    }
}
