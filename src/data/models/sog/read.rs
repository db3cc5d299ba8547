//! Reads SOG from an archive or a folder.

use std::io::{Cursor, Read};
use std::path::Path;

use image::{ImageDecoder, ImageFormat};
use serde::Deserialize;
use serde_json::Value;

use super::layout::{ANTIALIASED, CODEBOOK, FIRST_LARGEST, META, OFFSET, PALETTE_WIDTH};
use crate::error::LoadError;
use crate::models::quantise::{from_smallest_three, quantised_logit};
use crate::models::rows::{Row, Rows, SplatFile};
use crate::models::statement::{KERNEL, note, stated_in_json};
use crate::models::zip::ZipReader;
use crate::models::{ModelFile, lists, siblings};
use crate::picture_file;
use densify_core::antialiasing::Antialiasing;
use densify_core::files::max_unpacked_bytes;
use densify_core::gaussians::sh_coefficients;

/// The parts of `meta.json` that are needed.
#[derive(Deserialize)]
struct Meta {
    version: Option<u32>,
    #[serde(default)]
    count: u64,
    /// The statement of antialiasing in the present and in an earlier form.
    #[serde(default)]
    model: Value,
    #[serde(default)]
    antialias: Value,
    /// Names the program; densify adds the kernel of antialiasing and the offset.
    #[serde(default)]
    asset: Value,
    means: Quantity,
    scales: Quantity,
    quats: Quantity,
    sh0: Quantity,
    #[serde(rename = "shN")]
    bands: Option<Quantity>,
}

impl Meta {
    /// The antialiasing, and a sentence on it unless its kernel is stated.
    fn antialiasing(&self, path: &Path) -> Result<(Antialiasing, Option<String>), LoadError> {
        let is_on = self.model == ANTIALIASED || self.antialias == true;
        Ok(match stated_in_json(path, "asset", &self.asset)? {
            Some(stated) if stated.is_on() != is_on => {
                let problem = format!("it is {stated}, which contradicts `model`");
                return Err(LoadError::damaged(path, format!("asset.{KERNEL}"), problem));
            }
            Some(stated) => (stated, None),
            None if is_on => (Antialiasing::Wide, Some(note(Antialiasing::Wide, META))),
            None => (Antialiasing::None, None),
        })
    }

    /// The offset of local coordinates; 0 for world coordinates.
    fn offset(&self, path: &Path) -> Result<[f64; 3], LoadError> {
        let Some(stated) = self.asset.get(OFFSET) else { return Ok([0.0; 3]) };
        let offset = <[f64; 3]>::deserialize(stated).ok();
        offset.filter(|offset| offset.iter().all(|axis| axis.is_finite())).ok_or_else(|| {
            LoadError::damaged(path, format!("asset.{OFFSET}"), "it is not three numbers")
        })
    }
}

