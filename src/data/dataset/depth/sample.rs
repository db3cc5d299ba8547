//! Samples a depth map at the centres of a view's pixels.
//!
//! Each pixel takes the nearest valid value, never a mean: between two surfaces a mean lies on neither. Where
//! neighbours differ by more than 5 %, the confidence is 0, because sensors mix the two surfaces there. In noisy maps
//! the limit is higher, or hardly any pixel would be left.

use std::borrow::Cow;

use glam::DVec2;

use super::super::LoadError;
use super::super::images::ImageSource;
use super::super::normalise::median;
use super::raw::{self, Values};
use super::{DepthAlong, DepthSource, From, MapFile, Meaning};
use densify_core::image::depth::nearest_valid;

/// Relative difference of neighbouring depths above which neither counts.
const EDGE: f32 = 0.05;
/// The limit is at least this multiple of the median difference, which is 2/3 of the standard deviation.
const NOISE: f32 = 4.0;
/// Number of pixels, at equal intervals, in which the median difference is measured.
const MEASURED: usize = 4096;

/// The values of a file, the number of negative ones, and their confidences, if there are any.
type Stored<'a> = (Cow<'a, Values>, usize, Option<Vec<u8>>);

/// Inverse depths of a view and their confidences.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sampled {
    /// Inverse depth along the view's axis; not positive or NaN where it is unknown `[1/scene units]`.
    pub(super) inverse: Vec<f32>,
    /// Weight of each pixel, 0 to 255.
    pub(super) confidence: Vec<u8>,
    /// Share of negative values among those of the file that are not 0 and finite, in `[0, 1]`.
    pub(super) negative: f64,
}

impl Sampled {
    /// Returns true if more than one depth is known, and all are the same.
    pub(super) fn is_constant(&self) -> bool {
        let mut known = self.inverse.iter().filter(|x| **x > 0.0 && x.is_finite());
        let Some(first) = known.next() else { return false };
        let mut others = known.peekable();
        others.peek().is_some() && others.all(|x| (x - first).abs() <= 1e-6 * first)
    }
}

impl DepthSource {
    /// The depth at the pixels of a view, in the units of the scene.
    pub(super) fn sampled(&self, view: &ImageSource) -> Result<Sampled, LoadError> {
        if let From::Points(points) = &self.from {
            let inverse = points.projected(&self.camera);
            let confidence = vec![255; inverse.len()];
            return Ok(Sampled { inverse, confidence, negative: 0.0 });
        }
        let (values, negative, confidence) = self.values()?;
        let values = values.as_ref();
        let known = values.iter().filter(|value| !value.is_nan()).count();
        let negative = negative as f64 / (negative + known).max(1) as f64;
        let file = DVec2::new(f64::from(values.width()), f64::from(values.height()));
        let (width, height) = view.whole_size();
        let whole = DVec2::new(f64::from(width), f64::from(height));
        let header = DVec2::new(f64::from(view.header.width), f64::from(view.header.height));
        let shown = DVec2::new(f64::from(view.width), f64::from(view.height));
        let offset = view
            .window
            .map_or(DVec2::ZERO, |window| DVec2::new(f64::from(window.x), f64::from(window.y)));
        // The part of the map that a pixel covers, and the distance at which neighbours are compared.
        let half = 0.5 * file / shown * whole / header;
        let reach = [half.x, half.y].map(|half| (2.0 * half).round().max(1.0) as i64);
        let limit = EDGE.max(NOISE * self.noise(values, reach));
        let pixels = self.camera.width as usize * self.camera.height as usize;
        let mut sampled = Sampled {
            inverse: Vec::with_capacity(pixels),
            confidence: Vec::with_capacity(pixels),
            negative,
        };
        for y in 0..self.camera.height {
            for x in 0..self.camera.width {
                let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let pinhole = (pixel + offset) * whole / shown;
                let source = match &view.undistortion {
                    None => Some(pinhole),
                    Some(undistortion) => undistortion.source_of(pinhole),
                };
                let at = source.map(|source| source / header * file);
                let found = at.and_then(|at| {
                    let is_known = |pixel: usize| !values.as_raw()[pixel].is_nan();
                    nearest_valid(values.dimensions(), at.into(), half.into(), is_known)
                });
                let factor = self.factor(view, pixel);
                let value = found.zip(factor).map_or(f32::NAN, |(found, factor)| {
                    (self.inverse_of(values.as_raw()[found]) * factor) as f32
                });
                let weight = found.map_or(0, |found| {
                    if self.neighbours(values, found, reach).any(|apart| apart > limit) {
                        return 0;
                    }
                    confidence.as_ref().map_or(255, |levels| levels[found])
                });
                sampled.inverse.push(value);
                sampled.confidence.push(weight);
            }
        }
        Ok(sampled)
    }

