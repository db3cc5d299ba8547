//! Looks for rows that hold a number that is not finite; see [`audit`](crate::backend::audit). A mark per
//! row comes back, no parameter.

use super::GpuBackend;
use super::buffers::{Buffers, FIRST_SH, SECOND_SH, SH, Sizes, band_coefficients};
use super::device::Device;
use super::passes::Recorder;
use super::pipelines::{Kernel, Launch, Pipelines};
use crate::backend::{Attribute, BackendError, Kept, Unsound};

/// Places per kind of numbers: 12 of the geometry, 48 of the colour.
const KIND: u32 = 64;
/// Numbers of the geometry of a row, the last of them padding.
const GEOMETRY: u32 = 12;

/// A buffer with rows: how many numbers a row has, and the place of the first of them.
#[derive(Debug)]
pub(super) struct Audited {
    launch: Launch,
    numbers: u32,
    place: u32,
}

/// The kernel, for each buffer.
pub(super) fn launches(
    device: &Device,
    sizes: &Sizes,
    buffers: &Buffers,
    pipelines: &Pipelines,
) -> Vec<Audited> {
    let kinds = [("rows", SH), ("first rows", FIRST_SH), ("second rows", SECOND_SH)];
    let mut all = Vec::new();
    for (first, (rows, bands)) in (0..).step_by(KIND as usize).zip(kinds) {
        let mut add = |name: &'static str, numbers: u32, place: u32| {
            let launch = pipelines.launch(&device.device, buffers, Kernel::Audit, &["sums", name]);
            all.push(Audited { launch, numbers, place: first + place });
        };
        add(rows, GEOMETRY, 0);
        let mut place = GEOMETRY;
        for (band, name) in bands.into_iter().enumerate().take(usize::from(sizes.sh_degree) + 1) {
            let numbers = 3 * band_coefficients(band) as u32;
            add(name, numbers, place);
            place += numbers;
        }
    }
    all
}

impl GpuBackend {
    /// The rows that hold a number that is not finite, in order.
    pub(super) fn unsound(&self) -> Result<Vec<Unsound>, BackendError> {
        let rows = self.rows as u32;
        let bytes = 4 * u64::from(rows);
        let mut encoder = self.device.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(self.buffers.get("sums"), 0, Some(bytes.next_multiple_of(16)));
        let pass = encoder.begin_compute_pass(&Default::default());
        let mut to = Recorder { pass, pipelines: &self.pipelines };
        for Audited { launch, numbers, place } in &self.audited {
            to.run(launch, [rows, *numbers, *place, 0], rows.div_ceil(256));
        }
        drop(to);
        self.device.queue.submit([encoder.finish()]);
        let marks = self.read("sums", 0, bytes)?;
        let marked = (0..).zip(&marks).filter_map(|(row, mark)| {
            let place = mark.to_bits().checked_sub(1)?;
            let kept = if place < KIND { Kept::Parameter } else { Kept::Moment };
            let attribute = Attribute::of((place % KIND) as usize);
            Some(Unsound { row, attribute, kept })
        });
        Ok(marked.collect())
    }
}
