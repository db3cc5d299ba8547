//! Renderings as PNG files: colours, and on request opacity, depth, and the photograph beside the rendering.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageBuffer, Luma};

use densify_core::files::FileError;
use densify_core::image::Image8;
use densify_data::dataset::normalise::Normalisation;
use densify_render::Rendering;
use densify_train::output::write_json;
use densify_train::pictures::{photograph, picture, side_by_side, to_u8, write_png};

/// The pictures that are written for each rendering in addition to its colours.
#[derive(Debug, Clone, Copy, Default)]
pub struct Channels {
    /// Opacity, as `NAME.alpha.png`.
    pub alpha: bool,
    /// Depth in 16 bits, as `NAME.depth.png`; 65535 stands for the largest depth of the picture.
    pub depth: bool,
}

/// A folder that renderings are written to.
#[derive(Debug)]
pub struct PictureFolder {
    folder: PathBuf,
    channels: Channels,
    /// Number of the dataset's units per scene unit.
    units: f64,
    /// The largest depth of each depth picture, in the dataset's units.
    largest_depth: BTreeMap<String, f64>,
}

impl PictureFolder {
    /// Writes to `folder`, which is created with the first picture. Depth is converted with `normalisation` to the
    /// units of the dataset.
    pub fn new(folder: &Path, channels: Channels, normalisation: &Normalisation) -> Self {
        let units = 1.0 / normalisation.scale;
        Self { folder: folder.to_owned(), channels, units, largest_depth: BTreeMap::new() }
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
        if self.channels.depth {
            let (png, largest) = depth(rendering);
            write_png(&file(".depth.png"), &png)?;
            let largest = f64::from(largest) * self.units;
            self.largest_depth.insert(format!("{name}.depth.png"), largest);
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

    /// Writes the scales of the depth pictures to `depth.json`, if there are depth pictures.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn finish(&self) -> Result<(), FileError> {
        if self.largest_depth.is_empty() {
            return Ok(());
        }
        let scale = serde_json::json!({
            "what": "depth = value / 65535 * largest, in the dataset's own units",
            "largest": self.largest_depth,
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

/// Depth relative to its largest value, and that value `[scene units]`.
fn depth(rendering: &Rendering) -> (DynamicImage, f32) {
    let Rendering { width, height, depth, .. } = rendering;
    let largest = depth.iter().copied().fold(0.0, f32::max);
    let scale = if largest > 0.0 { 65_535.0 / largest } else { 0.0 };
    let pixel = |x: u32, y: u32| {
        let value = depth[y as usize * *width as usize + x as usize];
        Luma([(value * scale).round() as u16])
    };
    let image: ImageBuffer<Luma<u16>, Vec<u16>> = ImageBuffer::from_fn(*width, *height, pixel);
    (image.into(), largest)
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
        let (png, largest) = depth(&rendering());
        assert_eq!(png.into_luma16().into_raw(), [65_535, 16_384]);
        assert!((largest - 4.0).abs() < f32::EPSILON);
        let empty = Rendering { depth: vec![0.0; 2], ..rendering() };
        assert_eq!(depth(&empty).0.into_luma16().into_raw(), [0, 0]);
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
