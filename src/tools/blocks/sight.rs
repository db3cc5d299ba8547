//! Which views see which points: by the tracks of a reconstruction, or else by what lies in their images.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::{Cell, Ground};
use densify_core::camera::Camera;
use densify_data::dataset::normalise::median;
use densify_data::dataset::{Dataset, Part, View};
use densify_run::failure::Failure;

/// Fewer tracks say too little.
const ENOUGH_TRACKS: usize = 500;
/// A view belongs to a block if at least this share of the points that it sees lie in the block.
const LEAST_SHARE: f64 = 0.05;
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
            let numbers =
                numbers.filter(|(_, camera)| camera.depth_in_image(*point, 0.0).is_some());
            numbers.map(|it| it.0).collect()
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

    /// Names of the views of a dataset that see a part of the ground, and where those that are trained on do.
    pub(super) fn views<'a>(
        &self,
        dataset: &'a Dataset,
        ground: &Ground,
        cell: &Cell,
    ) -> Vec<(&'a str, Option<Part>)> {
        let enough =
            |within: u32, all: u32| all > 0 && f64::from(within) >= LEAST_SHARE * f64::from(all);
        let seen = self.seen(&dataset.train, |at| cell.has(at));
        let train = dataset.train.iter().zip(seen);
        let train = train
            .filter(|(_, seen)| enough(seen.within, seen.all))
            .map(|(view, seen)| (&*view.name, seen.part));
        // Tracks are in training views only.
        let points = &dataset.points.positions;
        let some = points.iter().step_by(points.len().div_ceil(2_000).max(1));
        let some: Vec<_> = some
            .map(|&point| (point, ground.at(dataset.normalisation.world_from_scene(point))))
            .collect();
        let sees = |view: &&View| {
            let shown =
                some.iter().filter(|(point, _)| view.camera.depth_in_image(*point, 0.0).is_some());
            let [within, all] = shown.fold([0, 0], |[within, all], (_, at)| {
                [within + u32::from(cell.has(*at)), all + 1]
            });
            enough(within, all)
        };
        let test = dataset.test.iter().filter(sees).map(|view| (&*view.name, None));
        train.chain(test).collect()
    }

    /// What each training view sees of the points, and of those that `is_inside`.
    fn seen(&self, train: &[View], is_inside: impl Fn([f64; 2]) -> bool) -> Vec<Seen> {
        let mut seen = vec![Seen::default(); train.len()];
        for ((point, at), views) in self.points.iter().zip(&self.at).zip(&self.seen_by) {
            let is_inside = is_inside(*at);
            for &view in views {
                let seen = &mut seen[view as usize];
                seen.all += 1;
                if is_inside {
                    seen.within += 1;
                    let camera = &train[view as usize].camera;
                    seen.hold(camera, camera.project(*point).0);
                }
            }
        }
        for part in seen.iter_mut().filter_map(|seen| seen.part.as_mut()) {
            *part = Part {
                left: (part.left - AROUND).clamp(0.0, 1.0 - AROUND),
                top: (part.top - AROUND).clamp(0.0, 1.0 - AROUND),
                right: (part.right + AROUND).clamp(AROUND, 1.0),
                bottom: (part.bottom + AROUND).clamp(AROUND, 1.0),
            };
        }
        seen
    }
}

/// What a view sees of the points.
#[derive(Debug, Clone, Copy, Default)]
struct Seen {
    /// How many inside.
    within: u32,
    /// How many at all.
    all: u32,
    /// The part of the view that shows those inside, and a little beside them; `None` where it sees none.
    part: Option<Part>,
}

impl Seen {
    /// Widens the part to a pixel of the camera.
    fn hold(&mut self, camera: &Camera, pixel: DVec2) {
        let [x, y] = [pixel.x / f64::from(camera.width), pixel.y / f64::from(camera.height)];
        let old = self.part.unwrap_or(Part { left: x, top: y, right: x, bottom: y });
        self.part = Some(Part {
            left: old.left.min(x),
            top: old.top.min(y),
            right: old.right.max(x),
            bottom: old.bottom.max(y),
        });
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use densify_data::dataset::LoadOptions;
    use densify_fixtures::Made;

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
        let seen = sight.seen(&dataset.train, |[x, _]| x < 1.0);
        near(seen[0].part, [0.26, 0.46, 0.54, 0.54]);
        near(seen[1].part, [0.46, 0.46, 0.54, 0.54]);
        assert_eq!([seen[0].within, seen[0].all, seen[1].within, seen[1].all], [2, 3, 1, 2]);
        let none = sight.seen(&dataset.train, |_| false);
        assert_eq!([none[0].part, none[1].part], [None, None]);
    }
}
