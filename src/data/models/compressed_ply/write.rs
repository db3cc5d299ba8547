//! Writes compressed splat PLY.
//!
//! A byte stands for a coefficient between −4 and 4, but never for 0. Coefficients of 0, as in bands that were not
//! trained, alternate between the two nearest values, so that the colour is right on average.

use std::io::{self, Write};

use super::layout::{BOUNDS, CHUNK, WORDS};
use crate::models::coordinates::offset_text;
use crate::models::ply::layout::OFFSET;
use crate::models::quantise::{MAX_LOG_SCALE, smallest_three};
use crate::models::statement::comments;
use crate::models::{ModelWriter, Shape};
use densify_core::gaussians::{Gaussians, dc_to_rgb, sh_coefficients, sigmoid};

/// Number of values per Gaussian that are packed chunk by chunk: position, log-scale, colour, opacity and quaternion.
const PACKED: usize = 14;

/// Holds the packed values of all Gaussians, because all chunks precede them in the file.
#[derive(Default)]
pub(super) struct CompressedPlyWriter {
    /// Gaussians of the current chunk, which is not full.
    current: Vec<[f32; PACKED]>,
    chunks: Vec<[f32; BOUNDS.len()]>,
    words: Vec<[u32; WORDS.len()]>,
    /// Channel by channel. Shape: `[rows, 3·coefficients]`.
    bands: Vec<u8>,
}

impl ModelWriter for CompressedPlyWriter {
    fn held_bytes(&self, Shape { rows, sh_degree, .. }: Shape) -> u64 {
        let rest = 3 * (sh_coefficients(sh_degree) - 1);
        let row = size_of::<[u32; WORDS.len()]>() + rest;
        let chunk = size_of::<[f32; BOUNDS.len()]>();
        let current = CHUNK * size_of::<[f32; PACKED]>();
        (rows * row + rows.div_ceil(CHUNK) * chunk + current) as u64
    }

    fn wants_spatial_order(&self) -> bool {
        true
    }

    fn states_offset(&self) -> bool {
        true
    }

    fn begin(&mut self, shape: Shape, out: &mut dyn Write) -> io::Result<()> {
        let Shape { rows, sh_degree, antialiasing, frame } = shape;
        let rest = 3 * (sh_coefficients(sh_degree) - 1);
        self.current.reserve_exact(CHUNK);
        self.chunks.reserve_exact(rows.div_ceil(CHUNK));
        self.words.reserve_exact(rows);
        self.bands.reserve_exact(rows * rest);
        let comment = |offset| format!("comment {OFFSET} {}\n", offset_text(offset));
        let offset = frame.offset().map(comment).unwrap_or_default();
        let mut header = format!(
            "ply\nformat binary_little_endian 1.0\ncomment densify {}\n{}element chunk {}\n",
            env!("CARGO_PKG_VERSION"),
            comments(antialiasing) + &offset,
            rows.div_ceil(CHUNK)
        );
        header.extend(BOUNDS.iter().map(|name| format!("property float {name}\n")));
        header += &format!("element vertex {rows}\n");
        header.extend(WORDS.iter().map(|name| format!("property uint {name}\n")));
        if rest > 0 {
            header += &format!("element sh {rows}\n");
            header.extend((0..rest).map(|i| format!("property uchar f_rest_{i}\n")));
        }
        header += "end_header\n";
        out.write_all(header.as_bytes())
    }

    fn rows(&mut self, rows: &Gaussians, _out: &mut dyn Write) -> io::Result<()> {
        for row in 0..rows.len() {
            let ([x, y, z], [w, i, j, k]) = (rows.means[row], rows.quats[row]);
            let scale = rows.log_scales[row].map(|log| log.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE));
            let sh = rows.sh_of(row);
            let [r, g, b] = [sh[0], sh[1], sh[2]].map(dc_to_rgb);
            let opacity = sigmoid(rows.opacity_logits[row]);
            let [s, t, u] = scale;
            self.current.push([x, y, z, s, t, u, r, g, b, opacity, w, i, j, k]);
            for channel in 0..3 {
                for &value in sh[3..].iter().skip(channel).step_by(3) {
                    let index = self.current.len() + self.bands.len() % (sh.len() - 3);
                    let byte = if value == 0.0 { 127 + (index % 2) as u8 } else { band(value) };
                    self.bands.push(byte);
                }
            }
            if self.current.len() == CHUNK {
                self.pack_chunk();
            }
        }
        Ok(())
    }

    fn finish(&mut self, out: &mut dyn Write) -> io::Result<()> {
        if !self.current.is_empty() {
            self.pack_chunk();
        }
        for value in self.chunks.as_flattened() {
            out.write_all(&value.to_le_bytes())?;
        }
        for word in self.words.as_flattened() {
            out.write_all(&word.to_le_bytes())?;
        }
        out.write_all(&self.bands)
    }
}

impl CompressedPlyWriter {
    /// Packs the current chunk.
    fn pack_chunk(&mut self) {
        let mut bounds = [0.0; BOUNDS.len()];
        for (axis, at) in (0..9).map(|axis| (axis, axis / 3 * 6 + axis % 3)) {
            let values = || self.current.iter().map(|row| row[axis]);
            bounds[at] = values().fold(f32::INFINITY, f32::min);
            bounds[at + 3] = values().fold(f32::NEG_INFINITY, f32::max);
        }
        for row in &self.current {
            let share = |axis: usize| {
                let at = axis / 3 * 6 + axis % 3;
                let (min, max) = (bounds[at], bounds[at + 3]);
                if max > min { (row[axis] - min) / (max - min) } else { 0.0 }
            };
            let three = |at: usize| {
                bits(share(at), 11) << 21 | bits(share(at + 1), 10) << 11 | bits(share(at + 2), 11)
            };
            let [r, g, b, opacity] = [share(6), share(7), share(8), row[9]].map(|v| bits(v, 8));
            let colour = r << 24 | g << 16 | b << 8 | opacity;
            let quat = [row[10], row[11], row[12], row[13]];
            self.words.push([three(0), quaternion(quat), three(3), colour]);
        }
        self.chunks.push(bounds);
        self.current.clear();
    }
}

/// The byte in whose interval a coefficient lies.
fn band(value: f32) -> u8 {
    ((value / 8.0 + 0.5) * 256.0).floor().clamp(0.0, 255.0) as u8
}

/// A fraction quantised to `bits` bits.
fn bits(share: f32, bits: u32) -> u32 {
    let max = ((1u32 << bits) - 1) as f32;
    (share.clamp(0.0, 1.0) * max).round() as u32
}

/// The index of the largest component, then ten bits for each of the others, from −1/√2 to 1/√2.
fn quaternion(quat: [f32; 4]) -> u32 {
    let (largest, others) = smallest_three(quat);
    others.into_iter().fold(largest as u32, |word, value| {
        word << 10 | bits(value * std::f32::consts::FRAC_1_SQRT_2 + 0.5, 10)
    })
}
