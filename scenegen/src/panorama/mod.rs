//! Environment light from an equirectangular image: Radiance `.hdr` or OpenEXR.
//!
//! +y is up. Seen from inside, the centre of the image is towards +x and its right half towards +z. Files are
//! untrusted: sizes are checked before anything is decoded, NaN becomes 0, and infinity becomes the largest
//! half float.
//!
//! Blurred copies are made once, so that light without occlusion needs no secondary rays. Each copy is the
//! image averaged with a power of the cosine as weight. The exponent k for a roughness is chosen such that the
//! mean cosine (k + 1) / (k + 2) is 1 − roughness² / 3; the roughest copy is therefore irradiance / pi.

use std::f32::consts::{PI, TAU};
use std::path::Path;

use glam::{DVec3, Vec3};
use image::ImageFormat;
use rayon::prelude::*;
use serde::{Serialize, Serializer, ser::SerializeStruct};

use crate::error::Error;
use crate::resource::{self, EXPANSION, MAX_DECODED};

/// Largest radiance: the largest half float.
const BRIGHTEST: f32 = 65_504.0;
/// Number of columns of the reduced image that is averaged; it has half as many rows. `CELLS` and `AVERAGES` are
/// sufficient for the sharpest lobe, which is about 20 degrees wide.
const CELLS: usize = 96;
/// Number of columns of a blurred copy.
const AVERAGES: usize = 48;
/// Number of blurred copies, for roughness 1/4, 2/4, 3/4 and 1.
const LEVELS: usize = 4;

/// An environment image.
#[derive(Debug)]
pub struct Panorama {
    name: String,
    image: Sphere,
    blurred: Vec<Sphere>,
}

/// An equirectangular map of radiance by direction.
#[derive(Debug)]
struct Sphere {
    width: usize,
    /// Linear RGB, the upper row first. Shape: `[width / 2, width]`.
    values: Vec<Vec3>,
}

/// A small part of the sphere: its pixels combined.
struct Cell {
    /// Mean direction.
    direction: Vec3,
    /// Solid angle, up to a factor that is the same for all cells.
    weight: f32,
    /// Mean radiance.
    value: Vec3,
}

impl Panorama {
    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, is not an `.hdr` or `.exr` image of at most 11584 px width, or is not twice as wide as
    /// high.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let bytes = resource::read(path)?;
        let remedy = "use an equirectangular .hdr or .exr image, at most 11584 px wide";
        let fault = |problem: String| Error::malformed(path, "the sky", problem, remedy);
        let formats = [ImageFormat::Hdr, ImageFormat::OpenExr];
        let problem = "it is neither Radiance HDR nor OpenEXR";
        let reader =
            || resource::image_reader(&bytes, &formats, problem).map_err(|e| fault(e.to_string()));
        let (width, height) = reader()?.into_dimensions().map_err(|e| fault(e.to_string()))?;
        if height == 0 || width != 2 * height {
            return Err(fault(format!(
                "it has {width}x{height} px and is not twice as wide as high"
            )));
        }
        // Decoders may hold four floats per pixel.
        let decoded = u64::from(width) * u64::from(height) * 16;
        if decoded > MAX_DECODED || decoded > (bytes.len() as u64).saturating_mul(EXPANSION) {
            return Err(fault(format!(
                "it claims {width}x{height} px, which is too large or more than the file can hold"
            )));
        }
        let image = reader()?.decode().map_err(|e| fault(e.to_string()))?.into_rgb32f();
        let pixels = image.pixels().map(|pixel| Vec3::from(pixel.0)).collect();
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
        Ok(Self::new(name.unwrap_or_default(), width as usize, pixels))
    }

    /// A panorama of `width` x `width / 2` linear RGB pixels, the upper row first.
    pub(crate) fn new(name: String, width: usize, mut pixels: Vec<Vec3>) -> Self {
        for value in pixels.iter_mut().flat_map(Vec3::as_mut) {
            // NaN also becomes 0.
            *value = if *value > 0.0 { value.min(BRIGHTEST) } else { 0.0 };
        }
        let image = Sphere { width, values: pixels };
        let cells = image.cells();
        let level = |i: usize| Sphere::averaged(&cells, exponent((i + 1) as f32 / LEVELS as f32));
        let blurred = (0..LEVELS).map(level).collect();
        Self { name, image, blurred }
    }

    /// Radiance from a direction of unit length.
    pub(crate) fn radiance(&self, direction: Vec3) -> Vec3 {
        self.image.at(direction)
    }

    /// Mean radiance of a lobe around a direction: the image itself at roughness 0, a cosine lobe at 1.
    pub(crate) fn blurred(&self, direction: Vec3, roughness: f32) -> Vec3 {
        let level = roughness.clamp(0.0, 1.0) * LEVELS as f32;
        let (below, share) = (level as usize, level.fract());
        let at_level = |level: usize| match level {
            0 => self.image.at(direction),
            _ => self.blurred[(level - 1).min(LEVELS - 1)].at(direction),
        };
        if share == 0.0 {
            at_level(below)
        } else {
            at_level(below).lerp(at_level(below + 1), share)
        }
    }
}

