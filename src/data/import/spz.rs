//! Reads SPZ (Niantic), versions 2 to 4: 20 bytes per Gaussian, and one per coefficient of colour, before they are
//! compressed.
//!
//! A header of 16 bytes (version 4: 32), then one array after the other for all rows: positions in 24-bit fixed
//! point, opacities, colours, scales, rotations, bands above 0. Up to version 3 all of that is one gzip stream; since
//! 4 each array is a zstd frame, whose sizes stand in a table. The coordinates are taken as they are, as
//! splat-transform does: what a program turned on writing, it alone knows.

use std::io::{BufRead, Read};
use std::path::Path;

use flate2::bufread::GzDecoder;
use ruzstd::decoding::StreamingDecoder;

use super::SplatFile;
use super::model::{Row, Rows, from_smallest_three, malformed, quantised_logit};
use super::unfold::{DAMAGED, exactly, fault, to_the_end};
use crate::dataset::DatasetError;
use densify_core::files::most_unpacked;
use densify_core::gaussians::{MAX_SH_DEGREE, sh_coefficients};

/// What begins the data, as a number in little endian.
pub(crate) const MAGIC: u32 = 0x5053_474e;
/// A colour's byte is 255·(½ + this·coefficient).
pub(crate) const COLOUR: f32 = 0.15;
/// Smallest window that a zstd decoder has to support `[bytes]` (RFC 8878, 3.1.1.1.2).
const WINDOW: u64 = 8 << 20;

