//! Writes SOG.

use std::io::{self, Write};

use serde_json::json;

use super::VARIANTS;
use super::codebook::Codebook;
use super::layout::{ANTIALIASED, FIRST_LARGEST, META, OFFSET, PALETTE_WIDTH};
use super::palette::{self, Palette};
use super::picture::{MAX_SIDE, Picture, image_size};
use crate::models::quantise::{MAX_LOG_SCALE, smallest_three};
use crate::models::statement::KERNEL;
use crate::models::write::unfit;
use crate::models::zip::ZipWriter;
use crate::models::{Format, ModelWriter, Shape};
use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::{Gaussians, sh_coefficients, sigmoid};

/// Maximum number of palette entries: an index has 16 bits.
const MAX_PALETTE: usize = 1 << 16;

/// Holds all Gaussians, because codebooks and palette are fitted to all of them.
#[derive(Default)]
pub(super) struct SogWriter {
    /// Gaussians per entry of the palette; `None` chooses the number of entries as splat-transform does.
    sharing: Option<usize>,
    sh_degree: u8,
    antialiasing: Antialiasing,
    offset: Option<[f64; 3]>,
    means: Vec<[f32; 3]>,
    log_scales: Vec<[f32; 3]>,
    quats: Vec<[u8; 4]>,
    colours: Vec<[f32; 3]>,
    opacities: Vec<u8>,
    /// Estimate of the image area that each Gaussian covers, times its opacity.
    weights: Vec<f32>,
    /// Shape: `[rows, 3·coefficients]`.
    bands: Vec<f32>,
}

impl ModelWriter for SogWriter {
    fn held_bytes(&self, Shape { rows, sh_degree, .. }: Shape) -> u64 {
        let bands = 3 * (sh_coefficients(sh_degree) - 1);
        let held = 12 + 12 + 4 + 12 + 1 + 4 + 4 * bands;
        // Beside the held Gaussians: the current image (pixels, predicted pixels, and two files), finished images of at
        // most 32 bytes per Gaussian, and the fit of the palette.
        let picture = 5 * 4;
        let palette = if bands > 0 { palette::row_bytes(bands) } else { 0 };
        ((rows + 64 * PALETTE_WIDTH) * (held + picture + 32 + palette)) as u64 + (1 << 20)
    }

    fn wants_spatial_order(&self) -> bool {
        true
    }

    fn variants(&self) -> &'static [Format] {
        &VARIANTS
    }

    fn states_offset(&self) -> bool {
        true
    }

    fn begin(&mut self, shape: Shape, _out: &mut dyn Write) -> io::Result<()> {
        let Shape { rows, sh_degree, antialiasing, frame } = shape;
        if rows == 0 || rows > MAX_SIDE * MAX_SIDE {
            return Err(unfit(format!(
                "SOG holds 1 to 268 million Gaussians, not {rows}; choose another format, such as ply"
            )));
        }
        self.sh_degree = sh_degree;
        self.antialiasing = antialiasing;
        self.offset = frame.offset();
        self.means.reserve_exact(rows);
        self.log_scales.reserve_exact(rows);
        self.quats.reserve_exact(rows);
        self.colours.reserve_exact(rows);
        self.opacities.reserve_exact(rows);
        self.weights.reserve_exact(rows);
        self.bands.reserve_exact(3 * (sh_coefficients(sh_degree) - 1) * rows);
        Ok(())
    }

    fn rows(&mut self, rows: &Gaussians, _out: &mut dyn Write) -> io::Result<()> {
        self.means.extend_from_slice(&rows.means);
        for row in 0..rows.len() {
            let logs = rows.log_scales[row].map(|log| log.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE));
            let (dc, bands) = rows.sh_of(row).split_at(3);
            let opacity = sigmoid(rows.opacity_logits[row]);
            let mut sorted = logs;
            sorted.sort_by(f32::total_cmp);
            self.weights.push(opacity * (sorted[1] + sorted[2]).exp());
            self.log_scales.push(logs);
            self.colours.push([dc[0], dc[1], dc[2]]);
            self.bands.extend_from_slice(bands);
            self.opacities.push((255.0 * opacity).round() as u8);
            self.quats.push(quaternion(rows.quats[row]));
        }
        Ok(())
    }

    fn finish(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let rows = self.means.len();
        self.normalise_weights();
        let (width, height) = image_size(rows);
        let picture = || Picture::new(width, height);
        let mut archive = ZipWriter::new(out);

        let log = |v: f32| v.abs().ln_1p().copysign(v);
        let bound = |axis: usize, start: f32, choose: fn(f32, f32) -> f32| {
            self.means.iter().map(|mean| log(mean[axis])).fold(start, choose)
        };
        let mins = [0, 1, 2].map(|axis| bound(axis, f32::INFINITY, f32::min));
        let maxs = [0, 1, 2].map(|axis| bound(axis, f32::NEG_INFINITY, f32::max));
        let level = |row: usize, axis: usize| {
            let extent = f64::from(maxs[axis]) - f64::from(mins[axis]);
            let share = f64::from(log(self.means[row][axis]) - mins[axis]) / extent.max(1e-30);
            (65_535.0 * share).round() as u16
        };
        for (name, shift) in [("means_l.webp", 0), ("means_u.webp", 8)] {
            let byte = |row: usize, axis| (level(row, axis) >> shift) as u8;
            let pixel = |row| [byte(row, 0), byte(row, 1), byte(row, 2), 255];
            archive.add(name, &picture().fill(rows, pixel).encode()?)?;
        }
        archive.add("quats.webp", &picture().fill(rows, |row| self.quats[row]).encode()?)?;
        let scales = Codebook::fit(self.log_scales.as_flattened(), |at| self.weights[at / 3]);
        let pixel = |row: usize| {
            let [x, y, z] = self.log_scales[row].map(|log| scales.nearest(log));
            [x, y, z, 255]
        };
        archive.add("scales.webp", &picture().fill(rows, pixel).encode()?)?;
        let colours = Codebook::fit(self.colours.as_flattened(), |at| self.weights[at / 3]);
        let pixel = |row: usize| {
            let [r, g, b] = self.colours[row].map(|value| colours.nearest(value));
            [r, g, b, self.opacities[row]]
        };
        archive.add("sh0.webp", &picture().fill(rows, pixel).encode()?)?;
        let mut meta = json!({
            "version": 2,
            "asset": {"generator": format!("densify {}", env!("CARGO_PKG_VERSION"))},
            "count": rows,
            "means": {"mins": mins, "maxs": maxs, "files": ["means_l.webp", "means_u.webp"]},
            "scales": {"codebook": scales.values(), "files": ["scales.webp"]},
            "quats": {"files": ["quats.webp"]},
            "sh0": {"codebook": colours.values(), "files": ["sh0.webp"]},
        });
        if self.antialiasing.is_on() {
            meta["model"] = json!(ANTIALIASED);
            meta["asset"][KERNEL] = json!(self.antialiasing);
        }
        if let Some(offset) = self.offset {
            meta["asset"][OFFSET] = json!(offset);
        }
        if self.sh_degree > 0 {
            meta["shN"] = self.bands(&mut archive, (width, height))?;
        }
        archive.add(META, meta.to_string().as_bytes())?;
        archive.finish()
    }
}

