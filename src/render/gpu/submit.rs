//! Submits a view's passes, and repeats them with more bands if there were too few.

use super::frame::{Frame, State};
use super::passes::{Passes, Recorder, Shape};
use super::{GpuBackend, exposure, pose, readback, vignette};
use crate::BackendError;

impl GpuBackend {
    /// Encodes and submits a view's passes until the number of bands suffices. Returns the state that they leave and
    /// the sizes that they were encoded with. `encode` records all passes.
    pub(super) fn run(
        &mut self,
        frame: &Frame,
        encode: impl Fn(&Passes<'_>, &mut Recorder<'_>),
    ) -> Result<(State, Shape), BackendError> {
        self.write("frame", bytemuck::bytes_of(frame));
        let [rows, ..] = frame.model;
        let tiles = frame.image[3];
        loop {
            let shape = Shape { rows, tiles, bands: self.bands };
            let passes = Passes { launches: &self.launches, shape };
            let mut encoder = self.device.device.create_command_encoder(&Default::default());
            if shape.bands > 1 {
                encoder.clear_buffer(self.buffers.get("tile counts"), 0, None);
            }
            let pass = encoder.begin_compute_pass(&Default::default());
            let mut to = Recorder::new(pass, self.buffers.get("groups"));
            to.stages.clock = self.device.clock.as_ref();
            encode(&passes, &mut to);
            let stages = to.end();
            let staging = self.buffers.get("read");
            let state_bytes = size_of::<State>() as u64;
            encoder.copy_buffer_to_buffer(self.buffers.get("state"), 0, staging, 0, state_bytes);
            let totals = [
                (self.sizes.exposures, "exposure total", exposure::SUMS),
                (self.sizes.vignettes, "vignette total", vignette::SUMS),
                (self.sizes.poses, "pose total", pose::SUMS),
            ];
            let mut bytes = state_bytes;
            for (_, name, length) in totals.iter().filter(|(exists, ..)| *exists) {
                let total = self.buffers.get(name);
                encoder.copy_buffer_to_buffer(total, 0, staging, bytes, *length);
                bytes += length;
            }
            let read = readback::finish(&self.device, staging, encoder, bytes)?;
            let (state, mut read) = read.split_at(size_of::<State>());
            let state: State = bytemuck::pod_read_unaligned(state);
            if self.sizes.exposures {
                let (sums, others) = read.split_at(size_of_val(&self.exposure_sums));
                (self.exposure_sums, read) = (bytemuck::pod_read_unaligned(sums), others);
            }
            if self.sizes.vignettes {
                let (sums, others) = read.split_at(size_of_val(&self.vignette_sums));
                (self.vignette_sums, read) = (bytemuck::pod_read_unaligned(sums), others);
            }
            if self.sizes.poses {
                self.pose_sums = bytemuck::pod_read_unaligned(read);
            }
            if state.broken_off != 0 {
                return Err(BackendError::LoopCut {
                    device: self.device.summary.name.clone(),
                    accumulation: self.device.accumulation,
                });
            }
            if state.short == 0 {
                if let Some(clock) = &self.device.clock {
                    self.stage_times = clock.stage_times(&self.device, &stages)?;
                }
                self.bands = state.bands.max(1);
                return Ok((state, shape));
            }
            // With one band, the number needed is a guess; with several, the device has counted it.
            let guess = (2 * u64::from(state.total)).div_ceil(self.sizes.cap).max(2);
            let needed = if shape.bands == 1 { guess } else { u64::from(state.bands) };
            self.bands = needed.min(u64::from(tiles)) as u32;
        }
    }

    /// Encodes more passes over the current view and submits them.
    pub(super) fn continue_view(
        &self,
        shape: Shape,
        encode: impl FnOnce(&Passes<'_>, &mut Recorder<'_>),
    ) {
        let passes = Passes { launches: &self.launches, shape };
        self.submit(|to| encode(&passes, to));
    }

    /// Submits the dispatches that `encode` records.
    pub(super) fn submit(&self, encode: impl FnOnce(&mut Recorder<'_>)) {
        let mut encoder = self.device.device.create_command_encoder(&Default::default());
        let pass = encoder.begin_compute_pass(&Default::default());
        encode(&mut Recorder::new(pass, self.buffers.get("groups")));
        self.device.queue.submit([encoder.finish()]);
    }
}