/// The arrays of a file, in its order, each with its bytes per row.
struct Layout {
    rows: u64,
    version: u32,
    sh_degree: u8,
    fractional_bits: u8,
    arrays: [(&'static str, u64); 6],
}

/// Reads a file of `length` bytes.
///
/// # Errors
/// When the file is unreadable, damaged, of another version, or of degree 4.
pub(super) fn read(
    path: &Path,
    mut input: impl BufRead,
    length: u64,
) -> Result<SplatFile, DatasetError> {
    let start = input.fill_buf().map_err(DatasetError::io(path))?;
    if start.starts_with(&[0x1f, 0x8b]) {
        let mut unzipped = GzDecoder::new(input);
        let layout = header(path, &mut unzipped, length, 1..=3)?;
        let arrays = in_a_row(path, &layout, &mut unzipped)?;
        to_the_end(path, "gzip", &mut unzipped)?;
        return unpack(path, &layout, &arrays);
    }
    let layout = header(path, &mut input, length, 1..=4)?;
    let arrays = match layout.version {
        4 => in_frames(path, &layout, &mut input)?,
        _ => in_a_row(path, &layout, &mut input)?,
    };
    unpack(path, &layout, &arrays)
}

fn header(
    path: &Path,
    input: &mut dyn Read,
    length: u64,
    versions: std::ops::RangeInclusive<u32>,
) -> Result<Layout, DatasetError> {
    let wrong = |problem: String| Err(malformed(path, "header", problem));
    let bytes = exactly(path, "header", input, 16)?;
    let words: Vec<u32> =
        bytes.as_chunks().0.iter().map(|&word| u32::from_le_bytes(word)).collect();
    let (version, rows) = (words[1], u64::from(words[2]));
    let (sh_degree, fractional_bits) = (bytes[12], bytes[13]);
    if words[0] != MAGIC {
        return wrong("it does not begin with `NGSP`".into());
    }
    if version == 1 || !versions.contains(&version) {
        return wrong(format!("densify reads versions 2 and 3, in gzip, and 4, not {version}"));
    }
    if sh_degree > MAX_SH_DEGREE {
        return wrong(format!("colours of degree {sh_degree}, but densify has 0 to 3"));
    }
    if fractional_bits > 23 {
        return wrong(format!("positions have {fractional_bits} fractional bits of 24"));
    }
    let rest = 3 * (sh_coefficients(sh_degree) as u64 - 1);
    let arrays = [
        ("positions", 9),
        ("opacities", 1),
        ("colours", 3),
        ("scales", 3),
        ("rotations", if version == 2 { 3 } else { 4 }),
        ("bands", rest),
    ];
    let bytes = rows * arrays.iter().map(|(_, bytes)| bytes).sum::<u64>();
    if bytes > most_unpacked(length) {
        return wrong(format!("{rows} rows take {bytes} bytes, too many for a file of {length}"));
    }
    Ok(Layout { rows, version, sh_degree, fractional_bits, arrays })
}

/// The arrays one after the other.
fn in_a_row(
    path: &Path,
    layout: &Layout,
    input: &mut dyn Read,
) -> Result<Vec<Vec<u8>>, DatasetError> {
    let read = |(name, bytes): (&str, u64)| exactly(path, name, input, layout.rows * bytes);
    layout.arrays.into_iter().map(read).collect()
}

/// The arrays of version 4, each by itself.
fn in_frames(
    path: &Path,
    layout: &Layout,
    input: &mut dyn Read,
) -> Result<Vec<Vec<u8>>, DatasetError> {
    let more = exactly(path, "header", input, 16)?;
    let [a, b, c, d, ..] = more[..] else { unreachable!("16 bytes") };
    let table = u64::from(u32::from_le_bytes([a, b, c, d]));
    let before = table.checked_sub(32);
    let before = before.ok_or_else(|| malformed(path, "header", "the table lies in the header"))?;
    // Extensions of other programs.
    let skipped = std::io::copy(&mut input.take(before), &mut std::io::sink());
    skipped.map_err(|source| fault(path, "extensions", source))?;
    // Without bands there is no frame of them.
    let arrays = layout.arrays.iter().filter(|(_, bytes)| *bytes > 0);
    let mut sizes = Vec::new();
    for &(name, bytes) in arrays {
        let entry = exactly(path, "table", input, 16)?;
        let [packed, unfolded] =
            [0, 8].map(|at| u64::from_le_bytes(std::array::from_fn(|i| entry[at + i])));
        if unfolded != layout.rows * bytes {
            let problem = format!("{unfolded} bytes for {} rows of {bytes}", layout.rows);
            return Err(malformed(path, name, problem));
        }
        sizes.push((name, packed, unfolded));
    }
    let mut arrays = Vec::new();
    for (name, packed, unfolded) in sizes {
        let mut frame = input.take(packed);
        let window = WINDOW.max(unfolded);
        let mut decoder = StreamingDecoder::new_with_max_window_size(&mut frame, window)
            .map_err(|_| malformed(path, name, DAMAGED))?;
        arrays.push(exactly(path, name, &mut decoder, unfolded)?);
        drop(decoder);
        to_the_end(path, name, &mut frame)?;
    }
    arrays.resize(6, Vec::new());
    Ok(arrays)
}

fn unpack(path: &Path, layout: &Layout, arrays: &[Vec<u8>]) -> Result<SplatFile, DatasetError> {
    let mut rows = Rows::new(layout.sh_degree);
    let unit = 1.0 / (1u32 << layout.fractional_bits) as f32;
    let mut sh = Vec::new();
    for row in 0..layout.rows as usize {
        let of = |array: usize| {
            let bytes = layout.arrays[array].1 as usize;
            &arrays[array][row * bytes..(row + 1) * bytes]
        };
        let position = of(0);
        sh.clear();
        sh.extend(of(2).iter().map(|&v| (f32::from(v) / 255.0 - 0.5) / COLOUR));
        sh.extend(of(5).iter().map(|&v| (f32::from(v) - 128.0) / 128.0));
        let scales = of(3);
        rows.push(Row {
            mean: std::array::from_fn(|i| {
                // Into the upper bytes and down again, for the sign.
                let bytes = [0, position[3 * i], position[3 * i + 1], position[3 * i + 2]];
                (i32::from_le_bytes(bytes) >> 8) as f32 * unit
            }),
            log_scale: std::array::from_fn(|i| f32::from(scales[i]) / 16.0 - 10.0),
            quat: quaternion(of(4)),
            opacity_logit: quantised_logit(f32::from(of(1)[0]) / 255.0),
            sh: &sh,
        });
    }
    rows.finish(path)
}

/// Of version 2: x, y, z in a byte each. Since 3: the largest component's index in order (x, y, z, w), then sign and
/// nine bits of each other, up to 1/√2.
fn quaternion(bytes: &[u8]) -> [f32; 4] {
    let [x, y, z, w] = if let &[x, y, z] = bytes {
        from_smallest_three(3, [x, y, z].map(|v| f32::from(v) / 127.5 - 1.0))
    } else {
        let word = u32::from_le_bytes(std::array::from_fn(|i| bytes[i]));
        let others = [20, 10, 0].map(|shift| {
            let size = (word >> shift & 511) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
            if word >> (shift + 9) & 1 == 1 { -size } else { size }
        });
        from_smallest_three((word >> 30) as usize, others)
    };
    [w, x, y, z]
}
