//! Reads SOG, version 2 (PlayCanvas): a model as pictures without loss, a pixel per Gaussian, in a ZIP archive or a
//! folder with `meta.json`.
//!
//! Positions are 16 bits between bounds of sign(x)·ln(1 + |x|), in two pictures. Scales, colours and coefficients are
//! bytes into codebooks of 256 numbers each. The bands above 0 are a number into a palette, whose picture has 64
//! entries in a row. A quaternion is its three smaller components and, in the alpha channel, which is the largest.

use std::io::{Cursor, Read, Seek};
use std::path::Path;

use image::{ImageDecoder, ImageFormat, ImageReader};
use serde::Deserialize;

use super::model::{Row, Rows, from_smallest_three, malformed, quantised_logit};
use super::zip::Archive;
use super::{SplatFile, beside};
use crate::dataset::DatasetError;
use densify_core::files::most_unpacked;
use densify_core::gaussians::sh_coefficients;

/// Entries of the palette in a row of its picture.
pub(crate) const PALETTE_WIDTH: usize = 64;

/// `meta.json`. What is not needed is ignored.
#[derive(Deserialize)]
struct Meta {
    version: Option<u32>,
    #[serde(default)]
    count: u64,
    means: Pictures,
    scales: Pictures,
    quats: Pictures,
    sh0: Pictures,
    #[serde(rename = "shN")]
    bands: Option<Pictures>,
}

/// A quantity: its pictures and what their bytes mean.
#[derive(Deserialize)]
struct Pictures {
    files: Vec<String>,
    #[serde(default)]
    mins: Vec<f32>,
    #[serde(default)]
    maxs: Vec<f32>,
    #[serde(default)]
    codebook: Vec<f32>,
    #[serde(default)]
    bands: u8,
    #[serde(default)]
    count: usize,
}

/// A decoded picture. Shape of `rgba`: `[height, width, 4]`.
struct Picture {
    width: usize,
    rgba: Vec<u8>,
}

/// Where pictures come from, by name.
type Source<'a> = &'a mut dyn FnMut(&str) -> Result<Vec<u8>, DatasetError>;

/// Whether a JSON text is that of a model in this format, of any version.
pub(super) fn is_meta(text: &str) -> bool {
    let found: Option<serde_json::Map<String, serde_json::Value>> = serde_json::from_str(text).ok();
    found.is_some_and(|keys| ["means", "quats"].iter().all(|key| keys.contains_key(*key)))
}

/// Reads an archive of `length` bytes.
///
/// # Errors
/// When the archive or a picture is unreadable or damaged, or contradicts `meta.json`.
pub(super) fn read_zip(
    path: &Path,
    input: impl Read + Seek,
    length: u64,
) -> Result<SplatFile, DatasetError> {
    let mut archive = Archive::open(path, input, length)?;
    let text = archive.read("meta.json")?;
    let text = String::from_utf8_lossy(&text).into_owned();
    read(path, &text, length, &mut |name| archive.read(name))
}

/// Reads the pictures beside `meta.json`, whose text is given.
///
/// # Errors
/// As [`read_zip`]; when a picture's name leads out of the folder.
pub(super) fn read_folder(path: &Path, text: &str) -> Result<SplatFile, DatasetError> {
    read(path, text, 0, &mut |name| {
        let mut bytes = Vec::new();
        let file = beside::open(path, "files", name)?;
        // No picture within the limits has more.
        file.take(most_unpacked(0)).read_to_end(&mut bytes).map_err(DatasetError::io(path))?;
        Ok(bytes)
    })
}

