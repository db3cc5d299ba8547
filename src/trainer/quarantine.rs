//! Rows that hold a number that is not finite are removed and named; more than a few of them end the run.

use densify_policies::plan::EditPlan;

use super::{EditEvent, OnNan, TrainError, Trainer};
use crate::views::ViewSource;

/// Steps between two audits where the policy is not due.
pub(super) const AUDIT_EVERY: u32 = 100;
/// Largest share of the rows that may be unsound at one audit: a model loses that few unnoticed, but
/// more of them tell that the run diverges. One row always may.
const MOST: f64 = 1e-3;
/// Most rows that are named, each, at one audit.
const MOST_NAMED: usize = 10;

impl<V: ViewSource> Trainer<V> {
    /// Removes the rows that are unsound after `step`, if there are any.
    pub(super) fn quarantine(&mut self, step: u32) -> Result<Option<EditEvent>, TrainError> {
        let unsound = self.backend.audit().map_err(|e| self.stopped(step, e))?;
        let Some(first) = unsound.first() else {
            return Ok(None);
        };
        let (rows, count) = (self.backend.rows(), unsound.len());
        for found in unsound.iter().take(MOST_NAMED) {
            tracing::warn!(step, row = found.row, "not a finite number: {found}");
        }
        let few = count as f64 <= (MOST * rows as f64).max(1.0) && count < rows;
        if self.options.on_nan == OnNan::Stop || !few {
            return Err(TrainError::Unsound { step, count, rows, first: first.to_string() });
        }
        let mut plan = EditPlan::new(rows, self.limit());
        plan.cause("not finite");
        for found in unsound {
            // Never refused: each row once, and not all of them.
            let _ = plan.prune(found.row);
        }
        self.execute(step, plan)
    }
}