impl Serialize for Panorama {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let mut fields = to.serialize_struct("Panorama", 2)?;
        fields.serialize_field("image", &self.name)?;
        fields.serialize_field("size", &[self.image.width, self.image.width / 2])?;
        fields.end()
    }
}

/// Exponent of the cosine for a roughness above zero.
fn exponent(roughness: f32) -> f32 {
    3.0 / (roughness * roughness) - 2.0
}

impl Sphere {
    fn height(&self) -> usize {
        self.width / 2
    }

    /// Bilinear interpolation between pixel centres, wrapping around the horizon but not across the poles.
    fn at(&self, direction: Vec3) -> Vec3 {
        let (width, height) = (self.width, self.height());
        let u = direction.z.atan2(direction.x) / TAU + 0.5;
        let v = direction.y.clamp(-1.0, 1.0).acos() / PI;
        let (x, y) = (u * width as f32 - 0.5, v * height as f32 - 0.5);
        let (left, upper) = (x.floor(), y.floor());
        let column = |x: f32| (x as i64).rem_euclid(width as i64) as usize;
        let row = |y: f32| (y as i64).clamp(0, height as i64 - 1) as usize;
        let value = |x: f32, y: f32| self.values[row(y) * width + column(x)];
        let above = value(left, upper).lerp(value(left + 1.0, upper), x - left);
        let below = value(left, upper + 1.0).lerp(value(left + 1.0, upper + 1.0), x - left);
        above.lerp(below, y - upper)
    }

    /// Reduces the image to [`CELLS`] columns.
    fn cells(&self) -> Vec<Cell> {
        if self.width < CELLS {
            let at = |i: usize| self.at(direction(i, CELLS));
            let values = (0..CELLS * CELLS / 2).map(at).collect();
            return Self { width: CELLS, values }.cells();
        }
        let mut sums = vec![(DVec3::ZERO, 0.0_f64, DVec3::ZERO); CELLS * CELLS / 2];
        for (i, value) in self.values.iter().enumerate() {
            let (x, y) = (i % self.width, i / self.width);
            let sum = &mut sums[y * CELLS / self.width * CELLS + x * CELLS / self.width];
            let weight = f64::from(polar(y, self.height()).sin());
            sum.0 += weight * direction(i, self.width).as_dvec3();
            sum.1 += weight;
            sum.2 += weight * value.as_dvec3();
        }
        let cell = |(direction, weight, value): (DVec3, f64, DVec3)| Cell {
            direction: direction.normalize_or_zero().as_vec3(),
            weight: weight as f32,
            value: (value / weight).as_vec3(),
        };
        sums.into_iter().filter(|sum| sum.1 > 0.0).map(cell).collect()
    }

    /// Averages the cells with the cosine to the power `exponent` as weight.
    fn averaged(cells: &[Cell], exponent: f32) -> Self {
        let mean = |i: usize| {
            let axis = direction(i, AVERAGES);
            let (mut sum, mut total) = (Vec3::ZERO, 0.0);
            for cell in cells {
                let cos = axis.dot(cell.direction);
                if cos > 0.0 {
                    let weight = cell.weight * cos.powf(exponent);
                    sum += weight * cell.value;
                    total += weight;
                }
            }
            sum / total
        };
        let values = (0..AVERAGES * AVERAGES / 2).into_par_iter().map(mean).collect();
        Self { width: AVERAGES, values }
    }
}

/// Angle of a row's centre from the zenith `[rad]`.
fn polar(row: usize, height: usize) -> f32 {
    (row as f32 + 0.5) / height as f32 * PI
}

/// The direction of a pixel's centre.
fn direction(i: usize, width: usize) -> Vec3 {
    let (x, y) = (i % width, i / width);
    let turn = ((x as f32 + 0.5) / width as f32 - 0.5) * TAU;
    let (sin, cos) = polar(y, width / 2).sin_cos();
    Vec3::new(sin * turn.cos(), cos, sin * turn.sin())
}

#[cfg(test)]
mod tests;
