//! The row budget of a model that may have frozen rows.

/// The maximum number of rows of a model, frozen ones included.
///
/// Frozen rows are rendered but neither trained nor edited. They come first, they count towards the budget, and
/// policies do not know of them. Only this type converts between row counts with and without them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RowBudget {
    /// Maximum number of rows in total.
    pub total: usize,
    /// Number of frozen rows.
    pub frozen: usize,
}

impl From<usize> for RowBudget {
    /// A budget without frozen rows.
    fn from(total: usize) -> Self {
        Self { total, frozen: 0 }
    }
}

impl RowBudget {
    /// The budget that leaves room for `trainable` rows besides the frozen ones.
    pub fn for_trainable(trainable: usize, frozen: usize) -> Self {
        Self { total: trainable.saturating_add(frozen), frozen }
    }

    /// Maximum number of rows that can be trained.
    pub fn trainable(self) -> usize {
        self.total.saturating_sub(self.frozen)
    }

    /// True if a row is frozen.
    pub fn is_frozen(self, row: usize) -> bool {
        row < self.frozen
    }

    /// The row's index among the trained rows, by which policies identify it; `None` for a frozen row.
    pub fn trained_row(self, row: u32) -> Option<u32> {
        row.checked_sub(u32::try_from(self.frozen).ok()?)
    }

    /// Number of trained rows of a model that has `rows` rows in total.
    pub fn trained(self, rows: usize) -> usize {
        rows.saturating_sub(self.frozen)
    }
}
