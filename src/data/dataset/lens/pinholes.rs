//! Replaces a lens with pinhole cameras: one, or the faces of a cube around the camera if the field of view is too
//! wide.
//!
//! By default each image is the largest axis-aligned rectangle that the lens saw completely. With `keep_fov` it
//! contains everything that the lens saw, and the rest is masked.

use glam::{DMat3, DVec2, DVec3};

use super::{Lens, Projection, Unseen};
use crate::dataset::undistort::{Pinhole, Undistortion};

/// The pinhole cameras that replace a lens.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Pinholes {
    /// Name and resampling of each pinhole camera; a single camera has an empty name.
    pub(crate) faces: Vec<(&'static str, Undistortion)>,
    /// Share of the photograph that no pinhole camera shows.
    pub(crate) cropped: f64,
}

/// Reason why no pinhole camera can replace a lens.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub(crate) enum PinholeError {
    /// The distortion has no inverse in a part of the image; the usable field of view `[degrees]`.
    #[error(
        "the distortion folds over within the image and cannot be inverted there: the largest usable field of \
         view is {0:.1} degrees"
    )]
    Folds(f64),
    /// No pinhole image of a useful size shows a part of the photograph.
    #[error("no part of the photograph can be shown by a pinhole camera")]
    NothingVisible,
}

/// Intervals between samples along a side of the photograph. Within one, a border that bulges by 100 px over the whole
/// side deviates from a straight line by 100 px · (1/64)², less than 0.03 px.
const SAMPLES: u32 = 64;
/// Cells along each side of a face that are tested for visibility.
const CELLS: usize = 128;
/// Steepest ray of a single pinhole, x/z: 65 degrees for a fisheye, 80 degrees for a distorted pinhole. Below these
/// angles a pinhole is better: cube faces cost up to 4 dB in test views as wide as the photographs
/// (docs/studies/wide-fisheyes.tsv).
const STEEPEST: f64 = 2.15;
const STEEPEST_PERSPECTIVE: f64 = 5.67;
/// Smallest side of a face that becomes a view, x/z.
const MIN_SIDE: f64 = 0.2;
/// Largest number of pixels of a face, relative to the photograph.
const MAX_PIXELS: f64 = 4.0;

/// A rectangle on the image plane of a pinhole, in x/z and y/z.
#[derive(Debug, Clone, Copy)]
struct Rectangle {
    low: DVec2,
    high: DVec2,
}

impl Rectangle {
    fn is_within(&self, limit: f64) -> bool {
        self.low.cmpge(DVec2::splat(-limit)).all() && self.high.cmple(DVec2::splat(limit)).all()
    }
}

impl Pinholes {
    /// The pinhole cameras that cover the field of view of a lens.
    ///
    /// # Errors
    /// When the distortion folds over within the image, unless `keep_fov` is set, or when no pinhole camera is left.
    pub(crate) fn covering(lens: &Lens, keep_fov: bool) -> Result<Self, PinholeError> {
        let seen = grid(lens);
        if !keep_fov && seen.iter().any(|(_, ray)| *ray == Err(Unseen::Folds)) {
            return Err(PinholeError::Folds(lens.usable_field()));
        }
        let rim = rim(lens);
        let rays = || seen.iter().filter_map(|(_, ray)| ray.ok()).chain(rim.iter().copied());
        let is_whole = seen.iter().all(|(_, ray)| ray.is_ok());
        let perspective = lens.distortion.plane == Projection::Perspective;
        let steepest = if perspective { STEEPEST_PERSPECTIVE } else { STEEPEST };
        // A little less than the cosine of the largest angle that projections through tan θ support.
        let is_forward = rays().all(|ray| ray.z > 0.08 * ray.length());
        let flat = |ray: DVec3| ray.truncate() / ray.z;
        let bounds = rays().fold(None, |bounds: Option<Rectangle>, ray| {
            let at = flat(ray);
            let bounds = bounds.unwrap_or(Rectangle { low: at, high: at });
            Some(Rectangle { low: bounds.low.min(at), high: bounds.high.max(at) })
        });
        let bounds = bounds.ok_or(PinholeError::NothingVisible)?;
        let inner = if is_forward && is_whole && !keep_fov { inscribed(&seen, flat) } else { None };
        let faces = if let Some(inner) = inner.filter(|inner| inner.is_within(steepest)) {
            // A distorted pinhole keeps its image size.
            let size = perspective.then_some((lens.width, lens.height));
            vec![("", face(lens, DMat3::IDENTITY, inner, size, false))]
        } else if is_forward && bounds.is_within(steepest) {
            visible_part(lens, DMat3::IDENTITY, bounds, keep_fov)
                .map(|face| ("", face))
                .into_iter()
                .collect()
        } else {
            let whole = Rectangle { low: DVec2::NEG_ONE, high: DVec2::ONE };
            let face = |(name, turn)| Some((name, visible_part(lens, turn, whole, keep_fov)?));
            cube().into_iter().filter_map(face).collect::<Vec<_>>()
        };
        if faces.is_empty() {
            return Err(PinholeError::NothingVisible);
        }
        let shown = |ray: DVec3| faces.iter().any(|(_, face)| face.shows(ray));
        let imaged = || seen.iter().filter(|(_, ray)| *ray != Err(Unseen::OutsideCircle));
        let lost = imaged().filter(|(_, ray)| !ray.is_ok_and(shown)).count();
        let cropped = lost as f64 / imaged().count() as f64;
        Ok(Self { faces, cropped })
    }
}

