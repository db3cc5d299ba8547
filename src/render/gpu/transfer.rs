//! Transfers between host and device: the model, photographs, rendered images and signals.

use std::ops::Range;

use densify_policies::policy::Signal;

use super::frame::target;
use super::passes::Record;
use super::rows::{Content, RowArray};
use super::{GpuBackend, ResidentPhotograph, readback};
use crate::signals::ParameterSignal;
use crate::{BackendError, Rendering};
use densify_core::budget::RowBudget;
use densify_core::gaussians::{Gaussians, ModelArray};
use densify_core::image::Image8;
use densify_core::pieces::pieces;

impl GpuBackend {
    pub(super) fn write(&self, name: &str, bytes: &[u8]) {
        self.write_at(name, 0, bytes);
    }

    /// Writes numbers, starting at byte `at`.
    pub(super) fn write_at(&self, name: &str, at: u64, values: &[impl bytemuck::NoUninit]) {
        if !values.is_empty() {
            let bytes = bytemuck::cast_slice(values);
            let (buffer, first) = self.buffers.place(name);
            self.device.write(buffer, first + at, bytes);
        }
    }

    pub(super) fn upload(&self, model: &Gaussians) {
        for array in self.sizes.parameters() {
            for piece in pieces(model.len()) {
                let first = 4 * (piece.start * array.numbers) as u64;
                let values = gather(model, &array, piece);
                self.write_at(array.name, first, &array.words_of(&values));
            }
        }
    }

    pub(super) fn read(&self, name: &str, from: u64, bytes: u64) -> Result<Vec<f32>, BackendError> {
        let staging = self.buffers.get("read");
        let (buffer, first) = self.buffers.place(name);
        let bytes = readback::read(&self.device, staging, buffer, first + from, bytes)?;
        Ok(bytemuck::pod_collect_to_vec(&bytes))
    }

    /// Packs and uploads a photograph; returns its bits of [`target`].
    pub(super) fn upload_target(&self, image: &Image8) -> u32 {
        let pixels = image.width as usize * image.height as usize;
        let mut words = vec![0_u32; pixels];
        for (word, rgb) in words.iter_mut().zip(image.rgb.as_chunks::<3>().0) {
            *word = u32::from_le_bytes([rgb[0], rgb[1], rgb[2], 255]);
        }
        if let Some(alpha) = &image.alpha {
            for (word, &a) in words.iter_mut().zip(alpha) {
                *word = *word & 0x00ff_ffff | u32::from(a) << 24;
            }
        }
        self.write("truth", bytemuck::cast_slice(&words));
        if let Some(mask) = &image.mask {
            let mut mask = mask.clone();
            mask.resize(mask.len().next_multiple_of(4), 0);
            self.write("mask", &mask);
        }
        (if image.alpha.is_some() { target::HAS_ALPHA } else { 0 })
            | (if image.mask.is_some() { target::HAS_MASK } else { 0 })
    }

    /// Copies a view's photograph to the buffer that the loss reads, and keeps it on the device if there is room.
    /// Returns its bits of [`target`]. A view always has the same photograph, though its size may change.
    pub(super) fn load_photograph(&mut self, view: usize, image: &Image8) -> u32 {
        let size = [image.width, image.height];
        let resident = self.photographs.get(&view).copied();
        if let Some(photograph) = resident.filter(|photograph| photograph.size == size) {
            self.copy_photograph(photograph, false);
            return photograph.flags;
        }
        let flags = self.upload_target(image);
        let room = self.sizes.photographs;
        // A view whose image size has changed keeps its slot.
        let slot = resident.map_or(self.photographs.len() as u64, |photograph| photograph.slot);
        if slot < room.count as u64 && (flags & target::HAS_MASK == 0 || room.with_masks) {
            let photograph = ResidentPhotograph { slot, size, flags };
            self.copy_photograph(photograph, true);
            self.photographs.insert(view, photograph);
        }
        flags
    }

    /// Copies a photograph between its slot and the buffers that the loss reads: to the slot if `keep`, else from it.
    fn copy_photograph(&self, photograph: ResidentPhotograph, keep: bool) {
        let ResidentPhotograph { slot, size: [width, height], flags } = photograph;
        let pixels = u64::from(width) * u64::from(height);
        let [truth_bytes, mask_bytes] = self.sizes.photograph_bytes();
        let truth = slot * (truth_bytes + mask_bytes);
        let mut parts = vec![("truth", truth, 4 * pixels)];
        if flags & target::HAS_MASK != 0 {
            parts.push(("mask", truth + truth_bytes, pixels.next_multiple_of(4)));
        }
        let all = self.buffers.get("photographs");
        let mut encoder = self.device.device.create_command_encoder(&Default::default());
        for (name, at, bytes) in parts {
            let current = self.buffers.get(name);
            if keep {
                encoder.copy_buffer_to_buffer(current, 0, all, at, bytes);
            } else {
                encoder.copy_buffer_to_buffer(all, at, current, 0, bytes);
            }
        }
        self.device.queue.submit([encoder.finish()]);
    }

    /// Reads the last rendered image, with its photograph's exposure if `is_exposed`.
    pub(super) fn rendering(
        &self,
        width: u32,
        height: u32,
        is_exposed: bool,
    ) -> Result<Rendering, BackendError> {
        let pixels = width as usize * height as usize;
        let image = if is_exposed { "exposed" } else { "canvas" };
        let canvas = self.read(image, 0, 16 * pixels as u64)?;
        let finish = self.read("finish", 0, 8 * pixels as u64)?;
        let canvas = canvas.as_chunks::<4>().0;
        Ok(Rendering {
            width,
            height,
            rgb: canvas.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect(),
            alpha: finish.as_chunks::<2>().0.iter().map(|[light, _]| 1.0 - light).collect(),
            depth: canvas.iter().map(|[.., depth]| *depth).collect(),
        })
    }

