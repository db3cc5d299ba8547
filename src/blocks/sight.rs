//! Which views see which points: by the tracks of a reconstruction, or else by what lies in their images.

use glam::DVec3;
use rayon::prelude::*;

use super::Ground;
use crate::camera::Camera;
use crate::dataset::normalise::median;
use crate::dataset::{Dataset, Part, View};
use crate::failure::Failure;

/// Fewer tracks say too little.
const ENOUGH_TRACKS: usize = 500;
/// How far a view of a block reaches beyond the block's points, in parts of the image's sides.
const AROUND: f64 = 0.04;
/// Most points that are looked at, evenly chosen.
const MOST_POINTS: usize = 20_000;

/// Points on the ground, and the training views that see each.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sight {
    /// In the coordinates of training. Shape: `[points]`.
    points: Vec<DVec3>,
    /// Shape: `[points]`.
    pub(super) at: Vec<[f64; 2]>,
    /// Numbers of training views. Shape: `[points]`, then views.
    pub(super) seen_by: Vec<Vec<u32>>,
    /// Whether tracks say so; else a view is taken to see whatever lies in its image.
    pub(super) is_tracked: bool,
}

impl Sight {
    /// What the views of a dataset see.
    ///
    /// # Errors
    /// When the dataset has no points.
    pub(super) fn of(dataset: &Dataset, ground: &Ground) -> Result<Self, Failure> {
        let world = |point: DVec3| ground.at(dataset.normalisation.world_from_scene(point));
        let tracks = &dataset.tracks;
        if tracks.positions.len() >= ENOUGH_TRACKS {
            return Ok(Self {
                points: tracks.positions.clone(),
                at: tracks.positions.iter().map(|&point| world(point)).collect(),
                seen_by: tracks.views.clone(),
                is_tracked: true,
            });
        }
        let points = &dataset.points.positions;
        if points.is_empty() {
            return Err(Failure::input(format!(
                "{}: the dataset has no points, by which a scene is divided; make a reconstruction with points \
                 (COLMAP), or train it as a whole",
                dataset.root.display()
            )));
        }
        let stride = points.len().div_ceil(MOST_POINTS);
        let some: Vec<DVec3> = points.iter().step_by(stride).copied().collect();
        let cameras: Vec<Camera> = dataset.train.iter().map(|view| view.camera).collect();
        let views_of = |point: &DVec3| {
            let numbers = (0u32..).zip(&cameras);
            numbers.filter(|(_, camera)| shows(camera, *point, 0.0)).map(|it| it.0).collect()
        };
        Ok(Self {
            at: some.iter().map(|&point| world(point)).collect(),
            seen_by: some.par_iter().map(views_of).collect(),
            points: some,
            is_tracked: false,
        })
    }

    /// The work of each point: how many views see it.
    pub(super) fn work(&self) -> Vec<f64> {
        self.seen_by.iter().map(|views| views.len() as f64).collect()
    }

    /// How wide the ground is, along both axes; outliers do not count.
    pub(super) fn widths(&self) -> [f64; 2] {
        [0, 1].map(|axis| {
            let middle = median(self.at.iter().map(|at| at[axis]).collect());
            let off =
                |middle: f64| median(self.at.iter().map(|at| (at[axis] - middle).abs()).collect());
            // Of points that are evenly spread, half lie in the middle half.
            4.0 * middle.and_then(off).unwrap_or_default()
        })
    }

    /// The part of each view that shows the points that `is_inside`, and a little beside them; `None` where it sees none.
    pub(super) fn parts(
        &self,
        train: &[View],
        is_inside: impl Fn([f64; 2]) -> bool,
    ) -> Vec<Option<Part>> {
        let mut parts = vec![None::<Part>; train.len()];
        let inside = (0..self.at.len()).filter(|&point| is_inside(self.at[point]));
        for (point, views) in inside.map(|point| (self.points[point], &self.seen_by[point])) {
            for &view in views {
                let camera = &train[view as usize].camera;
                let pixel = camera.project(point).0;
                let (x, y) =
                    (pixel.x / f64::from(camera.width), pixel.y / f64::from(camera.height));
                let part = &mut parts[view as usize];
                let old = part.unwrap_or(Part { left: x, top: y, right: x, bottom: y });
                *part = Some(Part {
                    left: old.left.min(x),
                    top: old.top.min(y),
                    right: old.right.max(x),
                    bottom: old.bottom.max(y),
                });
            }
        }
        let widened = |part: Part| Part {
            left: (part.left - AROUND).clamp(0.0, 1.0 - AROUND),
            top: (part.top - AROUND).clamp(0.0, 1.0 - AROUND),
            right: (part.right + AROUND).clamp(AROUND, 1.0),
            bottom: (part.bottom + AROUND).clamp(AROUND, 1.0),
        };
        parts.into_iter().map(|part| part.map(widened)).collect()
    }

    /// Of how many of the points that `is_inside` each of so many views sees how many, and how many it sees at all.
    pub(super) fn counts(
        &self,
        views: usize,
        is_inside: impl Fn([f64; 2]) -> bool,
    ) -> Vec<[u32; 2]> {
        let mut counts = vec![[0; 2]; views];
        for (at, seen_by) in self.at.iter().zip(&self.seen_by) {
            let inside = u32::from(is_inside(*at));
            for &view in seen_by {
                let [within, all] = &mut counts[view as usize];
                *within += inside;
                *all += 1;
            }
        }
        counts
    }
}

/// Whether a point lies in the image of a camera, or as near to it as a share of its sides.
pub(super) fn shows(camera: &Camera, point: DVec3, beside: f64) -> bool {
    let (pixel, depth) = camera.project(point);
    let within = |x: f64, size: u32| {
        let (size, beside) = (f64::from(size), beside * f64::from(size));
        (-beside..size + beside).contains(&x)
    };
    depth > 0.0 && within(pixel.x, camera.width) && within(pixel.y, camera.height)
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::dataset::LoadOptions;
    use crate::dataset::tests::write::Made;

    #[test]
    fn a_view_has_the_part_that_shows_what_is_inside() {
        let made = Made::colmap_txt();
        let mut dataset = Dataset::load(made.path(), &LoadOptions::default()).expect("a dataset");
        dataset.train.truncate(2);
        for view in &mut dataset.train {
            let size = (100, 50);
            view.camera = Camera::centred(size, (100.0, 100.0), DMat3::IDENTITY, DVec3::ZERO);
        }
        // At x = 30, 50 and 90, in the middle of y; the last is outside, and view 1 does not see the first.
        let sight = Sight {
            points: vec![DVec3::new(-0.2, 0.0, 1.0), DVec3::Z, DVec3::new(0.4, 0.0, 1.0)],
            at: vec![[0.0; 2], [0.0; 2], [9.0; 2]],
            seen_by: vec![vec![0], vec![0, 1], vec![0, 1]],
            is_tracked: true,
        };
        let near = |part: Option<Part>, expected: [f64; 4]| {
            let Part { left, top, right, bottom } = part.expect("it is seen");
            let is_near = |(a, b): (f64, f64)| (a - b).abs() < 1e-9;
            assert!([left, top, right, bottom].into_iter().zip(expected).all(is_near), "{part:?}");
        };
        let parts = sight.parts(&dataset.train, |[x, _]| x < 1.0);
        near(parts[0], [0.26, 0.46, 0.54, 0.54]);
        near(parts[1], [0.46, 0.46, 0.54, 0.54]);
        assert_eq!(sight.parts(&dataset.train, |_| false), [None, None]);
    }
}
