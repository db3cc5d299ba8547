//! Measurement of the finished model against a known surface: its backend and its memory.

use densify_core::budget::RowBudget;
use densify_core::memory::{Ledger, Section};
use densify_render::{Device, Setup};
use densify_train::metrics::geometry;

/// A measurement of a model in a scene whose surface is known.
#[derive(Debug, Clone)]
pub(crate) struct GeometryMeasurement {
    pub(crate) device: Device,
    /// Setup of the backend, for any number of rows.
    pub(crate) setup: Setup,
    /// Number of threads that measure.
    pub(crate) threads: usize,
    /// Memory of the known surface `[bytes]`.
    pub(crate) surface: u64,
    /// Number of views held out.
    pub(crate) views: usize,
}

impl GeometryMeasurement {
    /// The ledger of training, with the memory for measuring a model of this many rows afterwards.
    pub(super) fn added_to(&self, training: &Ledger, rows: usize, sh_degree: u8) -> Ledger {
        let mut counted = training.clone();
        let [host, device] = self.bytes(rows, sh_degree);
        // Measuring reuses the device memory of training; only an excess is added.
        let excess = device.saturating_sub(training.on_device());
        counted.add_to(Section::After, "measuring geometry", host + excess);
        counted
    }

    /// Memory for measuring on the host, in addition to that of the process, and on the device `[bytes]`.
    pub(crate) fn bytes(&self, rows: usize, sh_degree: u8) -> [u64; 2] {
        let setup = self.for_rows(rows);
        let plan = self.device.memory_plan(sh_degree, &setup, self.threads);
        let geometry = geometry::bytes(rows, sh_degree, setup.largest_image, self.views);
        [plan.on_host() + geometry + self.surface, plan.on_device()]
    }

    /// The backend for a model of this many rows.
    pub(crate) fn for_rows(&self, rows: usize) -> Setup {
        let rows = rows.max(1);
        // Few views have more than three pairs per row; those that do are rendered in bands, with the same result.
        let pairs =
            rows.saturating_mul(3).min(self.device.most_pairs(&self.setup.needs, self.setup.depth));
        let cap = self.setup.tile_cap.map_or(pairs, |cap| cap.min(pairs));
        Setup {
            budget: RowBudget { total: rows, ..self.setup.budget },
            tile_cap: Some(cap.max(rows)),
            // No gradient is computed.
            record_cap: rows,
            ..self.setup.clone()
        }
    }
}
