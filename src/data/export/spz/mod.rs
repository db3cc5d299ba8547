//! SPZ (Niantic): version 3, which every reader of the format takes, and version 4 by choice; `import::spz` says how
//! they are laid out.
//!
//! Coordinates stay those of the dataset, as with splat-transform. The fixed point of positions and the bits of
//! coefficients follow from the model, as readers need not know them.

mod containers;

use std::io::{self, Write};

use containers::Array;

use super::{Format, ModelWriter, Shape};
use crate::import::spz::COLOUR;
use densify_core::gaussians::{Gaussians, sh_coefficients, sigmoid};

pub(super) const FORMAT: Format = Format {
    name: "spz",
    extension: "spz",
    summary: "SPZ version 3 of Niantic: quantised and compressed",
    writer: || Box::new(SpzWriter::default()),
};

/// Its extension ends in the other's, which is the default.
pub(super) const IN_FRAMES: Format = Format {
    name: "spz-v4",
    extension: "v4.spz",
    summary: "SPZ version 4: the same in zstd frames, which some readers do not take",
    writer: || Box::new(SpzWriter { is_in_frames: true, ..SpzWriter::default() }),
};

inventory::submit! { FORMAT }
inventory::submit! { IN_FRAMES }

/// The same with fixed steps of coefficients, however large the error of colours: what `compress` may take.
const FORMS: [Format; 3] = [
    Format { writer: with_step::<3>, ..FORMAT },
    Format { writer: with_step::<9>, ..FORMAT },
    Format { writer: with_step::<17>, ..FORMAT },
];

fn with_step<const STEP: u8>() -> Box<dyn ModelWriter> {
    Box::new(SpzWriter { step: Some(STEP), ..SpzWriter::default() })
}

/// Fractional bits that other writers give positions; ours has as many or, for a small scene, more.
const FRACTIONAL_BITS: u8 = 12;
/// Most of them, and the number of bits beside the sign.
const MAX_FRACTIONAL_BITS: u8 = 20;
const POSITION_BITS: i32 = 23;
/// Positions need no finer steps than this share of the median Gaussian's smaller extent in the image.
const STEP_OF_SIZE: f32 = 0.05;
/// Most error of a colour by rounding coefficients, root mean square over rows and directions: below this the
/// picture is 45 dB from that of the PLY (measured on room256, cup, chair).
const COLOUR_ERROR: f64 = 0.0165;
/// Largest step of coefficients, of 256 in `[−1, 1)`.
const MAX_STEP: u8 = 31;

/// Holds what all rows become but positions, which stay as they are until the fixed point is known.
#[derive(Default)]
struct SpzWriter {
    /// Version 4.
    is_in_frames: bool,
    /// Step of coefficients, if it does not follow from the model.
    step: Option<u8>,
    sh_degree: u8,
    positions: Vec<[f32; 3]>,
    sizes: Vec<f32>,
    opacities: Vec<u8>,
    colours: Vec<u8>,
    scales: Vec<u8>,
    rotations: Vec<u32>,
    bands: Vec<u8>,
}

impl ModelWriter for SpzWriter {
    fn held_bytes(&self, Shape { rows, sh_degree }: Shape) -> u64 {
        let bands = 3 * (sh_coefficients(sh_degree) - 1);
        let held = (rows * (12 + 4 + 1 + 3 + 3 + 4 + bands)) as u64;
        let arrays = [9, 1, 3, 3, 4, bands].map(|bytes| rows * bytes);
        held + match self.is_in_frames {
            false => containers::GZIP,
            true => containers::frames_bytes(&arrays),
        }
    }

    fn is_for_neighbours(&self) -> bool {
        true
    }

