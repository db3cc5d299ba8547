//! Writes the layout of the original trainer; values are copied bit for bit.

use std::io::{self, Write};

use super::layout::{NEAR, NORMALS_AT, OFFSET, properties};
use crate::models::coordinates::offset_text;
use crate::models::statement::comments;
use crate::models::{Frame, ModelWriter, Shape};
use densify_core::gaussians::{Gaussians, sh_coefficients};

/// Gaussians per write.
const CHUNK: usize = 256;

/// Holds one chunk at a time.
#[derive(Default)]
pub(super) struct PlyWriter {
    frame: Frame,
}

/// Size of a Gaussian: position, normal, opacity, scales, rotation and colours `[bytes]`.
fn row_bytes(sh_degree: u8, frame: Frame) -> usize {
    let wider = if frame.is_double { 3 * (size_of::<f64>() - size_of::<f32>()) } else { 0 };
    size_of::<f32>() * (14 + 3 * sh_coefficients(sh_degree)) + wider
}

impl ModelWriter for PlyWriter {
    fn held_bytes(&self, Shape { rows, sh_degree, frame, .. }: Shape) -> u64 {
        (rows.min(CHUNK) * row_bytes(sh_degree, frame)) as u64
    }

    fn is_lossy(&self) -> bool {
        false
    }

    fn states_offset(&self) -> bool {
        true
    }

    fn has_double(&self) -> bool {
        true
    }

    fn begin(&mut self, shape: Shape, out: &mut dyn Write) -> io::Result<()> {
        let Shape { rows, sh_degree, antialiasing, frame } = shape;
        self.frame = frame;
        let mut header =
            "ply\nformat binary_little_endian 1.0\n".to_owned() + &comments(antialiasing);
        if let Some(offset) = frame.offset() {
            header += &format!("comment {OFFSET} {}\n", offset_text(offset));
        } else if frame.is_double {
            header += &format!("comment {NEAR} {}\n", offset_text(frame.origin));
        }
        header += &format!("element vertex {rows}\n");
        for (index, name) in properties(sh_degree).enumerate() {
            if index == NORMALS_AT {
                for normal in ["nx", "ny", "nz"] {
                    header += &format!("property float {normal}\n");
                }
            }
            let is_wide = frame.is_double && index < NORMALS_AT;
            header += &format!("property {} {name}\n", if is_wide { "double" } else { "float" });
        }
        header += "end_header\n";
        out.write_all(header.as_bytes())
    }

    fn rows(&mut self, rows: &Gaussians, out: &mut dyn Write) -> io::Result<()> {
        let row_bytes = row_bytes(rows.sh_degree, self.frame);
        let mut chunk = Vec::with_capacity(rows.len().min(CHUNK) * row_bytes);
        for row in 0..rows.len() {
            if self.frame.is_double {
                chunk.extend(rows.position(row).into_iter().flat_map(f64::to_le_bytes));
            } else {
                chunk.extend(rows.means[row].into_iter().flat_map(f32::to_le_bytes));
            }
            let mut put = |value: f32| chunk.extend_from_slice(&value.to_le_bytes());
            let sh = rows.sh_of(row);
            [0.0; 3].into_iter().for_each(&mut put);
            sh[..3].iter().copied().for_each(&mut put);
            for channel in 0..3 {
                sh[3..].iter().skip(channel).step_by(3).copied().for_each(&mut put);
            }
            put(rows.opacity_logits[row]);
            rows.log_scales[row].into_iter().for_each(&mut put);
            rows.quats[row].into_iter().for_each(&mut put);
            if row % CHUNK == CHUNK - 1 {
                out.write_all(&chunk)?;
                chunk.clear();
            }
        }
        out.write_all(&chunk)
    }

    fn finish(&mut self, _out: &mut dyn Write) -> io::Result<()> {
        Ok(())
    }
}