/// One quantity: its images, and the meaning of their bytes.
#[derive(Deserialize)]
struct Quantity {
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

/// A decoded image. Shape of `rgba`: `[height, width, 4]`.
struct Picture {
    width: usize,
    rgba: Vec<u8>,
}

/// Returns the bytes of an image by its name.
type OpenImage<'a> = &'a mut dyn FnMut(&str) -> Result<Vec<u8>, LoadError>;

/// True if a JSON text describes a model in this format, of any version.
pub(super) fn is_meta(text: &str) -> bool {
    let json: Option<serde_json::Map<String, serde_json::Value>> = serde_json::from_str(text).ok();
    json.is_some_and(|keys| ["means", "quats"].iter().all(|key| keys.contains_key(*key)))
}

/// Reads an archive, or the images beside `meta.json`.
///
/// # Errors
/// When the archive or an image is unreadable or damaged, or an image contradicts `meta.json` or is outside the folder.
pub(super) fn read(file: ModelFile<'_>) -> Result<SplatFile, LoadError> {
    let path = file.path;
    if let Some(text) = file.json()? {
        return read_images(path, text, 0, &mut |name| {
            let mut bytes = Vec::new();
            let image = siblings::open(path, "files", name)?;
            // No image within the limits is larger.
            image
                .take(max_unpacked_bytes(0))
                .read_to_end(&mut bytes)
                .map_err(LoadError::io(path))?;
            Ok(bytes)
        });
    }
    let mut archive = ZipReader::open(path, file.input, file.length)?;
    let Some(folder) = folder_in_archive(&archive.names()).map(str::to_owned) else {
        if lists::is_streamed(&archive.names()) {
            return Err(lists::refusal_of_archive(path));
        }
        return Err(LoadError::Data(format!(
            "{} is a ZIP archive, but no SOG model (it needs exactly one {META}); unpack it, and name a file of Gaussian \
             splats",
            path.display()
        )));
    };
    let text = archive.read(&format!("{folder}{META}"))?;
    let text = String::from_utf8_lossy(&text).into_owned();
    read_images(path, &text, file.length, &mut |name| archive.read(&format!("{folder}{name}")))
}

/// The folder of the SOG model in an archive with these files. It ends in `/`, and is empty if the model is at the top
/// level. `None` if the archive holds no model, or files outside the model's folder.
pub(crate) fn folder_in_archive<'a, N: AsRef<str>>(names: &'a [N]) -> Option<&'a str> {
    let names = names.iter().map(AsRef::as_ref);
    if names.clone().any(|name| name == META) {
        return Some("");
    }
    let mut files = names.filter(|name| !name.ends_with('/') && !name.starts_with("__MACOSX/"));
    let folder_of = |name: &'a str| name.strip_suffix(META).filter(|folder| folder.ends_with('/'));
    let folder = files.clone().find_map(folder_of)?;
    let is_beside = |name: &str| name.strip_prefix(folder).is_some_and(|name| !name.contains('/'));
    files.all(is_beside).then_some(folder)
}

