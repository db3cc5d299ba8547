//! Reads SPZ, versions 2 to 4.

use std::io::{BufRead, Read};
use std::path::Path;

use flate2::bufread::GzDecoder;
use ruzstd::decoding::StreamingDecoder;

use super::extensions::{self, Axes, Extensions};
use super::layout::{ANTIALIASED, COLOUR, GZIP, HAS_EXTENSIONS, HEADER_OF_VERSION_4, MAGIC};
use crate::error::LoadError;
use crate::models::quantise::{from_smallest_three, quantised_logit};
use crate::models::rows::{Row, Rows, SplatFile};
use crate::models::statement::note;
use crate::models::unpack::{DAMAGED, read_error, read_exactly, read_to_end};
use densify_core::antialiasing::Antialiasing;
use densify_core::files::max_unpacked_bytes;
use densify_core::gaussians::{MAX_SH_DEGREE, sh_coefficients};

/// Window that every zstd decoder should support `[bytes]` (RFC 8878, 3.1.1.1.2).
const WINDOW: u64 = 8 << 20;

/// Largest size of the extensions that are read `[bytes]`.
const MAX_EXTENSIONS: u64 = 1 << 20;

/// The header of a file.
struct Header {
    rows: u64,
    version: u32,
    sh_degree: u8,
    fractional_bits: u8,
    is_antialiased: bool,
    has_extensions: bool,
    /// The arrays in the order of the file: name and bytes per Gaussian.
    arrays: [(&'static str, u64); 6],
}

/// Reads a file of `length` bytes, and converts it from the axes that it states.
///
/// # Errors
/// When the file is unreadable, damaged, of another version, or of degree 4.
pub(super) fn read(path: &Path, input: impl BufRead, length: u64) -> Result<SplatFile, LoadError> {
    let (mut file, axes) = read_as_stored(path, input, length)?;
    if let Some(axes) = axes {
        axes.convert(&mut file.gaussians);
        file.notes.insert(0, format!("converted from the axes {axes} that the file states"));
    }
    Ok(file)
}

/// As [`read`], but in the axes of the file; these are returned, too, if the file states them.
pub(in crate::models) fn read_as_stored(
    path: &Path,
    mut input: impl BufRead,
    length: u64,
) -> Result<(SplatFile, Option<Axes>), LoadError> {
    let start = input.fill_buf().map_err(LoadError::io(path))?;
    if start.starts_with(&GZIP) {
        let mut unzipped = GzDecoder::new(input);
        let header = read_header(path, &mut unzipped, length, 1..=3)?;
        let (arrays, extensions) = read_consecutive(path, &header, &mut unzipped)?;
        read_to_end(path, "gzip", &mut unzipped)?;
        return decode(path, &header, &arrays, extensions);
    }
    let header = read_header(path, &mut input, length, 1..=4)?;
    let (arrays, extensions) = match header.version {
        4 => read_frames(path, &header, &mut input)?,
        _ => read_consecutive(path, &header, &mut input)?,
    };
    decode(path, &header, &arrays, extensions)
}

fn read_header(
    path: &Path,
    input: &mut dyn Read,
    length: u64,
    versions: std::ops::RangeInclusive<u32>,
) -> Result<Header, LoadError> {
    let wrong = |problem: String| Err(LoadError::damaged(path, "header", problem));
    let bytes = read_exactly(path, "header", input, 16)?;
    let words: Vec<u32> = bytes.as_chunks().0.iter().map(|&w| u32::from_le_bytes(w)).collect();
    let (version, rows) = (words[1], u64::from(words[2]));
    let (sh_degree, fractional_bits) = (bytes[12], bytes[13]);
    let is_antialiased = bytes[14] & ANTIALIASED != 0;
    let has_extensions = bytes[14] & HAS_EXTENSIONS != 0;
    if words[0] != MAGIC {
        return wrong("it does not begin with `NGSP`".into());
    }
    if version == 1 || !versions.contains(&version) {
        return wrong(format!("densify reads versions 2 and 3, in gzip, and 4, not {version}"));
    }
    if sh_degree > MAX_SH_DEGREE {
        return wrong(format!("colours have degree {sh_degree}, but densify reads 0 to 3"));
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
    if bytes > max_unpacked_bytes(length) {
        return wrong(format!(
            "{rows} Gaussians take {bytes} bytes, too many for a file of {length}"
        ));
    }
    Ok(Header { rows, version, sh_degree, fractional_bits, is_antialiased, has_extensions, arrays })
}

/// Reads arrays that follow each other, and the extensions after them.
fn read_consecutive(
    path: &Path,
    header: &Header,
    input: &mut dyn Read,
) -> Result<(Vec<Vec<u8>>, Extensions), LoadError> {
    let read = |(name, bytes): (&str, u64)| read_exactly(path, name, input, header.rows * bytes);
    let arrays = header.arrays.into_iter().map(read).collect::<Result<_, _>>()?;
    Ok((arrays, read_extensions(path, header, input)?))
}

/// Reads the extensions that the header states, to the end of the input.
fn read_extensions(
    path: &Path,
    header: &Header,
    input: &mut dyn Read,
) -> Result<Extensions, LoadError> {
    if !header.has_extensions {
        return Ok(Extensions::default());
    }
    let mut records = Vec::new();
    let read = input.take(MAX_EXTENSIONS).read_to_end(&mut records);
    read.map_err(|source| read_error(path, "extensions", source))?;
    extensions::parse(path, &records)
}

/// Reads the arrays of version 4, each a zstd frame, and the extensions before them.
fn read_frames(
    path: &Path,
    header: &Header,
    input: &mut dyn Read,
) -> Result<(Vec<Vec<u8>>, Extensions), LoadError> {
    let more = read_exactly(path, "header", input, 16)?;
    let [a, b, c, d, ..] = more[..] else { unreachable!("16 bytes") };
    let table = u64::from(u32::from_le_bytes([a, b, c, d]));
    let before = table.checked_sub(HEADER_OF_VERSION_4.into());
    let before =
        before.ok_or_else(|| LoadError::damaged(path, "header", "the table lies in the header"))?;
    // Extensions stand between header and table.
    let mut between = input.take(before);
    let extensions = read_extensions(path, header, &mut between)?;
    let skipped = std::io::copy(&mut between, &mut std::io::sink());
    skipped.map_err(|source| read_error(path, "extensions", source))?;
    // Without bands above 0 there is no frame for them.
    let arrays = header.arrays.iter().filter(|(_, bytes)| *bytes > 0);
    let mut sizes = Vec::new();
    for &(name, bytes) in arrays {
        let entry = read_exactly(path, "table", input, 16)?;
        let [packed, unpacked] =
            [0, 8].map(|at| u64::from_le_bytes(std::array::from_fn(|i| entry[at + i])));
        if unpacked != header.rows * bytes {
            let problem = format!("{unpacked} bytes for {} Gaussians of {bytes}", header.rows);
            return Err(LoadError::damaged(path, name, problem));
        }
        sizes.push((name, packed, unpacked));
    }
    let mut arrays = Vec::new();
    for (name, packed, unpacked) in sizes {
        let mut frame = input.take(packed);
        let window = WINDOW.max(unpacked);
        let mut decoder = StreamingDecoder::new_with_max_window_size(&mut frame, window)
            .map_err(|_| LoadError::damaged(path, name, DAMAGED))?;
        arrays.push(read_exactly(path, name, &mut decoder, unpacked)?);
        drop(decoder);
        read_to_end(path, name, &mut frame)?;
    }
    arrays.resize(6, Vec::new());
    Ok((arrays, extensions))
}

fn decode(
    path: &Path,
    header: &Header,
    arrays: &[Vec<u8>],
    extensions: Extensions,
) -> Result<(SplatFile, Option<Axes>), LoadError> {
    let mut rows = Rows::new(header.sh_degree);
    let unit = 1.0 / (1u32 << header.fractional_bits) as f32;
    let mut sh = Vec::new();
    for row in 0..header.rows as usize {
        let bytes_of = |array: usize| {
            let bytes = header.arrays[array].1 as usize;
            &arrays[array][row * bytes..(row + 1) * bytes]
        };
        let position = bytes_of(0);
        sh.clear();
        sh.extend(bytes_of(2).iter().map(|&v| (f32::from(v) / 255.0 - 0.5) / COLOUR));
        sh.extend(bytes_of(5).iter().map(|&v| (f32::from(v) - 128.0) / 128.0));
        let scales = bytes_of(3);
        rows.push(Row {
            mean: std::array::from_fn(|i| {
                // Shifting up and down extends the sign.
                let bytes = [0, position[3 * i], position[3 * i + 1], position[3 * i + 2]];
                (i32::from_le_bytes(bytes) >> 8) as f32 * unit
            }),
            log_scale: std::array::from_fn(|i| f32::from(scales[i]) / 16.0 - 10.0),
            quat: quaternion(bytes_of(4)),
            opacity_logit: quantised_logit(f32::from(bytes_of(1)[0]) / 255.0),
            sh: &sh,
        });
    }
    let mut file = rows.finish(path)?;
    file.notes.extend(extensions.notes);
    if header.is_antialiased {
        file.gaussians.antialiasing = Antialiasing::Wide;
        file.notes.push(note(Antialiasing::Wide, "a flag of SPZ"));
    }
    Ok((file, extensions.axes))
}

/// Version 2 stores x, y and z in a byte each. Later versions store the largest component's index in the order (x, y,
/// z, w), then sign and nine bits of each of the others, up to 1/√2.
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