/// The faces of a cube as rotations `lens_from_face`: the front face and the four that share its edges.
fn cube() -> [(&'static str, DMat3); 5] {
    let turned = |x, y, z| DMat3::from_cols(x, y, z);
    let (x, y, z) = (DVec3::X, DVec3::Y, DVec3::Z);
    [
        ("front", DMat3::IDENTITY),
        ("left", turned(z, y, -x)),
        ("right", turned(-z, y, x)),
        ("up", turned(x, z, -y)),
        ("down", turned(x, -z, y)),
    ]
}

/// Points on a grid over the photograph, including its border, row by row, and their rays.
fn grid(lens: &Lens) -> Vec<(DVec2, Result<DVec3, Unseen>)> {
    let side = f64::from(SAMPLES);
    let places = (0..=SAMPLES).flat_map(|y| (0..=SAMPLES).map(move |x| (x, y)));
    let places = places.map(|(x, y)| lens.size() * DVec2::new(f64::from(x), f64::from(y)) / side);
    places.map(|place| (place, lens.unproject(place))).collect()
}

/// The rays of points on the rim of the image circle, which the grid may miss; none without a circle.
fn rim(lens: &Lens) -> Vec<DVec3> {
    let Some(radius) = lens.circle else { return Vec::new() };
    let points = (0..4 * SAMPLES).map(|step| {
        let angle = f64::from(step) / f64::from(4 * SAMPLES) * std::f64::consts::TAU;
        // Rounding must not move a point out of the circle.
        0.5 * lens.size() + DVec2::from_angle(angle) * (radius * (1.0 - 1e-9))
    });
    let inside = points.filter(|point| lens.images(*point, 0.0));
    inside.filter_map(|point| lens.unproject(point).ok()).collect()
}

/// The rectangle between the innermost points of the four borders; `None` if it excludes the axis or a point has no
/// ray.
fn inscribed(
    seen: &[(DVec2, Result<DVec3, Unseen>)],
    flat: impl Fn(DVec3) -> DVec2,
) -> Option<Rectangle> {
    let row = SAMPLES as usize + 1;
    let (mut low, mut high) = (DVec2::NEG_INFINITY, DVec2::INFINITY);
    for at in 0..row {
        let border = |index: usize| seen[index].1.ok().map(&flat);
        low.x = low.x.max(border(at * row)?.x);
        high.x = high.x.min(border(at * row + row - 1)?.x);
        low.y = low.y.max(border(at)?.y);
        high.y = high.y.min(border((row - 1) * row + at)?.y);
    }
    let holds = low.cmplt(DVec2::ZERO).all() && high.cmpgt(DVec2::ZERO).all();
    holds.then_some(Rectangle { low, high })
}

/// The pinhole that looks along the third column of `turn` at the part of a rectangle that the lens saw; `None` if
/// that part is too small.
fn visible_part(
    lens: &Lens,
    turn: DMat3,
    within: Rectangle,
    keep_fov: bool,
) -> Option<Undistortion> {
    let step = (within.high - within.low) / CELLS as f64;
    let at = |x: usize, y: usize| within.low + step * DVec2::new(x as f64, y as f64);
    let is_seen = |x, y| {
        let pixel = lens.project(turn * at(x, y).extend(1.0));
        // The ray of a border pixel is projected back to the border up to rounding.
        pixel.is_some_and(|pixel| lens.images(pixel, 1e-6))
    };
    let row = CELLS + 1;
    let corners: Vec<bool> = (0..row * row).map(|i| is_seen(i % row, i / row)).collect();
    let cells: Vec<[bool; 4]> = (0..CELLS * CELLS)
        .map(|i| {
            let corner = i / CELLS * row + i % CELLS;
            [corner, corner + 1, corner + row, corner + row + 1].map(|i| corners[i])
        })
        .collect();
    let whole: Vec<bool> = cells.iter().map(|cell| *cell == [true; 4]).collect();
    let ([x0, y0], [x1, y1]) = if keep_fov {
        let any: Vec<bool> = cells.iter().map(|cell| cell.contains(&true)).collect();
        bounding_rectangle(&any)?
    } else {
        largest_rectangle(&whole)?
    };
    let rectangle = Rectangle { low: at(x0, y0), high: at(x1, y1) };
    let is_useful = keep_fov
        || (rectangle.high - rectangle.low).min_element()
            >= MIN_SIDE.min(step.min_element() * 32.0);
    let masked = (y0..y1).any(|y| whole[y * CELLS + x0..y * CELLS + x1].contains(&false));
    is_useful.then(|| face(lens, turn, rectangle, None, masked))
}

/// The pinhole that shows a rectangle, in an image of `size` or with the lens's pixels per radian on the axis.
fn face(
    lens: &Lens,
    turn: DMat3,
    Rectangle { low, high }: Rectangle,
    size: Option<(u32, u32)>,
    masked: bool,
) -> Undistortion {
    let (width, height) = size.unwrap_or_else(|| {
        let side = lens.focal * lens.distortion.plane.slope() * (high - low);
        let pixels = lens.size().element_product() * MAX_PIXELS / side.element_product();
        let side = (side * pixels.min(1.0).sqrt()).round();
        (side.x.max(1.0) as u32, side.y.max(1.0) as u32)
    });
    let focal = DVec2::new(f64::from(width), f64::from(height)) / (high - low);
    let to = Pinhole { width, height, focal, principal: -low * focal };
    Undistortion { from: *lens, to, lens_from_pinhole: turn, masked }
}

/// The smallest rectangle around all set cells: its first column and row, and those after its last column and row.
fn bounding_rectangle(set: &[bool]) -> Option<([usize; 2], [usize; 2])> {
    let places = || (0..set.len()).filter(|&i| set[i]).map(|i| [i % CELLS, i / CELLS]);
    let low = [0, 1].map(|axis| places().map(|place| place[axis]).min());
    let high = [0, 1].map(|axis| places().map(|place| place[axis] + 1).max());
    Some(([low[0]?, low[1]?], [high[0]?, high[1]?]))
}

/// The largest rectangle in which all cells are set, in the form of [`bounding_rectangle`].
fn largest_rectangle(set: &[bool]) -> Option<([usize; 2], [usize; 2])> {
    // Number of consecutive set cells that end in this row, for each column.
    let mut heights = [0; CELLS];
    let mut best = (0, None);
    for bottom in 0..CELLS {
        for (x, height) in heights.iter_mut().enumerate() {
            *height = if set[bottom * CELLS + x] { *height + 1 } else { 0 };
        }
        for left in 0..CELLS {
            let mut height = usize::MAX;
            for (right, &above) in heights.iter().enumerate().skip(left) {
                height = height.min(above);
                if height == 0 {
                    break;
                }
                let area = height * (right - left + 1);
                if area > best.0 {
                    best = (area, Some(([left, bottom + 1 - height], [right + 1, bottom + 1])));
                }
            }
        }
    }
    best.1
}