fn read_images(
    path: &Path,
    text: &str,
    length: u64,
    open: OpenImage<'_>,
) -> Result<SplatFile, LoadError> {
    let meta: Meta = serde_json::from_str(text).map_err(|e| LoadError::damaged(path, META, e))?;
    if meta.version != Some(2) {
        let version = meta.version.map_or_else(|| "1 (it names none)".into(), |v| v.to_string());
        let problem = format!("version {version}, but densify reads 2");
        return Err(LoadError::damaged(path, META, problem));
    }
    let mut picture = |quantity: &Quantity, index: usize, field: &str| {
        let name = quantity.files.get(index);
        let name = name.ok_or_else(|| LoadError::damaged(path, field, "it names too few files"))?;
        decode(path, name, &open(name)?, length)
    };
    let mut image_of = |quantity: &Quantity, index: usize, field: &str| {
        let decoded = picture(quantity, index, field)?;
        if (decoded.rgba.len() as u64) / 4 < meta.count {
            let problem = format!("{} pixels for {} Gaussians", decoded.rgba.len() / 4, meta.count);
            return Err(LoadError::damaged(path, field, problem));
        }
        Ok(decoded.rgba)
    };
    let (low, high) = (image_of(&meta.means, 0, "means")?, image_of(&meta.means, 1, "means")?);
    let quats = image_of(&meta.quats, 0, "quats")?;
    let scales = image_of(&meta.scales, 0, "scales")?;
    let colours = image_of(&meta.sh0, 0, "sh0")?;
    let labels = match &meta.bands {
        None => Vec::new(),
        Some(bands) => image_of(bands, 1, "shN")?,
    };
    let palette = meta.bands.as_ref().map(|bands| picture(bands, 0, "shN")).transpose()?;
    let sh_degree = meta.bands.as_ref().map_or(0, |bands| bands.bands);
    if sh_degree > 3 || (meta.bands.is_some() && sh_degree == 0) {
        let problem = format!("{sh_degree} bands, but 1 to 3 are possible");
        return Err(LoadError::damaged(path, "shN", problem));
    }
    let coefficients = sh_coefficients(sh_degree) - 1;
    if palette.as_ref().is_some_and(|p| p.width < PALETTE_WIDTH * coefficients) {
        let problem = "the image of the palette is too narrow for its degree";
        return Err(LoadError::damaged(path, "shN", problem));
    }
    let ([Some(mins), Some(maxs)], [scale_book, colour_book]) = (
        [&meta.means.mins, &meta.means.maxs].map(|all| all.first_chunk::<3>()),
        [&meta.scales, &meta.sh0].map(|all| book(&all.codebook)),
    ) else {
        return Err(LoadError::damaged(path, "means", "mins and maxs have fewer than 3 numbers"));
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
                // Without an entry the colour is the same from every direction.
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
    let mut file = rows.finish(path)?;
    let (antialiasing, note) = meta.antialiasing(path)?;
    file.gaussians.antialiasing = antialiasing;
    file.gaussians.origin = meta.offset(path)?;
    file.notes.extend(note);
    Ok(file)
}

/// A full codebook; bytes beyond the file's own numbers decode to NaN.
fn book(numbers: &[f32]) -> Vec<f32> {
    let mut book = numbers.to_vec();
    book.resize(CODEBOOK, f32::NAN);
    book
}

/// Decodes three components from −1/√2 to 1/√2 in the order (w, x, y, z), without the largest, which `alpha` names.
fn quaternion(bytes: [usize; 3], alpha: u8) -> [f32; 4] {
    let Some(largest) = alpha.checked_sub(FIRST_LARGEST).map(usize::from) else {
        return [1.0, 0.0, 0.0, 0.0];
    };
    let small = bytes.map(|v| (v as f32 / 127.5 - 1.0) * std::f32::consts::FRAC_1_SQRT_2);
    from_smallest_three(largest, small)
}

/// Decodes a WebP or PNG after checking its size.
fn decode(path: &Path, name: &str, bytes: &[u8], length: u64) -> Result<Picture, LoadError> {
    let bad = |problem: String| LoadError::damaged(path, name, problem);
    let reader = picture_file::reader(Cursor::new(bytes)).map_err(|e| bad(e.to_string()))?;
    if !matches!(reader.format(), Some(ImageFormat::WebP | ImageFormat::Png)) {
        return Err(bad("it is neither WebP nor PNG".into()));
    }
    let decoder = reader.into_decoder().map_err(|error| bad(error.to_string()))?;
    let (width, height) = decoder.dimensions();
    let limit = max_unpacked_bytes(length.max(bytes.len() as u64));
    if 4 * u64::from(width) * u64::from(height) > limit || decoder.total_bytes() > limit {
        return Err(bad(format!("{width}×{height} pixels are too many for a file of its size")));
    }
    let decoded = image::DynamicImage::from_decoder(decoder).map_err(|e| bad(e.to_string()))?;
    Ok(Picture { width: width as usize, rgba: decoded.into_rgba8().into_raw() })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn statements_that_are_damaged_or_contradict_each_other_are_refused_by_field() {
        let meta = |asset: Value, model: &str| {
            let quantity = json!({"files": []});
            let (means, scales, quats, sh0) = (&quantity, &quantity, &quantity, &quantity);
            let all = json!({
                "asset": asset, "model": model,
                "means": means, "scales": scales, "quats": quats, "sh0": sh0,
            });
            serde_json::from_value::<Meta>(all).unwrap()
        };
        let path = Path::new("model.sog");
        let good = meta(json!({"offset": [1, 2, 3.5], "antialiasing": "0.1"}), ANTIALIASED);
        assert_eq!(good.offset(path).unwrap().map(f64::to_bits), [1.0, 2.0, 3.5].map(f64::to_bits));
        assert_eq!(good.antialiasing(path).unwrap(), (Antialiasing::Narrow, None));
        for offset in [json!([5]), json!(7), json!([1, 2, "3"]), json!([1, 2, null])] {
            let error = meta(json!({"offset": offset}), "").offset(path).unwrap_err().to_string();
            assert!(error.contains("model.sog") && error.contains("asset.offset"), "{error}");
        }
        for (kernel, model) in [("0.7", ANTIALIASED), ("0.3", ""), ("none", ANTIALIASED)] {
            let error = meta(json!({"antialiasing": kernel}), model).antialiasing(path);
            let error = error.unwrap_err().to_string();
            assert!(error.contains("asset.antialiasing"), "{error}");
        }
    }
}
