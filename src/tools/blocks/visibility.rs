//! Determines which views see which points: from the tracks of the reconstruction, or else by projecting the points
//! into the images.

use glam::DVec3;
use rayon::prelude::*;

use super::{Cell, Ground};
use densify_data::dataset::normalise::median;
use densify_data::dataset::{Dataset, Part, View};
use densify_run::failure::Failure;

/// Minimum number of tracks; fewer are not representative.
const MIN_TRACKS: usize = 500;
/// A view belongs to a block if at least this fraction of the points that it sees lie in the block's cell or margin.
const MIN_FRACTION: f64 = 0.05;
/// Margin around a block's points in the part of an image that the block trains on, as a fraction of the image's size.
const PART_MARGIN: f64 = 0.04;
/// Maximum number of points that are projected into the training views, evenly sampled.
const MAX_POINTS: usize = 20_000;
/// Maximum number of points that are projected into the test views, evenly sampled.
const MAX_TEST_POINTS: usize = 2_000;

/// The points of a scene, their positions on the ground, and the training views that see each.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Visibility {
    /// Positions in scene coordinates. Shape: `[points]`.
    points: Vec<DVec3>,
    /// Positions in ground coordinates `[world units]`. Shape: `[points]`.
    pub(super) on_ground: Vec<[f64; 2]>,
    /// Indices of the training views that see each point. Shape: `[points][views]`.
    seen_by: Vec<Vec<u32>>,
}

impl Visibility {
    /// Determines the visibility of the points of a dataset.
    ///
    /// # Errors
    /// If the dataset has no points.
    pub(super) fn new(dataset: &Dataset, ground: &Ground) -> Result<Self, Failure> {
        let project =
            |&point: &DVec3| ground.project(dataset.normalisation.world_from_scene(point));
        let tracks = &dataset.tracks;
        if tracks.positions.len() >= MIN_TRACKS {
            return Ok(Self {
                points: tracks.positions.clone(),
                on_ground: tracks.positions.iter().map(project).collect(),
                seen_by: tracks.views.clone(),
            });
        }
        let points = &dataset.points.positions;
        if points.is_empty() {
            return Err(Failure::input(format!(
                "{}: the dataset has no points, which are needed to divide it; make a \
                 reconstruction with points (COLMAP), or train it as a whole",
                dataset.root.display()
            )));
        }
        let stride = points.len().div_ceil(MAX_POINTS);
        let points: Vec<DVec3> = points.iter().step_by(stride).copied().collect();
        let seen_by = |point: &DVec3| {
            let sees = |view: &View| view.camera.depth_in_image(*point, 0.0).is_some();
            (0..)
                .zip(&dataset.train)
                .filter(|(_, view)| sees(view))
                .map(|(index, _)| index)
                .collect()
        };
        Ok(Self {
            on_ground: points.iter().map(project).collect(),
            seen_by: points.par_iter().map(seen_by).collect(),
            points,
        })
    }

    /// The work of each point: the number of views that see it. Shape: `[points]`.
    pub(super) fn work(&self) -> Vec<f64> {
        self.seen_by.iter().map(|views| views.len() as f64).collect()
    }

    /// Size of the scene along both axes of the ground, robust to outliers `[world units]`.
    pub(super) fn widths(&self) -> [f64; 2] {
        [0, 1].map(|axis| {
            let centre = median(self.on_ground.iter().map(|at| at[axis]).collect());
            let deviation = |centre: f64| {
                median(self.on_ground.iter().map(|at| (at[axis] - centre).abs()).collect())
            };
            // A uniform distribution is four times as wide as its median absolute deviation.
            4.0 * centre.and_then(deviation).unwrap_or_default()
        })
    }