    /// The values of the file and their confidences, turned like the photograph.
    fn values(&self) -> Result<Stored<'_>, LoadError> {
        let MapFile { file, kind, header, confidence, turn } = match &self.from {
            From::File(map) => &**map,
            From::Rendered(values) => return Ok((Cow::Borrowed(values), 0, None)),
            From::Points(_) => return Ok((Cow::Owned(Values::default()), 0, None)),
        };
        let (mut values, negative) = raw::read(file, *kind, self.meaning.keeps_zero())?;
        let changed = |path, (width, height): (u32, u32)| {
            let problem = format!("it has become {width}x{height} px since the run began");
            Err(LoadError::malformed(path, "the depth map", problem, "restore it"))
        };
        if values.dimensions() != (header.width, header.height) {
            return changed(&file.path, values.dimensions());
        }
        if let Some(turn) = turn {
            values = raw::turned(values, *turn);
        }
        let Some((file, _)) = confidence else { return Ok((Cow::Owned(values), negative, None)) };
        let mut levels = raw::read_confidence(file)?;
        if levels.dimensions() != (header.width, header.height) {
            return changed(&file.path, levels.dimensions());
        }
        if let Some(turn) = turn {
            levels = raw::turned(levels, *turn);
        }
        Ok((Cow::Owned(values), negative, Some(levels.into_raw())))
    }

    /// Inverse of the distance that a value stands for `[1/scene units]`.
    fn inverse_of(&self, value: f32) -> f64 {
        let value = f64::from(value);
        match self.meaning {
            Meaning::Depth(unit) => 1.0 / (value * unit * self.to_scene),
            Meaning::Inverse([scale, offset]) => (scale * value + offset) / self.to_scene,
            Meaning::Unfitted => value,
        }
    }

    /// The factor from the inverse of the stored distance to the inverse depth along the view's axis; `None` if the ray
    /// of the pixel leads away from the side that the map shows.
    fn factor(&self, view: &ImageSource, pixel: DVec2) -> Option<f64> {
        let camera = &self.camera;
        let ray = ((pixel - DVec2::new(camera.cx, camera.cy)) / DVec2::new(camera.fx, camera.fy))
            .extend(1.0);
        match self.along {
            // A point at distance d along the ray has the depth d / |ray|.
            DepthAlong::Ray => Some(ray.length()),
            // One of several views of a lens may look in another direction than the lens.
            DepthAlong::Axis => match &view.undistortion {
                Some(undistortion) => {
                    let across = (undistortion.lens_from_pinhole * ray).z;
                    (across > 0.0).then_some(across)
                }
                None => Some(1.0),
            },
        }
    }

    /// The median relative difference of neighbours in a map.
    fn noise(&self, values: &Values, reach: [i64; 2]) -> f32 {
        let stride = values.len().div_ceil(MEASURED).max(1);
        let pixels = (0..values.len()).step_by(stride);
        let apart = pixels.flat_map(|pixel| self.neighbours(values, pixel, reach));
        median(apart.map(f64::from).collect()).unwrap_or(0.0) as f32
    }

    /// The relative differences between the depth of a pixel of the map and those of its neighbours that are known.
    fn neighbours(
        &self,
        values: &Values,
        pixel: usize,
        [dx, dy]: [i64; 2],
    ) -> impl Iterator<Item = f32> {
        let (width, height) = (i64::from(values.width()), i64::from(values.height()));
        let (x, y) = (pixel as i64 % width, pixel as i64 / width);
        let here = self.inverse_of(values.as_raw()[pixel]) as f32;
        [(dx, 0), (-dx, 0), (0, dy), (0, -dy)].into_iter().filter_map(move |(dx, dy)| {
            let (x, y) = (x + dx, y + dy);
            if x < 0 || y < 0 || x >= width || y >= height {
                return None;
            }
            let there = self.inverse_of(values.as_raw()[(y * width + x) as usize]) as f32;
            let apart = (here - there).abs() / here.abs().min(there.abs());
            // Unknown neighbours are NaN.
            apart.is_finite().then_some(apart)
        })
    }
}