impl SogWriter {
    /// Writes the images of the bands above 0; returns their part of `meta.json`.
    fn bands(
        &self,
        archive: &mut ZipWriter<'_>,
        (width, height): (usize, usize),
    ) -> io::Result<serde_json::Value> {
        let rows = self.means.len();
        let coefficients = sh_coefficients(self.sh_degree) - 1;
        let Palette { entries, labels } =
            Palette::fit(&self.bands, 3 * coefficients, &self.weights, self.entries());
        let book = Codebook::fit(&entries, |_| 1.0);
        let count = entries.len() / (3 * coefficients);
        let entry = |pixel: usize| {
            let values = entries[3 * pixel..].first_chunk::<3>().copied().unwrap_or_default();
            let [r, g, b] = values.map(|value| book.nearest(value));
            [r, g, b, 255]
        };
        let palette = Picture::new(PALETTE_WIDTH * coefficients, count.div_ceil(PALETTE_WIDTH));
        archive.add("shN_centroids.webp", &palette.fill(count * coefficients, entry).encode()?)?;
        let label = |row: usize| {
            let [low, high, ..] = labels[row].to_le_bytes();
            [low, high, 0, 255]
        };
        let labels = Picture::new(width, height).fill(rows, label);
        archive.add("shN_labels.webp", &labels.encode()?)?;
        Ok(json!({
            "count": count,
            "bands": self.sh_degree,
            "codebook": book.values(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }))
    }

    /// A writer with one entry of the palette for every `rows` Gaussians.
    pub(super) fn sharing(rows: usize) -> Self {
        Self { sharing: Some(rows), ..Self::default() }
    }

    /// Number of entries of the palette; by default a power of two, as in splat-transform.
    fn entries(&self) -> usize {
        let rows = self.means.len();
        self.sharing.map_or(1 << rows.ilog2(), |sharing| rows.div_ceil(sharing)).min(MAX_PALETTE)
    }

    /// Divides the weights by their mean, and limits them to 0.01..=100, because they are only estimates.
    fn normalise_weights(&mut self) {
        let finite = |weight: f32| if weight.is_finite() { weight } else { 0.0 };
        let mean = self.weights.iter().map(|&w| f64::from(finite(w))).sum::<f64>();
        let mean = (mean / self.weights.len().max(1) as f64).max(1e-30) as f32;
        for weight in &mut self.weights {
            *weight = (finite(*weight) / mean).clamp(0.01, 100.0);
        }
    }
}

/// Three components from −1/√2 to 1/√2, in the order (w, x, y, z), and the alpha that names the largest.
fn quaternion(quat: [f32; 4]) -> [u8; 4] {
    let (largest, others) = smallest_three(quat);
    let byte = |v: f32| (127.5 * (v * std::f32::consts::SQRT_2 + 1.0)).round() as u8;
    let [a, b, c] = others.map(byte);
    [a, b, c, FIRST_LARGEST + largest as u8]
}