    /// Reads rows of an array, with zeros for rows that it does not store.
    pub(super) fn read_rows(
        &self,
        array: &RowArray,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError> {
        let (first, missing) = stored_rows(self.sizes.row_range(array)[0], &rows);
        let (bytes, count) = (array.row_bytes(), rows.len() - missing);
        let mut values = vec![0.0; array.numbers * missing];
        values.extend(self.read(array.name, bytes * first, bytes * count as u64)?);
        Ok(values)
    }

    /// Reads all parameters of an array, row after row.
    fn parameter_rows(
        &self,
        array: &RowArray,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError> {
        let words = self.read_rows(array, rows)?;
        Ok(array.parameters_of(bytemuck::cast_slice(&words)))
    }

    /// Reads parameters of rows, row after row.
    pub(super) fn parameters_of(
        &self,
        wanted: &Range<usize>,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError> {
        let mut all = vec![0.0; wanted.len() * rows.len()];
        for from in self.sizes.parameters() {
            if let Some((here, there)) = overlap(wanted, &from.parameters) {
                let read = self.parameter_rows(&from, rows.clone())?;
                let to = all.chunks_exact_mut(wanted.len());
                for (to, from) in to.zip(read.chunks_exact(from.parameters.len())) {
                    to[here.clone()].copy_from_slice(&from[there.clone()]);
                }
            }
        }
        Ok(all)
    }

    /// Reads an attribute of all rows, in pieces.
    pub(super) fn read_attribute(
        &self,
        attribute: &ParameterSignal,
        column: &mut [f32],
    ) -> Result<(), BackendError> {
        let width = attribute.parameters.len();
        for rows in pieces(self.rows) {
            let values = self.parameters_of(&attribute.parameters, rows.clone())?;
            for (to, from) in column[width * rows.start..].iter_mut().zip(values) {
                *to = (attribute.convert)(from);
            }
        }
        Ok(())
    }

    /// Writes parameters of rows, row after row: the inverse of [`parameters_of`](Self::parameters_of).
    pub(super) fn set_parameters(
        &self,
        given: &Range<usize>,
        rows: Range<usize>,
        values: &[f32],
    ) -> Result<(), BackendError> {
        for to in self.sizes.parameters() {
            if let Some((here, there)) = overlap(given, &to.parameters) {
                let count = to.parameters.len();
                let mut all = if there.len() == count {
                    vec![0.0; count * rows.len()]
                } else {
                    self.parameter_rows(&to, rows.clone())?
                };
                let by_row = all.chunks_exact_mut(count);
                for (to, from) in by_row.zip(values.chunks_exact(given.len())) {
                    to[there.clone()].copy_from_slice(&from[here.clone()]);
                }
                self.write_at(to.name, to.row_bytes() * rows.start as u64, &to.words_of(&all));
            }
        }
        Ok(())
    }

    /// Reads rows of a signal plane, with zeros for frozen rows.
    pub(super) fn column(
        &self,
        plane: usize,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError> {
        let (first, missing) = stored_rows(self.sizes.budget.frozen as u64, &rows);
        let start = plane as u64 * self.sizes.trained() + first;
        let mut values = vec![0.0; missing];
        values.extend(self.read("signals", 4 * start, 4 * (rows.len() - missing) as u64)?);
        Ok(values)
    }

    /// Computes and reads a signal that depends only on the current rows, with zeros for frozen rows; see `present` in
    /// `shaders/signals.wgsl`.
    pub(super) fn present(&self, signal: Signal) -> Result<Vec<f32>, BackendError> {
        let (rows, launch) = (self.rows as u32, self.launches.get("present"));
        let start = self.mask.map_or(0.0, |mask| mask.start);
        let RowBudget { frozen, .. } = self.sizes.budget;
        let immediates = [signal as u32, rows, start.to_bits(), frozen as u32];
        self.submit(|to| to.run(launch, immediates, rows.div_ceil(256)));
        let mut values = vec![0.0; frozen];
        values.extend(self.read("sums", 0, 4 * self.sizes.budget.trained(self.rows) as u64)?);
        Ok(values)
    }
}

/// The common part of two ranges, relative to the start of each; `None` if they are disjoint.
fn overlap(a: &Range<usize>, b: &Range<usize>) -> Option<(Range<usize>, Range<usize>)> {
    let (start, end) = (a.start.max(b.start), a.end.min(b.end));
    (start < end).then(|| (start - a.start..end - a.start, start - b.start..end - b.start))
}

/// For an array whose first stored row is `first`: the index in the array of the first of `rows` that is stored, and
/// the number of `rows` that are not.
pub(super) fn stored_rows(first: u64, rows: &Range<usize>) -> (u64, usize) {
    let stored = (first as usize).clamp(rows.start, rows.end);
    ((stored as u64).saturating_sub(first), stored - rows.start)
}

/// The parameters of an array for some rows of a model, row by row.
fn gather(model: &Gaussians, array: &RowArray, rows: Range<usize>) -> Vec<f32> {
    let mut values = Vec::with_capacity(array.parameters.len() * rows.len());
    for row in rows {
        if array.content == Content::Geometry {
            values.extend_from_slice(&model.means[row]);
            values.extend_from_slice(&model.log_scales[row]);
            values.extend_from_slice(&model.quats[row]);
            values.push(model.opacity_logits[row]);
        } else {
            let Range { start, end } = array.parameters;
            let first = ModelArray::Sh.parameters(model.sh_degree).start;
            values.extend_from_slice(&model.sh_of(row)[start - first..end - first]);
        }
    }
    values
}
