//! The GPU backend's state as named arrays: its buffers row by row, as the device holds them.
//!
//! They are named after the device, so that the native backend, whose sums have another order, does
//! not go on from them unasked.

use std::ops::Range;

use super::GpuBackend;
use super::buffers::{FIRST_SH, SECOND_SH, WAITING_SH, band_coefficients};
use crate::backend::{BackendError, StateArray, StateError, Tensor};

/// Before the name of a buffer.
const BUFFER: &str = "device.";
/// Before the name of a signal.
const SIGNAL: &str = "device.signals.";
const WAITS: &str = "device.waits";
const CANDIDATES: &str = "candidates";
/// The buffer whose numbers are whole.
const AGES: &str = "ages";

impl GpuBackend {
    /// The buffers that outlive a step, beside the model: name and numbers per row.
    fn kept(&self) -> Vec<(&'static str, usize)> {
        let mut all = vec![("first rows", 12), ("second rows", 12), (AGES, 1)];
        let bands = usize::from(self.sizes.sh_degree) + 1;
        for names in [FIRST_SH, SECOND_SH] {
            let names = names.into_iter().take(bands).enumerate();
            all.extend(names.map(|(band, name)| (name, 3 * band_coefficients(band))));
        }
        let [main_waits, rest_waits] = self.sizes.waits();
        if main_waits {
            all.push(("waiting rows", 12));
        }
        for (band, name) in WAITING_SH.into_iter().take(bands).enumerate() {
            if if band == 0 { main_waits } else { rest_waits } {
                all.push((name, 3 * band_coefficients(band)));
            }
        }
        all
    }

    fn buffer(&self, name: &str) -> Option<(&'static str, usize)> {
        let name = name.strip_prefix(BUFFER)?;
        self.kept().into_iter().find(|(known, _)| *known == name)
    }

    fn signal(&self, name: &str) -> Option<u32> {
        let name = name.strip_prefix(SIGNAL)?;
        self.planes.kept().find(|(known, _)| known == name).map(|(_, plane)| plane)
    }

    pub(super) fn state_arrays(&self) -> Vec<StateArray> {
        let buffers = self.kept().into_iter().map(|(name, _)| format!("{BUFFER}{name}"));
        let signals = self.planes.kept().map(|(name, _)| format!("{SIGNAL}{name}"));
        let mut arrays: Vec<StateArray> = buffers.chain(signals).map(StateArray::of_rows).collect();
        arrays.push(StateArray::small(WAITS));
        if self.candidates.is_wanted() {
            arrays.push(StateArray::small(CANDIDATES));
        }
        arrays
    }

    /// # Panics
    /// When there is no such array: a bug in the caller.
    pub(super) fn state_tensor(
        &self,
        name: &str,
        rows: Range<usize>,
    ) -> Result<Tensor, BackendError> {
        if name == WAITS {
            let waits = [self.waiting.main, self.waiting.rest].map(u8::from);
            return Ok(Tensor::u8(name, &[2], waits.to_vec()));
        }
        if name == CANDIDATES {
            return Ok(self.candidates.tensor(name));
        }
        if let Some(plane) = self.signal(name) {
            return Ok(Tensor::f32(name, &[rows.len()], self.column(plane, rows)?));
        }
        let found = self.buffer(name);
        let (buffer, numbers) =
            found.unwrap_or_else(|| panic!("there is no `{name}` in this backend's state"));
        // Ages are whole numbers in the same four bytes.
        let of_row = 4 * numbers as u64;
        let values = self.read(buffer, of_row * rows.start as u64, of_row * rows.len() as u64)?;
        if buffer == AGES {
            let bytes = bytemuck::cast_slice(&values).to_vec();
            return Ok(Tensor::u8(name, &[rows.len(), 4], bytes));
        }
        Ok(Tensor::f32(name, &[rows.len(), numbers], values))
    }

    pub(super) fn restore_tensor(
        &mut self,
        tensor: Tensor,
        rows: Range<usize>,
    ) -> Result<(), StateError> {
        let first = rows.start as u64;
        let name = tensor.name.clone();
        if name == WAITS {
            let waits = tensor.into_u8(&[2])?;
            let [main, rest] = [0, 1].map(|i| waits[i] != 0);
            self.waiting = super::Waiting { main, rest };
        } else if name == CANDIDATES && self.candidates.is_wanted() {
            self.candidates.restore(tensor)?;
        } else if let Some(plane) = self.signal(&name) {
            let values = tensor.into_f32(&[rows.len()])?;
            let start = u64::from(plane) * self.sizes.budget + first;
            self.write_at("signals", 4 * start, &values);
        } else if let Some((buffer, numbers)) = self.buffer(&name) {
            if buffer == AGES {
                let ages = tensor.into_u8(&[rows.len(), 4])?;
                self.write_at(buffer, 4 * first, &ages);
            } else {
                let values = tensor.into_f32(&[rows.len(), numbers])?;
                self.write_at(buffer, 4 * numbers as u64 * first, &values);
            }
        } else {
            return Err(tensor.error("this run keeps nothing of that name"));
        }
        Ok(())
    }
}
