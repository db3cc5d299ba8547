//! Writes SPZ, version 3 or 4. The fixed point of positions and the precision of coefficients are chosen for each
//! model; every reader can read the result.

use std::io::{self, Write};

use super::VARIANTS;
use super::containers::{self, Array, GZIP_MEMORY, frames_bytes};
use super::layout::{ANTIALIASED, COLOUR};
use crate::models::quantise::smallest_three;
use crate::models::write::unfit;
use crate::models::{Format, ModelWriter, Shape};
use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::{Gaussians, sh_coefficients, sigmoid};

/// Fractional bits of positions in files of other writers; small scenes get more.
const MIN_FRACTIONAL_BITS: u8 = 12;
/// Maximum number of fractional bits of positions.
const MAX_FRACTIONAL_BITS: u8 = 20;
/// Bits of a position without its sign.
const POSITION_BITS: i32 = 23;
/// Step of positions, as a fraction of the median of all Gaussians' second largest scales.
const STEP_OF_SIZE: f32 = 0.05;
/// Largest error of a colour from rounding coefficients, root mean square over Gaussians and directions. Below this,
/// images have at least 45 dB against those of the PLY (measured on room256, cup, chair).
const MAX_COLOUR_ERROR: f64 = 0.0165;
/// Largest step of coefficients, in units of 1/128.
const MAX_STEP: u8 = 31;

/// Holds the quantised values of all Gaussians. Only positions stay in f32 until the end, because their fixed point
/// depends on all of them.
#[derive(Default)]
pub(super) struct SpzWriter {
    is_version_4: bool,
    /// Fixed step of coefficients; `None` chooses it for the model.
    step: Option<u8>,
    sh_degree: u8,
    /// Flags of the header.
    flags: u8,
    positions: Vec<[f32; 3]>,
    /// The middle one of each Gaussian's log-scales.
    sizes: Vec<f32>,
    opacities: Vec<u8>,
    colours: Vec<u8>,
    scales: Vec<u8>,
    rotations: Vec<u32>,
    bands: Vec<u8>,
}

impl ModelWriter for SpzWriter {
    fn held_bytes(&self, Shape { rows, sh_degree, .. }: Shape) -> u64 {
        let bands = 3 * (sh_coefficients(sh_degree) - 1);
        let held = (rows * (12 + 4 + 1 + 3 + 3 + 4 + bands)) as u64;
        let arrays = [9, 1, 3, 3, 4, bands].map(|bytes| rows * bytes);
        held + if self.is_version_4 { frames_bytes(&arrays) } else { GZIP_MEMORY }
    }

    fn wants_spatial_order(&self) -> bool {
        true
    }

    fn variants(&self) -> &'static [Format] {
        if self.is_version_4 { &[] } else { &VARIANTS }
    }

    fn states_antialiasing(&self, antialiasing: Antialiasing) -> bool {
        // The flag states no kernel; other readers use 0.3.
        antialiasing != Antialiasing::Narrow
    }

    fn begin(&mut self, shape: Shape, _out: &mut dyn Write) -> io::Result<()> {
        let Shape { rows, sh_degree, antialiasing, .. } = shape;
        if u32::try_from(rows).is_err() {
            return Err(unfit(
                "SPZ counts Gaussians in 32 bits; export fewer, or choose another format",
            ));
        }
        self.sh_degree = sh_degree;
        self.flags = if antialiasing.is_on() { ANTIALIASED } else { 0 };
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
        let header = [self.sh_degree, fractional_bits, self.flags];
        if self.is_version_4 {
            containers::write_frames(rows as u32, header, &arrays, out)
        } else {
            containers::write_gzip(rows as u32, header, &arrays, out)
        }
    }
}

impl SpzWriter {
    pub(super) fn version_4() -> Self {
        Self { is_version_4: true, ..Self::default() }
    }

    /// A writer of version 3 with a fixed step of coefficients.
    pub(super) fn with_step(step: u8) -> Self {
        Self { step: Some(step), ..Self::default() }
    }

    /// Fractional bits that leave room for all positions and move no Gaussian visibly.
    fn fractional_bits(&mut self) -> io::Result<u8> {
        let reach = self.positions.as_flattened().iter().fold(0f32, |max, v| max.max(v.abs()));
        let room = POSITION_BITS - 1 - reach.max(1e-6).log2().floor() as i32;
        if room < 0 {
            return Err(unfit(format!(
                "SPZ has no room for coordinates up to {reach:e}; choose another format, such as glb"
            )));
        }
        let wanted = match self.sizes.len() / 2 {
            0 => i32::from(MIN_FRACTIONAL_BITS),
            middle => {
                let median = *self.sizes.select_nth_unstable_by(middle, f32::total_cmp).1;
                -(STEP_OF_SIZE.log2() + median / std::f32::consts::LN_2).floor() as i32
            }
        };
        let wanted = wanted.clamp(MIN_FRACTIONAL_BITS.into(), MAX_FRACTIONAL_BITS.into());
        Ok(wanted.min(room) as u8)
    }

    /// Rounds coefficients to the largest step that keeps the error of colours within its limit (band 1: half that
    /// step), because equal bytes compress. Steps are odd, so that no byte lies halfway between two of them.
    fn coarsen(&mut self) {
        let row = 3 * (sh_coefficients(self.sh_degree) - 1);
        if row == 0 || self.bands.is_empty() {
            return;
        }
        let step_at = |index: usize, step: u8| if index % row < 9 { (step / 2) | 1 } else { step };
        // The basis is orthonormal: a colour's mean square is the sum over its coefficients, divided by 4π.
        let error = |step: u8| {
            let squares = self.bands.iter().enumerate().map(|(index, &byte)| {
                let left = f64::from(byte) - f64::from(coarse(byte, step_at(index, step)));
                (left / 128.0).powi(2)
            });
            let rows = 3.0 * (self.bands.len() / row) as f64;
            (squares.sum::<f64>() / rows / (4.0 * std::f64::consts::PI)).sqrt()
        };
        let step = self.step.unwrap_or_else(|| {
            let fits = |&step: &u8| error(step) < MAX_COLOUR_ERROR;
            (1..=MAX_STEP).step_by(2).take_while(fits).last().unwrap_or(1)
        });
        for (index, byte) in self.bands.iter_mut().enumerate() {
            *byte = coarse(*byte, step_at(index, step));
        }
    }
}

/// The byte nearest to `byte` that is a whole number of steps from 128, which stands for 0.
fn coarse(byte: u8, step: u8) -> u8 {
    let (from, step) = (i32::from(byte) - 128, i32::from(step));
    let steps = (from.abs() + step / 2) / step;
    (128 + from.signum() * steps * step).clamp(0, 255) as u8
}

/// Rounds to the nearest byte.
fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// The index of the largest component in the order (x, y, z, w), then sign and nine bits of each of the others.
fn quaternion([w, x, y, z]: [f32; 4]) -> u32 {
    let (largest, others) = smallest_three([x, y, z, w]);
    others.into_iter().fold(largest as u32, |word, value| {
        let size = (511.0 * value.abs() * std::f32::consts::SQRT_2).round().min(511.0) as u32;
        word << 10 | u32::from(value < 0.0) << 9 | size
    })
}