fn read(
    path: &Path,
    text: &str,
    length: u64,
    source: Source<'_>,
) -> Result<SplatFile, DatasetError> {
    let meta: Meta =
        serde_json::from_str(text).map_err(|error| malformed(path, "meta.json", error))?;
    if meta.version != Some(2) {
        let version = meta.version.map_or_else(|| "1 (it names none)".into(), |v| v.to_string());
        return Err(malformed(
            path,
            "meta.json",
            format!("version {version}, but densify reads 2"),
        ));
    }
    let mut picture = |pictures: &Pictures, index: usize, field: &str| {
        let name = pictures.files.get(index);
        let name = name.ok_or_else(|| malformed(path, field, "it names too few files"))?;
        decode(path, name, &source(name)?, length)
    };
    let mut of_rows = |pictures: &Pictures, index: usize, field: &str| {
        let found = picture(pictures, index, field)?;
        if (found.rgba.len() as u64) / 4 < meta.count {
            let problem = format!("{} pixels for {} rows", found.rgba.len() / 4, meta.count);
            return Err(malformed(path, field, problem));
        }
        Ok(found.rgba)
    };
    let (low, high) = (of_rows(&meta.means, 0, "means")?, of_rows(&meta.means, 1, "means")?);
    let quats = of_rows(&meta.quats, 0, "quats")?;
    let scales = of_rows(&meta.scales, 0, "scales")?;
    let colours = of_rows(&meta.sh0, 0, "sh0")?;
    let labels = match &meta.bands {
        None => Vec::new(),
        Some(bands) => of_rows(bands, 1, "shN")?,
    };
    let palette = meta.bands.as_ref().map(|bands| picture(bands, 0, "shN")).transpose()?;
    let sh_degree = meta.bands.as_ref().map_or(0, |bands| bands.bands);
    if sh_degree > 3 || (meta.bands.is_some() && sh_degree == 0) {
        return Err(malformed(path, "shN", format!("{sh_degree} bands, but there are 1 to 3")));
    }
    let coefficients = sh_coefficients(sh_degree) - 1;
    if palette.as_ref().is_some_and(|p| p.width < PALETTE_WIDTH * coefficients) {
        return Err(malformed(path, "shN", "the palette's picture is too narrow for its degree"));
    }
    let ([Some(mins), Some(maxs)], [scale_book, colour_book]) = (
        [&meta.means.mins, &meta.means.maxs].map(|all| all.first_chunk::<3>()),
        [&meta.scales, &meta.sh0].map(|all| book(&all.codebook)),
    ) else {
        return Err(malformed(path, "means", "mins and maxs have fewer than 3 numbers"));
    };
    let band_book = book(meta.bands.as_ref().map_or(&[], |bands| &bands.codebook));

    let mut rows = Rows::new(sh_degree);
    let mut sh = vec![0.0; 3 * (coefficients + 1)];
    for pixel in (0..meta.count as usize).map(|row| 4 * row) {
        let three =
            |bytes: &[u8]| [bytes[pixel], bytes[pixel + 1], bytes[pixel + 2]].map(usize::from);
        let (low, high) = (three(&low), three(&high));
        sh[..3].copy_from_slice(&three(&colours).map(|byte| colour_book[byte]));
        if let (Some(palette), Some(bands)) = (&palette, &meta.bands) {
            let label = usize::from(labels[pixel]) | usize::from(labels[pixel + 1]) << 8;
            let start =
                label / PALETTE_WIDTH * palette.width + label % PALETTE_WIDTH * coefficients;
            let entry = palette.rgba.get(4 * start..4 * (start + coefficients));
            match entry.filter(|_| bands.count == 0 || label < bands.count) {
                // No entry: a colour seen the same from everywhere.
                None => sh[3..].fill(0.0),
                Some(entry) => {
                    let bytes = entry.as_chunks::<4>().0.iter().flat_map(|rgba| &rgba[..3]);
                    for (value, &byte) in sh[3..].iter_mut().zip(bytes) {
                        *value = band_book[usize::from(byte)];
                    }
                }
            }
        }
        rows.push(Row {
            mean: std::array::from_fn(|i| {
                let share = (low[i] | high[i] << 8) as f32 / 65_535.0;
                let log = mins[i] + (maxs[i] - mins[i]) * share;
                log.abs().exp_m1().copysign(log)
            }),
            log_scale: three(&scales).map(|byte| scale_book[byte]),
            quat: quaternion(three(&quats), quats[pixel + 3]),
            opacity_logit: quantised_logit(f32::from(colours[pixel + 3]) / 255.0),
            sh: &sh,
        });
    }
    rows.finish(path)
}

/// A codebook of 256; a byte beyond the file's own has no number.
fn book(numbers: &[f32]) -> Vec<f32> {
    let mut book = numbers.to_vec();
    book.resize(256, f32::NAN);
    book
}

/// Three components from −1/√2 to 1/√2 in order (w, x, y, z), without the largest, which `tag` − 252 names.
fn quaternion(bytes: [usize; 3], tag: u8) -> [f32; 4] {
    let Some(largest) = tag.checked_sub(252).map(usize::from) else {
        return [1.0, 0.0, 0.0, 0.0];
    };
    let small = bytes.map(|v| (v as f32 / 127.5 - 1.0) * std::f32::consts::FRAC_1_SQRT_2);
    from_smallest_three(largest, small)
}

/// Decodes a WebP or PNG, whose size is looked at first.
fn decode(path: &Path, name: &str, bytes: &[u8], length: u64) -> Result<Picture, DatasetError> {
    let bad = |problem: String| malformed(path, name, problem);
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format();
    let reader = reader.map_err(|error| bad(error.to_string()))?;
    if !matches!(reader.format(), Some(ImageFormat::WebP | ImageFormat::Png)) {
        return Err(bad("it is neither WebP nor PNG".into()));
    }
    let decoder = reader.into_decoder().map_err(|error| bad(error.to_string()))?;
    let (width, height) = decoder.dimensions();
    let limit = most_unpacked(length.max(bytes.len() as u64));
    if 4 * u64::from(width) * u64::from(height) > limit || decoder.total_bytes() > limit {
        return Err(bad(format!("{width}×{height} pixels are too many for a file of its size")));
    }
    let decoded = image::DynamicImage::from_decoder(decoder).map_err(|e| bad(e.to_string()))?;
    Ok(Picture { width: width as usize, rgba: decoded.into_rgba8().into_raw() })
}
