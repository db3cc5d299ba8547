//! Saves and restores the GPU backend's state as named arrays: its buffers row by row, with zeros for frozen rows
//! that are not stored.
//!
//! The names begin with `device`, as the native backend must not resume from them: its sums have another order.

use std::ops::Range;

use super::rows::{Content, RowArray};
use super::transfer::stored_rows;
use super::{GpuBackend, Waiting};
use crate::{BackendError, StateArray, StateError, Tensor};

/// Prefix of an array that is a whole buffer.
const BUFFER: &str = "device.";
/// Prefix of a signal's array.
const SIGNAL: &str = "device.signals.";
/// Array of the parameter groups whose gradients wait for an optimiser step.
const WAITING: &str = "device.waits";
const CANDIDATES: &str = "candidates";

impl GpuBackend {
    /// The saved arrays, without the model and the signals.
    fn saved_arrays(&self) -> impl Iterator<Item = RowArray> {
        self.sizes.row_arrays().into_iter().filter(|array| array.content.traits().is_saved)
    }

    fn saved_array(&self, name: &str) -> Option<RowArray> {
        let name = name.strip_prefix(BUFFER)?;
        self.saved_arrays().find(|array| array.name == name)
    }

    fn signal_plane(&self, name: &str) -> Option<usize> {
        let name = name.strip_prefix(SIGNAL)?;
        self.planes.saved().into_iter().find(|(known, _)| known == name).map(|(_, plane)| plane)
    }

    pub(super) fn state_arrays(&self) -> Vec<StateArray> {
        let buffers = self.saved_arrays().map(|array| format!("{BUFFER}{}", array.name));
        let signals = self.planes.saved().into_iter().map(|(name, _)| format!("{SIGNAL}{name}"));
        let mut arrays: Vec<StateArray> = buffers.chain(signals).map(StateArray::of_rows).collect();
        arrays.push(StateArray::small(WAITING));
        if self.candidates.request.is_some() {
            arrays.push(StateArray::small(CANDIDATES));
        }
        arrays
    }

    /// Copies some rows of an array.
    ///
    /// # Panics
    /// When the array does not exist: a bug in the caller.
    pub(super) fn state_tensor(
        &self,
        name: &str,
        rows: Range<usize>,
    ) -> Result<Tensor, BackendError> {
        if name == WAITING {
            let waiting = [self.waiting.main, self.waiting.rest].map(u8::from);
            return Ok(Tensor::u8(name, &[2], waiting.to_vec()));
        }
        if name == CANDIDATES {
            return Ok(self.candidates.tensor(name));
        }
        if let Some(plane) = self.signal_plane(name) {
            return Ok(Tensor::f32(name, &[rows.len()], self.column(plane, rows)?));
        }
        let array = self.saved_array(name);
        let array = array.unwrap_or_else(|| panic!("this backend has no state array `{name}`"));
        let values = self.read_rows(&array, rows.clone())?;
        if is_of_bytes(&array) {
            let bytes = bytemuck::cast_slice(&values).to_vec();
            return Ok(Tensor::u8(name, &[rows.len(), 4 * array.numbers], bytes));
        }
        Ok(Tensor::f32(name, &[rows.len(), array.numbers], values))
    }

    pub(super) fn restore_tensor(
        &mut self,
        tensor: Tensor,
        rows: Range<usize>,
    ) -> Result<(), StateError> {
        let name = tensor.name.clone();
        if name == WAITING {
            let waiting = tensor.into_u8(&[2])?;
            let [main, rest] = [0, 1].map(|i| waiting[i] != 0);
            self.waiting = Waiting { main, rest };
        } else if name == CANDIDATES && self.candidates.request.is_some() {
            self.candidates.restore(tensor)?;
        } else if let Some(plane) = self.signal_plane(&name) {
            let values = tensor.into_f32(&[rows.len()])?;
            let (first, missing) = stored_rows(self.sizes.budget.frozen as u64, &rows);
            let start = plane as u64 * self.sizes.trained() + first;
            self.write_at("signals", 4 * start, &values[missing..]);
        } else if let Some(array) = self.saved_array(&name) {
            let [first_row, _] = self.sizes.row_range(&array);
            let (first, missing) = stored_rows(first_row, &rows);
            let at = array.row_bytes() * first;
            if is_of_bytes(&array) {
                let width = 4 * array.numbers;
                let values = tensor.into_u8(&[rows.len(), width])?;
                self.write_at(array.name, at, &values[width * missing..]);
            } else {
                let values = tensor.into_f32(&[rows.len(), array.numbers])?;
                self.write_at(array.name, at, &values[array.numbers * missing..]);
            }
        } else {
            return Err(tensor.error("this run has no such array"));
        }
        Ok(())
    }
}

/// True if the numbers are no floats; their bits are saved as bytes.
fn is_of_bytes(array: &RowArray) -> bool {
    matches!(array.content, Content::Ages | Content::NarrowMoments)
}
