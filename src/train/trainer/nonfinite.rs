//! Removes rows with non-finite values; ends the run if there are many.

use super::{AtStep, EditEvent, OnNan, TrainError, Trainer};
use densify_data::views::ViewSource;

/// Number of steps between regular audits. The rows are also audited before each edit of the policy.
pub(super) const AUDIT_EVERY: u32 = 100;
/// Largest share of the rows that an audit may remove. Removing so few has a negligible effect; more non-finite rows
/// mean that the run diverges. A single row may always be removed.
const MAX_SHARE: f64 = 1e-3;
/// Largest number of rows that an audit names in the log.
const MAX_NAMED: usize = 10;

impl<V: ViewSource> Trainer<V> {
    /// Removes the rows that have non-finite values after `step`, if there are any.
    pub(super) fn remove_nonfinite(&mut self, step: u32) -> Result<Option<EditEvent>, TrainError> {
        let unsound = self.backend.audit().at(step)?;
        let Some(first) = unsound.first() else {
            return Ok(None);
        };
        let (rows, count) = (self.backend.rows(), unsound.len());
        for row in unsound.iter().take(MAX_NAMED) {
            tracing::warn!(step, row = row.row, "non-finite value: {row}");
        }
        let is_small = count as f64 <= (MAX_SHARE * rows as f64).max(1.0) && count < rows;
        let budget = self.row_budget();
        let trained: Option<Vec<u32>> =
            unsound.iter().map(|row| budget.trained_row(row.row)).collect();
        match trained.filter(|_| is_small && self.options.on_nan == OnNan::Prune) {
            Some(trained) => {
                let mut plan = self.new_plan();
                plan.cause("not finite");
                plan.prune_all(trained);
                self.execute(step, plan)
            }
            // Frozen rows never change, so non-finite values in them mean an error elsewhere.
            None => Err(TrainError::NonFinite { step, count, rows, first: first.to_string() }),
        }
    }
}
