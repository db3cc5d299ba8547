//! Half-way through a run rows lose the bands of colour that they do not need, where the backend was
//! made for it ([`Shortcuts::row_degrees`](crate::backend::Shortcuts::row_degrees)).
//!
//! Earlier, colours are not yet what they will be: higher bands begin late and with small steps. Later,
//! there is less of the run left that would take less memory and time, and in which the rows could make
//! up for what they have lost. Reduced-3DGS (Papantonakis et al. 2024) does it at the same place.

use serde::{Deserialize, Serialize};

use super::{TrainError, Trainer};
use crate::backend::RowDegrees;
use crate::views::ViewSource;

/// What rows have lost.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dropped {
    /// After which iteration.
    pub step: u32,
    /// What they have left.
    pub left: RowDegrees,
}

impl<V: ViewSource> Trainer<V> {
    /// What rows have lost, if they have.
    #[must_use]
    pub fn dropped(&self) -> Option<&Dropped> {
        self.dropped.as_ref()
    }

    /// Drops bands, where `step` is due for it: half of the run, or later if degrees are still being
    /// raised then, or on trial. The policy's edit of the step is done; policies remember no rows.
    pub(super) fn drop_bands(&mut self, step: u32) -> Result<(), TrainError> {
        let iterations = self.options.iterations;
        let in_use = self.sh_degree(step);
        let is_settled = match &self.earned {
            Some(earned) => earned.settled,
            None => in_use >= self.options.sh_degree,
        };
        let is_due = (iterations / 2..iterations).contains(&step) && is_settled;
        if !is_due || self.dropped.is_some() {
            return Ok(());
        }
        let left = self.backend.drop_bands(in_use).map_err(|e| self.stopped(step, e))?;
        self.dropped = left.map(|left| Dropped { step, left });
        if let Some(RowDegrees { rows, bytes: [before, after], .. }) = left {
            tracing::info!(step, ?rows, before, after, "rows by degree, bytes");
        }
        Ok(())
    }
}