    fn forms(&self) -> &'static [Format] {
        if self.is_in_frames { &[] } else { &FORMS }
    }

    fn begin(&mut self, Shape { rows, sh_degree }: Shape, _out: &mut dyn Write) -> io::Result<()> {
        if u32::try_from(rows).is_err() {
            let problem =
                "SPZ counts rows in 32 bits; export fewer, or choose another format, such as ply";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, problem));
        }
        self.sh_degree = sh_degree;
        self.positions.reserve_exact(rows);
        self.sizes.reserve_exact(rows);
        self.opacities.reserve_exact(rows);
        self.colours.reserve_exact(3 * rows);
        self.scales.reserve_exact(3 * rows);
        self.rotations.reserve_exact(rows);
        self.bands.reserve_exact(3 * (sh_coefficients(sh_degree) - 1) * rows);
        Ok(())
    }

    fn rows(&mut self, rows: &Gaussians, _out: &mut dyn Write) -> io::Result<()> {
        self.positions.extend_from_slice(&rows.means);
        for row in 0..rows.len() {
            let mut logs = rows.log_scales[row];
            self.scales.extend(logs.map(|log| byte((log + 10.0) * 16.0)));
            logs.sort_by(f32::total_cmp);
            self.sizes.push(logs[1]);
            self.opacities.push(byte(255.0 * sigmoid(rows.opacity_logits[row])));
            let (dc, bands) = rows.sh_of(row).split_at(3);
            self.colours.extend(dc.iter().map(|value| byte(255.0 * (0.5 + COLOUR * value))));
            self.bands.extend(bands.iter().map(|value| byte(128.0 + 128.0 * value)));
            self.rotations.push(quaternion(rows.quats[row]));
        }
        Ok(())
    }

    fn finish(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let fractional_bits = self.fractional_bits()?;
        self.coarsen();
        let unit = 2f32.powi(fractional_bits.into());
        let positions = |out: &mut dyn Write| {
            self.positions.as_flattened().iter().try_for_each(|value| {
                let fixed = (value * unit).round() as i32;
                out.write_all(&fixed.to_le_bytes()[..3])
            })
        };
        let rotations = |out: &mut dyn Write| {
            self.rotations.iter().try_for_each(|word| out.write_all(&word.to_le_bytes()))
        };
        let rows = self.positions.len();
        let arrays: [Array<'_>; 6] = [
            (9 * rows, &positions),
            (rows, &|out| out.write_all(&self.opacities)),
            (3 * rows, &|out| out.write_all(&self.colours)),
            (3 * rows, &|out| out.write_all(&self.scales)),
            (4 * rows, &rotations),
            (self.bands.len(), &|out| out.write_all(&self.bands)),
        ];
        let facts = [self.sh_degree, fractional_bits];
        match self.is_in_frames {
            false => containers::in_gzip(rows as u32, facts, &arrays, out),
            true => containers::in_frames(rows as u32, facts, &arrays, out),
        }
    }
}

impl SpzWriter {
    /// Fractional bits that all positions have room for, and that do not move what is seen.
    fn fractional_bits(&mut self) -> io::Result<u8> {
        let reach = self.positions.as_flattened().iter().fold(0f32, |most, v| most.max(v.abs()));
        let room = POSITION_BITS - 1 - reach.max(1e-6).log2().floor() as i32;
        if room < 0 {
            let problem = format!(
                "SPZ has no room for coordinates up to {reach:e}; choose another format, such as glb"
            );
            return Err(io::Error::new(io::ErrorKind::InvalidInput, problem));
        }
        let wanted = match self.sizes.len() / 2 {
            0 => i32::from(FRACTIONAL_BITS),
            middle => {
                let median = *self.sizes.select_nth_unstable_by(middle, f32::total_cmp).1;
                -(STEP_OF_SIZE.log2() + median / std::f32::consts::LN_2).floor() as i32
            }
        };
        let wanted = wanted.clamp(FRACTIONAL_BITS.into(), MAX_FRACTIONAL_BITS.into());
        Ok(wanted.min(room) as u8)
    }

    /// Rounds coefficients to steps as large as the error of colours allows, in band 1 to half of them: equal bytes
    /// compress. Steps are odd, so that no byte lies between two of them, and none is rounded away from 0 more often.
    fn coarsen(&mut self) {
        let row = 3 * (sh_coefficients(self.sh_degree) - 1);
        if row == 0 || self.bands.is_empty() {
            return;
        }
        let of = |index: usize, step: u8| if index % row < 9 { (step / 2) | 1 } else { step };
        // Σ over coefficients of a band's mean square, as the basis is orthonormal: ¼π of it is the colour's.
        let error = |step: u8| {
            let squares = self.bands.iter().enumerate().map(|(index, &byte)| {
                let left = f64::from(byte) - f64::from(coarse(byte, of(index, step)));
                (left / 128.0).powi(2)
            });
            let rows = 3.0 * (self.bands.len() / row) as f64;
            (squares.sum::<f64>() / rows / (4.0 * std::f64::consts::PI)).sqrt()
        };
        let step = self.step.unwrap_or_else(|| {
            let fits = |&step: &u8| error(step) < COLOUR_ERROR;
            (1..=MAX_STEP).step_by(2).take_while(fits).last().unwrap_or(1)
        });
        for (index, byte) in self.bands.iter_mut().enumerate() {
            *byte = coarse(*byte, of(index, step));
        }
    }
}

/// The byte nearest to one that is a whole number of steps from 128, which stands for 0.
fn coarse(byte: u8, step: u8) -> u8 {
    let (from, step) = (i32::from(byte) - 128, i32::from(step));
    let steps = (from.abs() + step / 2) / step;
    (128 + from.signum() * steps * step).clamp(0, 255) as u8
}

/// The nearest byte.
fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// Index of the largest component in order (x, y, z, w), then sign and nine bits of each other.
fn quaternion([w, x, y, z]: [f32; 4]) -> u32 {
    let (largest, others) = super::smallest_three([x, y, z, w]);
    others.into_iter().fold(largest as u32, |word, value| {
        let size = (511.0 * value.abs() * std::f32::consts::SQRT_2).round().min(511.0) as u32;
        word << 10 | u32::from(value < 0.0) << 9 | size
    })
}