    /// Names of the views that see a cell; for training views, also the part of the image that shows it.
    pub(super) fn views<'a>(
        &self,
        dataset: &'a Dataset,
        ground: &Ground,
        cell: &Cell,
    ) -> Vec<(&'a str, Option<Part>)> {
        let is_enough =
            |inside: u32, all: u32| all > 0 && f64::from(inside) >= MIN_FRACTION * f64::from(all);
        let coverage = self.coverage(&dataset.train, |at| cell.contains(at));
        let train = dataset.train.iter().zip(coverage);
        let train = train
            .filter(|(_, coverage)| is_enough(coverage.inside, coverage.all))
            .map(|(view, coverage)| (&*view.name, coverage.part));
        // Tracks exist in training views only, so the dataset's points are projected into the test views.
        let points = &dataset.points.positions;
        let points = points.iter().step_by(points.len().div_ceil(MAX_TEST_POINTS).max(1));
        let is_inside = |&point: &DVec3| {
            cell.contains(ground.project(dataset.normalisation.world_from_scene(point)))
        };
        let points: Vec<_> = points.map(|point| (*point, is_inside(point))).collect();
        let sees = |view: &&View| {
            let is_visible = |point: DVec3| view.camera.depth_in_image(point, 0.0).is_some();
            let visible = points.iter().filter(|(point, _)| is_visible(*point));
            let [inside, all] = visible.fold([0, 0], |[inside, all], (_, is_inside)| {
                [inside + u32::from(*is_inside), all + 1]
            });
            is_enough(inside, all)
        };
        let test = dataset.test.iter().filter(sees).map(|view| (&*view.name, None));
        train.chain(test).collect()
    }

    /// The coverage of each training view by all points and by those inside a cell. Shape: `[views]`.
    fn coverage(&self, train: &[View], is_inside: impl Fn([f64; 2]) -> bool) -> Vec<Coverage> {
        let mut coverage = vec![Coverage::default(); train.len()];
        for ((point, at), views) in self.points.iter().zip(&self.on_ground).zip(&self.seen_by) {
            let is_inside = is_inside(*at);
            for &view in views {
                let coverage = &mut coverage[view as usize];
                coverage.all += 1;
                if is_inside {
                    coverage.inside += 1;
                    let camera = &train[view as usize].camera;
                    let pixel = camera.project(*point).0;
                    let x = pixel.x / f64::from(camera.width);
                    let y = pixel.y / f64::from(camera.height);
                    let old =
                        coverage.part.unwrap_or(Part { left: x, top: y, right: x, bottom: y });
                    coverage.part = Some(Part {
                        left: old.left.min(x),
                        top: old.top.min(y),
                        right: old.right.max(x),
                        bottom: old.bottom.max(y),
                    });
                }
            }
        }
        for part in coverage.iter_mut().filter_map(|coverage| coverage.part.as_mut()) {
            *part = Part {
                left: (part.left - PART_MARGIN).clamp(0.0, 1.0 - PART_MARGIN),
                top: (part.top - PART_MARGIN).clamp(0.0, 1.0 - PART_MARGIN),
                right: (part.right + PART_MARGIN).clamp(PART_MARGIN, 1.0),
                bottom: (part.bottom + PART_MARGIN).clamp(PART_MARGIN, 1.0),
            };
        }
        coverage
    }
}

/// How many points a view sees, and where those inside a cell lie in its image.
#[derive(Debug, Clone, Copy, Default)]
struct Coverage {
    /// Number of visible points inside the cell.
    inside: u32,
    /// Number of visible points.
    all: u32,
    /// The part of the image that contains the points inside the cell, with a margin; `None` if there are none.
    part: Option<Part>,
}

#[cfg(test)]
mod tests {
    use densify_core::camera::Camera;
    use glam::DMat3;

    use super::*;
    use densify_data::dataset::LoadOptions;
    use densify_fixtures::Made;

    #[test]
    fn the_part_of_a_view_covers_the_points_inside_the_cell() {
        let made = Made::colmap_txt();
        let mut dataset = Dataset::load(made.path(), &LoadOptions::default()).expect("a dataset");
        dataset.train.truncate(2);
        for view in &mut dataset.train {
            let size = (100, 50);
            view.camera = Camera::centred(size, (100.0, 100.0), DMat3::IDENTITY, DVec3::ZERO);
        }
        // Points at x = 30, 50 and 90 px, y = 25 px. The last is outside the cell; view 1 does not see the first.
        let visibility = Visibility {
            points: vec![DVec3::new(-0.2, 0.0, 1.0), DVec3::Z, DVec3::new(0.4, 0.0, 1.0)],
            on_ground: vec![[0.0; 2], [0.0; 2], [9.0; 2]],
            seen_by: vec![vec![0], vec![0, 1], vec![0, 1]],
        };
        let assert_part = |part: Option<Part>, expected: [f64; 4]| {
            let Part { left, top, right, bottom } = part.expect("it is seen");
            let is_near = |(a, b): (f64, f64)| (a - b).abs() < 1e-9;
            assert!([left, top, right, bottom].into_iter().zip(expected).all(is_near), "{part:?}");
        };
        let seen = visibility.coverage(&dataset.train, |[x, _]| x < 1.0);
        assert_part(seen[0].part, [0.26, 0.46, 0.54, 0.54]);
        assert_part(seen[1].part, [0.46, 0.46, 0.54, 0.54]);
        assert_eq!([seen[0].inside, seen[0].all, seen[1].inside, seen[1].all], [2, 3, 1, 2]);
        let none = visibility.coverage(&dataset.train, |_| false);
        assert_eq!([none[0].part, none[1].part], [None, None]);
    }
}
