//! Renderings as PNG files: colours, and on request opacity, depth, and the photograph beside the rendering.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageBuffer, Luma};

use densify_core::camera::Camera;
use densify_core::files::{FileError, write_atomically};
use densify_core::image::Image8;
use densify_data::dataset::normalise::Normalisation;
use densify_render::{Backend, BackendError, DepthKind, Rendering};
use densify_train::output::write_json;
use densify_train::pictures::{photograph, picture, side_by_side, to_u8, write_png};

/// Opacity below which a pixel has no depth.
const OPAQUE: f32 = 0.5;
/// The usual unit of depth pictures, thousandths, and the number of steps below which it is coarse.
const USUAL_UNIT: f64 = 0.001;
const COARSE_STEPS: f64 = 1000.0;

/// The pictures that are written for each rendering in addition to its colours.
#[derive(Debug, Clone, Copy, Default)]
pub struct Channels {
    /// Opacity, as `NAME.alpha.png`.
    pub alpha: bool,
    /// Depth in 16 bits, as `NAME.depth.png`, and in f32, as `NAME.depth.npy`.
    pub depth: Option<DepthKind>,
}

impl Channels {
    /// Renders a view. Its depth, divided by alpha, is of the requested kind.
    ///
    /// # Errors
    /// See [`BackendError`]; median depth is unsupported on a GPU.
    pub fn render(
        &self,
        backend: &mut dyn Backend,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<Rendering, BackendError> {
        let mut rendering = backend.render(camera, background, sh_degree)?;
        if self.depth == Some(DepthKind::Median) {
            let depths = backend.inspect()?.render_depths(camera)?;
            let products = depths.median.iter().zip(&rendering.alpha).map(|(depth, a)| depth * a);
            rendering.depth = products.collect();
        }
        Ok(rendering)
    }
}

/// A folder that renderings are written to.
#[derive(Debug)]
pub struct PictureFolder {
    folder: PathBuf,
    channels: Channels,
    /// Number of the dataset's units per scene unit.
    units: f64,
    /// One step of each depth picture, in the dataset's units.
    depth_units: BTreeMap<String, f64>,
}

impl PictureFolder {
    /// Writes to `folder`, which is created with the first picture. Depth is converted with `normalisation` to the
    /// units of the dataset.
    pub fn new(folder: &Path, channels: Channels, normalisation: &Normalisation) -> Self {
        let units = 1.0 / normalisation.scale;
        Self { folder: folder.to_owned(), channels, units, depth_units: BTreeMap::new() }
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.folder
    }

    /// Writes the pictures of one rendering.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&mut self, name: &str, rendering: &Rendering) -> Result<(), FileError> {
        let file = |ending: &str| self.folder.join(format!("{name}{ending}"));
        write_png(&file(".png"), &picture(rendering).into())?;
        if self.channels.alpha {
            write_png(&file(".alpha.png"), &alpha(rendering))?;
        }
        if self.channels.depth.is_some() {
            let depth = mean_depth(rendering, self.units);
            let (width, height) = (rendering.width, rendering.height);
            let (png, unit) = depth_picture((width, height), &depth);
            write_png(&file(".depth.png"), &png)?;
            let array = npy((width, height), &depth);
            write_atomically(&file(".depth.npy"), |out| out.write_all(&array))?;
            self.depth_units.insert(format!("{name}.depth.png"), unit);
        }
        Ok(())
    }

    /// Writes the photograph and the rendering beside each other, as `NAME.pair.png`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_pair(
        &self,
        name: &str,
        image: &Image8,
        background: [f32; 3],
        rendering: &Rendering,
    ) -> Result<(), FileError> {
        let path = self.folder.join(format!("{name}.pair.png"));
        write_png(&path, &pair(image, background, rendering))
    }

    /// Writes the units of the depth pictures to `depth.json`, if there are depth pictures.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn finish(&self) -> Result<(), FileError> {
        if self.depth_units.is_empty() {
            return Ok(());
        }
        let kind = self.channels.depth.unwrap_or(DepthKind::Expected);
        let scale = serde_json::json!({
            "kind": kind.to_string(),
            "what": "depth along the optical axis in the dataset's own units: values of .npy, and values of .png \
                     times their unit; 0 where the opacity is below one half",
            "unit": self.depth_units,
        });
        write_json(&self.folder.join("depth.json"), &scale)
    }
}

