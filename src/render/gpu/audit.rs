//! Finds rows with a number that is not finite; see [`audit`](crate::audit). Only a mark per row is copied to the host.

use super::GpuBackend;
use super::launches::{Audit, MOMENT_MARKS};
use super::passes::{Record, Recorder};
use crate::{BackendError, NonFinite, NumberKind};
use densify_core::gaussians::ModelArray;

impl GpuBackend {
    /// The rows with a number that is not finite, in order.
    pub(super) fn find_non_finite(&self) -> Result<Vec<NonFinite>, BackendError> {
        let rows = self.rows as u32;
        let bytes = 4 * u64::from(rows);
        let mut encoder = self.device.device.create_command_encoder(&Default::default());
        let (buffer, first) = self.buffers.place("sums");
        encoder.clear_buffer(buffer, first, Some(bytes.next_multiple_of(16)));
        let pass = encoder.begin_compute_pass(&Default::default());
        let mut to = Recorder::new(pass, self.buffers.get("groups"));
        for Audit { launch, first_row, numbers, mark } in &self.launches.audits {
            let groups = rows.saturating_sub(*first_row).div_ceil(256);
            to.run(launch, [rows, *numbers, *mark, *first_row], groups);
        }
        drop(to);
        self.device.queue.submit([encoder.finish()]);
        let marks = self.read("sums", 0, bytes)?;
        let marked = (0..).zip(&marks).filter_map(|(row, mark)| {
            let place = mark.to_bits().checked_sub(1)?;
            let kind =
                if place < MOMENT_MARKS { NumberKind::Parameter } else { NumberKind::Moment };
            let array = ModelArray::of_parameter((place % MOMENT_MARKS) as usize);
            Some(NonFinite { row, array, kind })
        });
        Ok(marked.collect())
    }
}
