//! The scene's size, from the points that the views show.

use glam::DVec3;

use super::MeshError;
use super::frame::{Frame, Frames};

/// Number of points taken from a view and from all views, about.
const POINTS: usize = 2000;
const ALL_POINTS: usize = 200_000;
/// Share of the points below the lower and above the upper side of the scene's box, along each axis: few points far
/// outside, such as the sky's, do not count.
const OUTSIDE: f64 = 0.01;
/// Distance from the scene's box within which surfaces are fused, too `[diagonals]`.
const MARGIN: f64 = 0.5;

/// A box with sides along the axes `[scene units]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// Smallest coordinates.
    pub low: DVec3,
    /// Largest coordinates.
    pub high: DVec3,
}

impl Region {
    pub(super) fn contains(&self, point: DVec3) -> bool {
        point.cmpge(self.low).all() && point.cmple(self.high).all()
    }
}

/// The scene's size.
pub(super) struct Extent {
    /// The part of space to fuse.
    pub(super) region: Region,
    /// Diagonal of the scene's box, or of the given region `[scene units]`.
    pub(super) diagonal: f64,
}

/// Measures the scene: the box of the points seen, or the given region.
pub(super) fn survey(frames: &mut Frames<'_>, region: Option<Region>) -> Result<Extent, MeshError> {
    let mut points = Vec::new();
    let per_view = POINTS.min(ALL_POINTS / frames.count().max(1)).max(1);
    frames.for_each(|frame: &Frame| {
        let (width, height) = (frame.map.width, frame.map.height);
        let step = ((width * height / per_view) as f64).sqrt().max(1.0) as usize;
        for y in (step / 2..height).step_by(step) {
            for x in (step / 2..width).step_by(step) {
                points.extend(frame.seen_in_scene(x, y));
            }
        }
        Ok::<_, MeshError>(())
    })?;
    points.retain(|point| point.is_finite() && region.is_none_or(|region| region.contains(*point)));
    if points.is_empty() {
        return Err(MeshError::Nothing);
    }
    if let Some(region) = region {
        return Ok(Extent { region, diagonal: region.low.distance(region.high) });
    }
    let (mut low, mut high) = (DVec3::ZERO, DVec3::ZERO);
    for axis in 0..3 {
        let mut along: Vec<f64> = points.iter().map(|point| point[axis]).collect();
        along.sort_unstable_by(f64::total_cmp);
        let outside = (OUTSIDE * along.len() as f64) as usize;
        (low[axis], high[axis]) = (along[outside], along[along.len() - 1 - outside]);
    }
    let diagonal = low.distance(high);
    if diagonal <= 0.0 {
        return Err(MeshError::Nothing);
    }
    let margin = DVec3::splat(MARGIN * diagonal);
    Ok(Extent { region: Region { low: low - margin, high: high + margin }, diagonal })
}