/// A file name without extension for each view. The views' names come from data files; the file names stay within the
/// output folder and are distinct.
pub fn file_names(views: &[&str]) -> Vec<String> {
    let plain = |name: &str| {
        let parts = name.split(['/', '\\']).filter(|part| !matches!(*part, "" | "." | ".."));
        let parts: Vec<String> = parts.map(|part| part.replace([':', '\0'], "_")).collect();
        if parts.is_empty() { "view".to_owned() } else { parts.join("/") }
    };
    let stem = |name: &str| match name.rsplit_once('.') {
        Some((stem, ending))
            if !ending.contains('/') && !stem.is_empty() && !stem.ends_with('/') =>
        {
            stem.to_owned()
        }
        _ => name.to_owned(),
    };
    let full: Vec<String> = views.iter().map(|name| plain(name)).collect();
    let stems: Vec<String> = full.iter().map(|name| stem(name)).collect();
    let distinct: HashSet<&String> = stems.iter().collect();
    if distinct.len() == stems.len() {
        return stems;
    }
    // `a.jpg` and `a.png` keep their extensions; names that differ only in removed parts get a number.
    let distinct: HashSet<&String> = full.iter().collect();
    if distinct.len() == full.len() {
        return full;
    }
    full.iter().enumerate().map(|(i, name)| format!("{name}-{i}")).collect()
}

fn alpha(rendering: &Rendering) -> DynamicImage {
    let Rendering { width, height, alpha, .. } = rendering;
    let pixel = |x: u32, y: u32| Luma([to_u8(alpha[y as usize * *width as usize + x as usize])]);
    ImageBuffer::from_fn(*width, *height, pixel).into()
}

/// Mean depth of each pixel, Σ α·T·z / Σ α·T, times `units`; 0 where the opacity Σ α·T is below one half. `eval`
/// measures the same depth.
fn mean_depth(rendering: &Rendering, units: f64) -> Vec<f32> {
    let mean = |(&depth, &alpha): (&f32, &f32)| {
        if alpha < OPAQUE { 0.0 } else { (f64::from(depth) / f64::from(alpha) * units) as f32 }
    };
    rendering.depth.iter().zip(&rendering.alpha).map(mean).collect()
}

/// Depth in 16 bits, and one step of it: a thousandth, or the power of ten that fits, if the depths are larger than 65
/// or so small that a thousandth would be coarse.
fn depth_picture((width, height): (u32, u32), depth: &[f32]) -> (DynamicImage, f64) {
    let largest = f64::from(depth.iter().copied().filter(|z| z.is_finite()).fold(0.0, f32::max));
    let fits = |unit: f64| largest <= 65_535.0 * unit;
    let unit = if largest > 0.0 {
        let unit = 10_f64.powf((largest / 65_535.0).log10().ceil());
        // Rounding may have made it too small.
        if fits(unit) { unit } else { 10.0 * unit }
    } else {
        USUAL_UNIT
    };
    let is_usual = fits(USUAL_UNIT) && largest >= COARSE_STEPS * USUAL_UNIT;
    let unit = if is_usual { USUAL_UNIT } else { unit };
    let pixel = |x: u32, y: u32| {
        let value = f64::from(depth[y as usize * width as usize + x as usize]);
        Luma([(value / unit).round() as u16])
    };
    let image: ImageBuffer<Luma<u16>, Vec<u16>> = ImageBuffer::from_fn(width, height, pixel);
    (image.into(), unit)
}

