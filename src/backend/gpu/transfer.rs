//! Between host and device: the model, photographs, rendered images, and columns of numbers.

use std::ops::Range;

use super::buffers::{SH, band_coefficients};
use super::frame::target;
use super::passes::Recorder;
use super::{GpuBackend, readback};
use crate::backend::{BackendError, Rendering};
use crate::dataset::images::Image8;
use crate::gaussians::{Gaussians, ModelArray};

impl GpuBackend {
    pub(super) fn write(&self, name: &str, bytes: &[u8]) {
        self.write_at(name, 0, bytes);
    }

    /// Writes numbers from byte `at` on.
    pub(super) fn write_at(&self, name: &str, at: u64, values: &[impl bytemuck::NoUninit]) {
        if !values.is_empty() {
            let bytes = bytemuck::cast_slice(values);
            self.device.queue.write_buffer(self.buffers.get(name), at, bytes);
        }
    }

    pub(super) fn upload(&self, model: &Gaussians) {
        let mut rows = Vec::with_capacity(12 * model.len());
        for i in 0..model.len() {
            rows.extend_from_slice(&model.means[i]);
            rows.extend_from_slice(&model.log_scales[i]);
            rows.extend_from_slice(&model.quats[i]);
            rows.extend_from_slice(&[model.opacity_logits[i], 0.0]);
        }
        self.write("rows", bytemuck::cast_slice(&rows));
        let mut first = 0;
        for (band, name) in SH.into_iter().enumerate().take(usize::from(model.sh_degree) + 1) {
            let numbers = 3 * band_coefficients(band);
            let of_row = |i| &model.sh_of(i)[first..first + numbers];
            let values: Vec<f32> = (0..model.len()).flat_map(of_row).copied().collect();
            self.write(name, bytemuck::cast_slice(&values));
            first += numbers;
        }
    }

    pub(super) fn read(&self, name: &str, from: u64, bytes: u64) -> Result<Vec<f32>, BackendError> {
        let staging = self.buffers.get("read");
        let bytes = readback::read(&self.device, staging, self.buffers.get(name), from, bytes)?;
        Ok(bytemuck::pod_collect_to_vec(&bytes))
    }

    /// Packs a photograph and uploads it; returns the bits that say what it has.
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

    /// The image of the last view rendered.
    pub(super) fn rendering(&self, width: u32, height: u32) -> Result<Rendering, BackendError> {
        let pixels = width as usize * height as usize;
        let canvas = self.read("canvas", 0, 16 * pixels as u64)?;
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

    /// Some rows of one of the model's arrays.
    pub(super) fn model_array(
        &self,
        array: ModelArray,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError> {
        let sh_degree = self.sizes.sh_degree;
        let read = |name, numbers: usize| {
            let of_row = 4 * numbers as u64;
            self.read(name, of_row * rows.start as u64, of_row * rows.len() as u64)
        };
        let parameters = array.parameters(sh_degree);
        if array != ModelArray::Sh {
            let all = read("rows", 12)?;
            return Ok(all
                .chunks_exact(12)
                .flat_map(|row| &row[parameters.clone()])
                .copied()
                .collect());
        }
        let mut sh = vec![0.0; parameters.len() * rows.len()];
        let mut first = 0;
        for (band, name) in SH.into_iter().enumerate().take(usize::from(sh_degree) + 1) {
            let numbers = 3 * band_coefficients(band);
            let to = sh.chunks_exact_mut(parameters.len());
            for (to, from) in to.zip(read(name, numbers)?.chunks_exact(numbers)) {
                to[first..first + numbers].copy_from_slice(from);
            }
            first += numbers;
        }
        Ok(sh)
    }

    /// Takes back what [`model_array`](Self::model_array) returned.
    pub(super) fn set_model_array(
        &self,
        array: ModelArray,
        rows: Range<usize>,
        values: &[f32],
    ) -> Result<(), BackendError> {
        let parameters = array.parameters(self.sizes.sh_degree);
        let (first_row, n) = (rows.start as u64, rows.len() as u64);
        let of_rows = values.chunks_exact(parameters.len());
        if array != ModelArray::Sh {
            let mut all = self.read("rows", 48 * first_row, 48 * n)?;
            for (row, values) in all.chunks_exact_mut(12).zip(of_rows) {
                row[parameters.clone()].copy_from_slice(values);
            }
            self.write_at("rows", 48 * first_row, &all);
            return Ok(());
        }
        let mut first = 0;
        for (band, name) in SH.into_iter().enumerate().take(usize::from(self.sizes.sh_degree) + 1) {
            let numbers = 3 * band_coefficients(band);
            let of_band = of_rows.clone().flat_map(|row| &row[first..first + numbers]);
            let band: Vec<f32> = of_band.copied().collect();
            self.write_at(name, 4 * numbers as u64 * first_row, &band);
            first += numbers;
        }
        Ok(())
    }

    /// Some rows of the column of one plane of numbers.
    pub(super) fn column(&self, plane: u32, rows: Range<usize>) -> Result<Vec<f32>, BackendError> {
        let start = u64::from(plane) * self.sizes.budget + rows.start as u64;
        self.read("signals", 4 * start, 4 * rows.len() as u64)
    }

    /// A column of present values; see `present` in `shaders/signals.wgsl`.
    pub(super) fn present(&self, which: u32) -> Result<Vec<f32>, BackendError> {
        let mut encoder = self.device.device.create_command_encoder(&Default::default());
        let pass = encoder.begin_compute_pass(&Default::default());
        let mut to = Recorder { pass, pipelines: &self.pipelines };
        to.run(&self.launches.present, [which, 0, 0, 0], (self.rows as u32).div_ceil(256));
        drop(to);
        self.device.queue.submit([encoder.finish()]);
        self.read("sums", 0, 4 * self.rows as u64)
    }
}
