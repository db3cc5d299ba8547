//! The native backend's state as named arrays. Lanes beyond the last row are left out, and frozen rows that have no
//! state are saved as zeros.

use std::ops::Range;

use super::CpuBackend;
use super::blocks::planes;
use super::signals::Accumulators;
use super::summed::WAITING;
use crate::{StateArray, StateError, Tensor};

const MOMENTS: [&str; 2] = ["moments.first", "moments.second"];
const AGES: &str = "ages";
const MASKS: &str = "masks";
const CANDIDATES: &str = "candidates";
/// Prefix of a signal's array.
const SIGNAL: &str = "signals.";
/// Prefix of the arrays of [summed gradients](super::summed).
const SUMMED: &str = "summed.";

impl CpuBackend {
    pub(super) fn state_arrays(&self) -> Vec<StateArray> {
        let of_rows = MOMENTS.into_iter().chain([AGES]).map(StateArray::of_rows);
        let mut arrays: Vec<StateArray> = of_rows.collect();
        arrays.extend(self.masks.is_declared().then(|| StateArray::of_rows(MASKS)));
        let signals = self.signals.planes.saved();
        arrays.extend(
            signals.into_iter().map(|(name, _)| StateArray::of_rows(format!("{SIGNAL}{name}"))),
        );
        if self.candidates.request.is_some() {
            arrays.push(StateArray::small(CANDIDATES));
        }
        arrays.extend(
            self.summed.state().iter().map(|part| StateArray {
                name: format!("{SUMMED}{part}"),
                by_rows: *part != WAITING,
            }),
        );
        arrays
    }

    /// Copies some rows of an array.
    ///
    /// # Panics
    /// When the array does not exist: a bug in the caller.
    pub(super) fn state_tensor(&self, name: &str, rows: Range<usize>) -> Tensor {
        if let Some(i) = MOMENTS.iter().position(|moments| *moments == name) {
            let planes = planes(self.sh_degree);
            return self.moments.tensor(i, name, rows, planes);
        }
        if name == AGES {
            return Tensor::u16(name, &[rows.len()], self.ages.to_rows(rows, 0..1));
        }
        if name == MASKS {
            return self.masks.tensor(name, rows);
        }
        if name == CANDIDATES {
            return self.candidates.tensor(name);
        }
        if let Some(plane) = signal_plane(&self.signals, name) {
            let shape = [rows.len()];
            let values = self.signals.blocks.to_rows(rows, plane..plane + 1);
            return Tensor::f32(name, &shape, values);
        }
        let summed = name.strip_prefix(SUMMED).and_then(|part| self.summed.tensor(part, rows));
        summed.unwrap_or_else(|| panic!("this backend has no state array `{name}`"))
    }

    pub(super) fn restore_tensor(
        &mut self,
        tensor: Tensor,
        rows: Range<usize>,
    ) -> Result<(), StateError> {
        let name = tensor.name.clone();
        if let Some(i) = MOMENTS.iter().position(|moments| *moments == name) {
            let planes = planes(self.sh_degree);
            self.moments.restore(i, rows, planes, tensor)?;
        } else if name == AGES {
            let ages = tensor.into_u16(&[rows.len()])?;
            self.ages.set_rows(rows, 0..1, &ages);
        } else if name == MASKS && self.masks.is_declared() {
            self.masks.restore(rows, tensor)?;
        } else if name == CANDIDATES && self.candidates.request.is_some() {
            self.candidates.restore(tensor)?;
        } else if let Some(plane) = signal_plane(&self.signals, &name) {
            let values = tensor.into_f32(&[rows.len()])?;
            self.signals.blocks.set_rows(rows, plane..plane + 1, &values);
        } else if let Some(part) = name.strip_prefix(SUMMED) {
            self.summed.restore(part, rows, tensor)?;
        } else {
            return Err(tensor.error("this run has no such array"));
        }
        Ok(())
    }
}

fn signal_plane(signals: &Accumulators, name: &str) -> Option<usize> {
    let name = name.strip_prefix(SIGNAL)?;
    signals.planes.saved().into_iter().find(|(signal, _)| signal == name).map(|(_, plane)| plane)
}