/// A NumPy array of shape `[height, width]` (numpy.org/doc/stable/reference/generated/numpy.lib.format.html).
fn npy((width, height): (u32, u32), values: &[f32]) -> Vec<u8> {
    // Size of magic, version and length.
    const PREFIX: usize = 10;
    let header =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}");
    // The header is padded to a multiple of 64 bytes, including its line end.
    let padded = (PREFIX + header.len() + 1).next_multiple_of(64) - PREFIX;
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((padded as u16).to_le_bytes());
    bytes.extend(format!("{header:0$}\n", padded - 1).bytes());
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

/// The photograph on the left, the rendering on the right.
fn pair(image: &Image8, background: [f32; 3], rendering: &Rendering) -> DynamicImage {
    side_by_side(&[photograph(image, background), picture(rendering)], 0).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_names_are_distinct_and_stay_in_the_folder() {
        assert_eq!(file_names(&["a.jpg", "sub/b.JPG", "c"]), ["a", "sub/b", "c"]);
        assert_eq!(file_names(&["a.jpg", "a.png"]), ["a.jpg", "a.png"]);
        assert_eq!(file_names(&["../../etc/x.png", "/y.png", "C:\\z.png"]), ["etc/x", "y", "C_/z"]);
        assert_eq!(file_names(&["a.png", "../a.png"]), ["a.png-0", "a.png-1"]);
        assert_eq!(file_names(&["..", ".hidden"]), ["view", ".hidden"]);
    }

    fn rendering() -> Rendering {
        Rendering {
            width: 2,
            height: 1,
            rgb: vec![0.0, 0.5, 1.0, -1.0, 2.0, f32::NAN],
            alpha: vec![1.0, 0.2],
            depth: vec![4.0, 1.0],
        }
    }

    #[test]
    fn pixels_are_rounded_and_clamped() {
        assert_eq!(picture(&rendering()).into_raw(), [0, 128, 255, 0, 255, 0]);
        assert_eq!(alpha(&rendering()).into_luma8().into_raw(), [255, 51]);
    }

    #[test]
    fn depth_is_the_mean_of_opaque_pixels_in_a_stated_unit() {
        let half = Rendering { alpha: vec![0.5, 0.2], ..rendering() };
        let depth = mean_depth(&half, 3.0);
        assert_eq!(depth, [24.0, 0.0]);
        let steps = |depth: [f32; 2]| {
            let (png, unit) = depth_picture((2, 1), &depth);
            (png.into_luma16().into_raw(), unit)
        };
        for (depth, values, unit) in [
            ([24.0, 0.0], [24_000, 0], 0.001),
            ([65.5, 1.0], [65_500, 1000], 0.001),
            ([66.0, 1.0], [6600, 100], 0.01),
            ([0.5, 0.0], [50_000, 0], 1e-5),
            ([0.0, 0.0], [0, 0], 0.001),
        ] {
            let (found, found_unit) = steps(depth);
            assert_eq!(found, values, "{depth:?}");
            assert!((found_unit / unit - 1.0).abs() < 1e-9, "{found_unit} for {depth:?}");
        }
    }

    #[test]
    fn arrays_have_an_aligned_header_and_all_values() {
        let bytes = npy((3, 2), &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(bytes.len() % 64, 24);
        let header = String::from_utf8_lossy(&bytes[10..bytes.len() - 24]);
        assert!(header.contains("'shape': (2, 3)") && header.ends_with('\n'), "{header}");
        assert_eq!(bytes[bytes.len() - 4..], 6.0_f32.to_le_bytes());
    }

    #[test]
    fn a_pair_shows_the_composited_photograph_on_the_left() {
        let image = Image8 {
            width: 2,
            height: 1,
            rgb: vec![10, 20, 30, 200, 200, 200],
            alpha: Some(vec![255, 0]),
            mask: None,
        };
        let pair = pair(&image, [1.0, 0.0, 0.0], &rendering()).into_rgb8();
        assert_eq!(pair.dimensions(), (4, 1));
        assert_eq!(&pair.as_raw()[..6], [10, 20, 30, 255, 0, 0]);
        assert_eq!(&pair.as_raw()[6..], [0, 128, 255, 0, 255, 0]);
    }
}
