//! Camera paths like those of an aerial survey: rows of oblique views from above, looking to every side in
//! turn, and views at eye height along streets. A test view is halfway between two training views.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use super::{ATTEMPTS, GOLDEN, Rig, Viewpoint, on_sphere};
use crate::camera::Camera;
use crate::surface::Surface;

/// Smallest and largest angle below the horizon of views from above `[degrees]`.
const DOWNWARD_ANGLES: [f64; 2] = [45.0, 65.0];
/// Smallest and largest angle above the horizon of street views `[degrees]`.
const STREET_PITCH: [f64; 2] = [-4.0, 10.0];
/// Distance of street views from the street's centre line, on alternating sides `[share of eye height]`.
const ASIDE: f64 = 0.35;
/// One view in this many is a street view.
const STREET_INTERVAL: u32 = 3;
/// Smallest share of a view that must show a surface.
const MIN_SHOWN: f64 = 0.65;
/// Columns and rows of the rays by which this share is measured.
const RAYS: [u32; 2] = [12, 9];
/// Fractional part of the golden ratio. The fractional parts of its multiples are spread evenly over `[0, 1)`.
const SPREAD: f64 = 0.618_033_988_749_895;

/// The area and streets that the cameras of a survey cover.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Survey {
    /// Opposite corners, (x, z), of the rectangle that is flown over and looked at.
    pub ground: [[f64; 2]; 2],
    /// Height of the points looked at, and height of the cameras above these points.
    pub height: [f64; 2],
    /// Both ends of every street, at eye height.
    pub streets: Vec<[[f64; 3]; 2]>,
    /// Eye height above the street.
    pub eye: f64,
}

impl Survey {
    /// A survey of a scene without streets, at a height from which a view shows about a third of it.
    fn over((lo, hi): (DVec3, DVec3)) -> Self {
        let (middle, half) = (0.5 * (lo + hi), 0.45 * (hi - lo));
        let ground = [middle - half, middle + half].map(|corner| [corner.x, corner.z]);
        let height = [lo.y, hi.y - lo.y + half.x.hypot(half.z) / 1.6];
        Self { ground, height, streets: Vec::new(), eye: 0.0 }
    }

    /// Number of views from above among `views`; the others are street views.
    fn above(&self, views: u32) -> u32 {
        if self.streets.is_empty() { views } else { views - views / STREET_INTERVAL }
    }

    /// Total length of all streets.
    fn length(&self) -> f64 {
        self.streets.iter().map(|[a, b]| DVec3::from(*a).distance(DVec3::from(*b))).sum()
    }

    /// The point at a distance along the concatenated streets, and the street's direction there.
    fn along(&self, mut distance: f64) -> (DVec3, DVec3) {
        let mut end = (DVec3::ZERO, DVec3::Z);
        for [from, to] in &self.streets {
            let (from, to) = (DVec3::from(*from), DVec3::from(*to));
            let (ahead, length) = ((to - from).normalize_or(DVec3::Z), from.distance(to));
            if distance <= length {
                return (from + distance * ahead, ahead);
            }
            distance -= length;
            end = (to, ahead);
        }
        end
    }
}

impl Rig {
    /// The viewpoint of a view of a survey, looking in a different direction at each attempt.
    pub(super) fn survey_viewpoint(
        &self,
        surface: &Surface,
        (i, test): (u32, bool),
        attempt: u64,
    ) -> Viewpoint {
        let default;
        let survey = match &self.survey {
            Some(survey) => survey,
            None => {
                default = Survey::over(surface.bounds());
                &default
            }
        };
        let views = if test { self.test } else { self.train };
        let (above, trained) = (survey.above(views), survey.above(self.train));
        let shift = if test { 0.5 } else { 0.0 };
        if i < above {
            let place = if test { neighbour(i, above, trained) } else { i };
            let turn = f64::from(i) + shift + attempt as f64;
            self.above_ground(survey, (place, trained, test), turn)
        } else {
            let (i, views, trained) = (i - above, views - above, (self.train - trained).max(1));
            let place = if test { neighbour(i, views, trained) } else { i };
            let distance = (f64::from(place) + 0.5 + shift) / f64::from(trained) * survey.length();
            let (middle, ahead) = survey.along(distance);
            let side = if test { 0.0 } else { f64::from(place % 2) * 2.0 - 1.0 };
            let place = middle + side * ASIDE * survey.eye * ahead.cross(DVec3::Y);
            let turn = f64::from(i) + shift + attempt as f64;
            let [low, high] = STREET_PITCH.map(f64::to_radians);
            let pitch = low + (turn * SPREAD).fract() * (high - low);
            let reach = 0.2 * survey.height[1];
            (place, place + reach * on_sphere(turn * GOLDEN, pitch))
        }
    }

