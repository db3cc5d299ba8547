//! Splat PLY, binary little endian, in the layout of the original 3DGS trainer (Kerbl et al. 2023,
//! `save_ply`); [`crate::import::ply`] reads it.

use std::io::{self, Write};

use super::{Format, ModelWriter, Shape};
use crate::import::ply::splat_properties;
use densify_core::gaussians::{Gaussians, sh_coefficients};

pub(super) const FORMAT: Format = Format {
    name: "ply",
    extension: "ply",
    summary: "uncompressed splat PLY with the properties of the original 3DGS trainer",
    writer: || Box::new(PlyWriter),
};

inventory::submit! { FORMAT }

/// Rows per write.
const CHUNK: usize = 256;

/// Values go out bit for bit.
struct PlyWriter;

/// Bytes of a row: position, normal, opacity, scales and rotation, and colours.
const fn row_bytes(sh_degree: u8) -> usize {
    size_of::<f32>() * (14 + 3 * sh_coefficients(sh_degree))
}

impl ModelWriter for PlyWriter {
    fn held_bytes(&self, Shape { rows, sh_degree }: Shape) -> u64 {
        (rows.min(CHUNK) * row_bytes(sh_degree)) as u64
    }

    fn rounds(&self) -> bool {
        false
    }

    fn begin(&mut self, Shape { rows, sh_degree }: Shape, out: &mut dyn Write) -> io::Result<()> {
        let mut header = format!("ply\nformat binary_little_endian 1.0\nelement vertex {rows}\n");
        for (index, name) in splat_properties(sh_degree).enumerate() {
            if index == 3 {
                for normal in ["nx", "ny", "nz"] {
                    header += &format!("property float {normal}\n");
                }
            }
            header += &format!("property float {name}\n");
        }
        header += "end_header\n";
        out.write_all(header.as_bytes())
    }

    fn rows(&mut self, rows: &Gaussians, out: &mut dyn Write) -> io::Result<()> {
        let mut chunk = Vec::with_capacity(rows.len().min(CHUNK) * row_bytes(rows.sh_degree));
        for row in 0..rows.len() {
            let mut put = |value: f32| chunk.extend_from_slice(&value.to_le_bytes());
            let sh = rows.sh_of(row);
            rows.means[row].into_iter().for_each(&mut put);
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