    /// The viewpoint above position `i` of `count` in a grid; for test views, half a cell nearer to the centre.
    fn above_ground(
        &self,
        survey: &Survey,
        (i, count, test): (u32, u32, bool),
        turn: f64,
    ) -> Viewpoint {
        let [lo, hi] = survey.ground.map(DVec2::from);
        let (place, cell) = place_in_rows(i, count, hi - lo);
        let middle = 0.5 * (lo + hi);
        let mut place = lo + place;
        if test {
            // Towards the centre, because there may be nothing to see farther out.
            place -= 0.5 * cell * (place - middle + 1e-9 * cell).signum();
        }
        let [low, high] = DOWNWARD_ANGLES.map(f64::to_radians);
        let height = survey.height[1] * self.radius;
        let down = low + (turn * SPREAD).fract() * (high - low);
        let reach = height / down.tan();
        let mut offset = reach * DVec2::from(horizontal(turn * GOLDEN));
        // Views from the edge look inwards.
        for axis in 0..2 {
            if !(lo[axis]..=hi[axis]).contains(&(place[axis] + offset[axis])) {
                offset[axis] = offset[axis].abs() * (middle[axis] - place[axis]).signum();
            }
        }
        let target = place + offset;
        let base = survey.height[0];
        (DVec3::new(place.x, base + height, place.y), DVec3::new(target.x, base, target.y))
    }
}

/// The horizontal unit vector at an azimuth, as (x, z).
fn horizontal(azimuth: f64) -> [f64; 2] {
    let flat = on_sphere(azimuth, 0.0);
    [flat.x, flat.z]
}

/// The training view that a test view is next to.
fn neighbour(i: u32, tests: u32, trained: u32) -> u32 {
    let share = (f64::from(i) + 0.5) / f64::from(tests.max(1));
    ((share * f64::from(trained)) as u32).min(trained.saturating_sub(1))
}

/// Position `i` of `count` in rows of alternating direction over a rectangle with the given sides, and the sides
/// of its cell.
fn place_in_rows(i: u32, count: u32, sides: DVec2) -> (DVec2, DVec2) {
    let wanted = (f64::from(count) * sides.y / sides.x.max(f64::MIN_POSITIVE)).sqrt().round();
    let rows = u64::from((wanted as u32).clamp(1, count.max(1)));
    let (i, count) = (u64::from(i), u64::from(count));
    let first = |row: u64| (count * row).div_ceil(rows);
    let row = i * rows / count.max(1);
    let (number, row_length) = (i - first(row), first(row + 1) - first(row));
    let number = if row % 2 == 0 { number } else { row_length - 1 - number };
    let cell = sides / DVec2::new(row_length as f64, rows as f64);
    (cell * (DVec2::new(number as f64, row as f64) + 0.5), cell)
}

/// True if enough of a view shows a surface rather than sky; the required share falls to 0 at the last attempt.
pub(super) fn shows_enough(surface: &Surface, camera: &Camera, attempt: u64) -> bool {
    let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
    let [columns, rows] = RAYS;
    let meets = |ray: &u32| {
        let at = DVec2::new(f64::from(ray % columns), f64::from(ray / columns)) + 0.5;
        let at = at / DVec2::new(f64::from(columns), f64::from(rows)) * size;
        surface.cast(camera.centre, camera.direction(at), f64::INFINITY).is_some()
    };
    let met = (0..columns * rows).filter(meets).count();
    let still_required = 1.0 - attempt as f64 / ATTEMPTS as f64;
    met as f64 >= MIN_SHOWN * still_required * f64::from(columns * rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Model;
    use crate::rig::RigKind;

    #[test]
    fn positions_in_rows_are_evenly_spread() {
        for (count, sides) in
            [(1, [3.0, 9.0]), (12, [4.0, 3.0]), (17, [50.0, 20.0]), (64, [1.0; 2])]
        {
            let sides = DVec2::from(sides);
            let places: Vec<DVec2> = (0..count).map(|i| place_in_rows(i, count, sides).0).collect();
            let even = (sides.x * sides.y / f64::from(count)).sqrt();
            for (i, a) in places.iter().enumerate() {
                assert!(a.cmpgt(DVec2::ZERO).all() && a.cmplt(sides).all(), "{count}: {a}");
                let near = places[..i].iter().map(|b| a.distance(*b)).fold(f64::INFINITY, f64::min);
                assert!(near > 0.5 * even, "{count}: {near} m between neighbours, {even} if even");
            }
            let mean = places.iter().sum::<DVec2>() / f64::from(count);
            assert!((mean - 0.5 * sides).abs().cmplt(0.1 * sides).all(), "{count}: {mean}");
        }
    }

    #[test]
    fn a_scene_without_streets_is_seen_from_above() {
        let mut model = Model::default();
        let stone = model.material(crate::mesh::Material::lambert("stone", [0.5; 3]));
        let corner = DVec3::new(-40.0, 2.0, 30.0);
        model.quad(corner, 100.0 * DVec3::X, -60.0 * DVec3::Z, stone);
        let surface = Surface::new(&model).expect("triangles");
        let rig = Rig { kind: RigKind::Survey, fov: 65.0, ..Rig::default() };
        let (train, test) = rig.cameras(&surface, &[]).expect("cameras");
        for camera in train.iter().chain(&test) {
            let down = camera.forward().y.asin().to_degrees();
            assert!((-65.1..=-44.9).contains(&down), "{down} degrees");
            // There is nothing around the scene, so the share required after 40 attempts is used.
            assert!(shows_enough(&surface, camera, 40), "{camera:?}");
        }
        // The corners and the middle of the surveyed ground are visible.
        for (x, z) in [(-30.0, 24.0), (50.0, 24.0), (-30.0, -24.0), (50.0, -24.0), (10.0, 0.0)] {
            let sees = |camera: &&Camera| {
                let (pixel, depth) = camera.project(DVec3::new(x, 2.0, z));
                depth > 0.0 && camera.contains(pixel)
            };
            assert!(train.iter().filter(sees).count() >= 8, "({x}, {z})");
        }
    }
}
