//! The adjustment in progress: cameras and points that are moved in turn to where the tracks show them.

use std::collections::HashMap;
use std::ops::Range;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::PoseErrors;
use crate::dataset::{Tracks, median};
use densify_core::camera::Camera;
use densify_core::linear::{NormalEquations, solve};
use densify_core::pose::Twist;
use densify_core::similarity::Similarity;

/// Residuals beyond this multiple of their robust standard deviation have less weight (Huber).
const HUBER: f64 = 1.345;
/// Damping of the steps, relative to the diagonal.
const DAMPING: f64 = 1e-6;
/// Smallest number of points that determine the pose of a view.
const MIN_POINTS: usize = 12;
/// Least cosine of the angle between a point's directions in two views at which its distance is known: two degrees.
const WIDEST_PARALLEL: f64 = 0.999_39;

/// One direction in which a view shows a point.
#[derive(Debug, Clone, Copy)]
struct Sighting {
    track: u32,
    view: u32,
    /// Where the photograph shows the point `[px]`.
    pixel: DVec2,
}

/// The sightings of all tracks in order.
fn sightings(tracks: &Tracks, given: &[Camera]) -> Vec<Sighting> {
    let mut all = Vec::new();
    for (track, (views, directions)) in tracks.views.iter().zip(&tracks.directions).enumerate() {
        for (&view, direction) in views.iter().zip(directions) {
            let camera = &given[view as usize];
            let local = camera.rotation * DVec3::from(direction.map(f64::from));
            if local.z > 0.0 {
                let pixel = projected(camera, local);
                all.push(Sighting { track: track as u32, view, pixel });
            }
        }
    }
    all
}

/// The standard deviation of a normal distribution along an axis, as a multiple of the median distance in the plane.
pub(super) const MEDIAN_TO_DEVIATION: f64 = 0.849_322;

/// The solution of a view's equations for its pose, as a function of the logarithm of the focal lengths.
struct Eliminated {
    /// Without a change of the focal lengths.
    pose: [f64; 6],
    /// How much less per unit of the logarithm.
    by_focal: [f64; 6],
    /// Coefficient and right-hand side of the equation of the logarithm.
    focal: [f64; 2],
}

/// What the adjustment does not change.
pub(super) struct Seen {
    /// By track.
    sightings: Vec<Sighting>,
    /// Indices of the sightings of each view.
    of_view: Vec<Vec<u32>>,
    /// Range of the sightings of each track.
    of_track: Vec<Range<usize>>,
    /// The first view with the same lens as each view.
    lens: Vec<usize>,
}

impl Seen {
    pub(super) fn new(tracks: &Tracks, given: &[Camera]) -> Self {
        let sightings = sightings(tracks, given);
        let mut of_view = vec![Vec::new(); given.len()];
        let mut of_track = vec![0..0; tracks.count()];
        for (i, sighting) in sightings.iter().enumerate() {
            of_view[sighting.view as usize].push(i as u32);
            let range = &mut of_track[sighting.track as usize];
            *range = if range.start == range.end { i..i + 1 } else { range.start..i + 1 };
        }
        let key = |camera: &Camera| {
            let lengths = [camera.fx, camera.fy, camera.cx, camera.cy].map(f64::to_bits);
            (camera.width, camera.height, lengths)
        };
        let mut first = HashMap::new();
        let numbered = given.iter().enumerate();
        let lens =
            numbered.map(|(view, camera)| *first.entry(key(camera)).or_insert(view)).collect();
        Self { sightings, of_view, of_track, lens }
    }

    /// Number of tracks that several views see.
    pub(super) fn tracks(&self) -> usize {
        self.of_track.iter().filter(|seen| seen.len() > 1).count()
    }
}

/// Peak memory of an adjustment by these tracks, in addition to them `[bytes]`.
pub fn bytes(tracks: &Tracks) -> u64 {
    let sightings: usize = tracks.directions.iter().map(Vec::len).sum();
    // Each with its index, in a list that may have grown to twice its size.
    let of_sightings = sightings * (size_of::<Sighting>() + 2 * size_of::<u32>());
    // Distances are sorted to find their median.
    let medians = sightings * size_of::<f64>();
    // Two states with their next points, and the pairs by which the world is restored.
    let of_points = tracks.count() * 5 * size_of::<DVec3>();
    let ranges = tracks.count() * size_of::<Range<usize>>();
    (of_sightings + medians + of_points + ranges) as u64
}

/// The adjustment in progress.
#[derive(Clone)]
pub(super) struct State<'a> {
    seen: &'a Seen,
    pub(super) cameras: Vec<Camera>,
    points: Vec<DVec3>,
}

impl<'a> State<'a> {
    pub(super) fn new(seen: &'a Seen, tracks: &Tracks, given: &[Camera]) -> Self {
        Self { seen, cameras: given.to_vec(), points: tracks.positions.clone() }
    }

    /// The projection of a sighting's point less its pixel, and the point in camera coordinates; `None` behind the camera.
    fn residual(&self, sighting: &Sighting) -> Option<(DVec2, DVec3)> {
        let camera = &self.cameras[sighting.view as usize];
        let point = self.points[sighting.track as usize];
        let local = camera.rotation * point + camera.translation;
        (local.z > 0.0).then(|| (projected(camera, local) - sighting.pixel, local))
    }

    /// Robust standard deviation of the residuals along an axis `[px]`.
    pub(super) fn deviation(&self) -> f64 {
        let lengths = self.seen.sightings.iter().filter_map(|s| Some(self.residual(s)?.0.length()));
        let median = median(lengths.collect()).unwrap_or(0.0);
        MEDIAN_TO_DEVIATION * median
    }

    /// Moves every pose to where its points are seen, and scales the focal lengths of each lens if `with_focal`; returns
    /// the root mean square over the views of the motion in the picture `[px]`.
    pub(super) fn step_poses(&mut self, deviation: f64, with_focal: bool) -> f64 {
        let this = &*self;
        let of_views = (0..this.cameras.len()).into_par_iter();
        let equations: Vec<_> = of_views.map(|view| this.view_equations(view, deviation)).collect();
        let mut log_focal = vec![0.0; this.cameras.len()];
        if with_focal {
            // The poses of each view are eliminated.
            let mut of_lens = vec![[0.0; 2]; this.cameras.len()];
            for (view, eliminated) in equations.iter().enumerate() {
                if let Some(Eliminated { focal, .. }) = eliminated {
                    let lens = this.seen.lens[view];
                    of_lens[lens] = [of_lens[lens][0] + focal[0], of_lens[lens][1] + focal[1]];
                }
            }
            for (view, log_focal) in log_focal.iter_mut().enumerate() {
                let [square, right] = of_lens[this.seen.lens[view]];
                *log_focal = if square > 0.0 { (right / square).clamp(-0.1, 0.1) } else { 0.0 };
            }
        }
        let mut sum = 0.0;
        let mut moved = this.cameras.clone();
        for (view, (camera, eliminated)) in moved.iter_mut().zip(&equations).enumerate() {
            let from = *camera;
            let by = eliminated.as_ref().map_or([0.0; 6], |eliminated| {
                let Eliminated { pose, by_focal, .. } = eliminated;
                std::array::from_fn(|i| pose[i] - by_focal[i] * log_focal[view])
            });
            let [x, y, z, a, b, c] = by;
            *camera = from.moved(&Twist::from_array([x, y, z, a, b, c, log_focal[view]]));
            sum += this.motion(view, &from, camera).powi(2);
        }
        self.cameras = moved;
        (sum / self.cameras.len().max(1) as f64).sqrt()
    }

    /// The equations of a view's pose and focal lengths, solved for the pose; `None` if its points do not determine it.
    fn view_equations(&self, view: usize, deviation: f64) -> Option<Eliminated> {
        let camera = self.cameras[view];
        let mut equations = NormalEquations::<7>::default();
        let mut count = 0;
        for &i in &self.seen.of_view[view] {
            let Some((residual, p)) = self.residual(&self.seen.sightings[i as usize]) else {
                continue;
            };
            count += 1;
            let weight = huber(residual, deviation);
            let by_focal = [camera.fx * p.x / p.z, camera.fy * p.y / p.z];
            let rows = projection_rows(&camera, p).into_iter().zip(by_focal);
            for ((row, by_focal), value) in rows.zip([residual.x, residual.y]) {
                let by_turn = p.cross(row);
                let row = [row.x, row.y, row.z, by_turn.x, by_turn.y, by_turn.z, by_focal];
                equations.add(row, -value, weight);
            }
        }
        if count < MIN_POINTS {
            return None;
        }
        let (matrix, right) = equations.parts();
        let block: [[f64; 6]; 6] = std::array::from_fn(|i| {
            std::array::from_fn(|j| matrix[i][j] * if i == j { 1.0 + DAMPING } else { 1.0 })
        });
        let mixed: [f64; 6] = std::array::from_fn(|i| matrix[i][6]);
        let pose = solve(block, std::array::from_fn(|i| right[i]))?;
        let by_focal = solve(block, mixed)?;
        let dot = |x: &[f64; 6]| mixed.iter().zip(x).map(|(a, b)| a * b).sum::<f64>();
        let focal = [matrix[6][6] - dot(&by_focal), right[6] - dot(&pose)];
        Some(Eliminated { pose, by_focal, focal })
    }

    /// Root mean square over a view's points of the distance between their projections by two cameras `[px]`.
    fn motion(&self, view: usize, from: &Camera, to: &Camera) -> f64 {
        let squares = self.seen.of_view[view].iter().filter_map(|&i| {
            let point = self.points[self.seen.sightings[i as usize].track as usize];
            let [(a, z0), (b, z1)] = [from, to].map(|camera| camera.project(point));
            (z0 > 0.0 && z1 > 0.0).then(|| a.distance_squared(b))
        });
        let squares: Vec<f64> = squares.collect();
        (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
    }

    /// Moves every point to where its views see it, if they see it from sufficiently different directions.
    pub(super) fn step_points(&mut self, deviation: f64) {
        let this = &*self;
        let step = |track: usize| {
            let point = this.points[track];
            let seen = &this.seen.sightings[this.seen.of_track[track].clone()];
            let mut equations = NormalEquations::<3>::default();
            let mut first: Option<DVec3> = None;
            let mut is_known = false;
            for sighting in seen {
                let Some((residual, p)) = this.residual(sighting) else { continue };
                let camera = &this.cameras[sighting.view as usize];
                let towards = (point - camera.centre()).normalize_or_zero();
                is_known |= first.is_some_and(|first| first.dot(towards) < WIDEST_PARALLEL);
                first = first.or(Some(towards));
                let weight = huber(residual, deviation);
                for (row, value) in
                    projection_rows(camera, p).into_iter().zip([residual.x, residual.y])
                {
                    let row = camera.rotation.transpose() * row;
                    equations.add(row.to_array(), -value, weight);
                }
            }
            let solution = is_known.then(|| equations.solution(DAMPING)).flatten();
            solution.map_or(point, |by| point + DVec3::from(by))
        };
        self.points = (0..this.points.len()).into_par_iter().map(step).collect();
    }

    /// Moves everything back by the similarity that the world has drifted by: that of the cameras, or of the points,
    /// whichever is known more precisely.
    pub(super) fn restore_world(&mut self, given: &[Camera], positions: &[DVec3]) {
        let cameras: Vec<[Camera; 2]> =
            self.cameras.iter().zip(given).map(|(now, given)| [*now, *given]).collect();
        self.move_by(&Similarity::between_cameras(&cameras));
        let moved = self.cameras.iter().zip(given).map(|(a, b)| a.centre().distance(b.centre()));
        let of_cameras = median(moved.collect()).unwrap_or(0.0) / (given.len() as f64).sqrt();
        let seen = |track: &usize| self.seen.of_track[*track].len() > 1;
        let mut pairs: Vec<[DVec3; 2]> = (0..positions.len())
            .filter(seen)
            .map(|track| [self.points[track], positions[track]])
            .collect();
        // Points that have moved far are left out, twice, since what is far changes with the similarity.
        let mut back = Similarity::IDENTITY;
        let apart = |back: &Similarity, [a, b]: &[DVec3; 2]| back.point(*a).distance_squared(*b);
        for _ in 0..2 {
            pairs.sort_by(|a, b| apart(&back, a).total_cmp(&apart(&back, b)));
            back = Similarity::between(&pairs[..(pairs.len() * 4).div_ceil(5)]);
        }
        let distances = pairs.iter().map(|pair| apart(&back, pair).sqrt());
        let of_points = median(distances.collect()).unwrap_or(0.0) / (pairs.len() as f64).sqrt();
        if of_points < of_cameras {
            self.move_by(&back);
        }
    }

    fn move_by(&mut self, similarity: &Similarity) {
        for point in &mut self.points {
            *point = similarity.point(*point);
        }
        for camera in &mut self.cameras {
            *camera = similarity.camera(camera);
        }
    }

    pub(super) fn errors(&self, given: &[Camera], before: f64) -> PoseErrors {
        let deviation = self.deviation();
        let (mut views, mut motion, mut noise) = (0, 0.0, 0.0);
        for (view, given) in given.iter().enumerate() {
            let count = self.seen.of_view[view].len();
            if count >= MIN_POINTS {
                views += 1;
                motion += self.motion(view, given, &self.cameras[view]).powi(2);
                // Six numbers are fitted to two residuals per point.
                noise += 6.0 * deviation * deviation / count as f64;
            }
        }
        let mean = |sum: f64| (sum / f64::from(views).max(1.0)).sqrt();
        PoseErrors {
            tracks: self.seen.tracks(),
            views: views as usize,
            before,
            after: deviation / MEDIAN_TO_DEVIATION,
            motion: mean(motion),
            uncertainty: mean(noise),
        }
    }
}

fn projected(camera: &Camera, local: DVec3) -> DVec2 {
    let [x, y] = [local.x, local.y].map(|x| x / local.z);
    DVec2::new(camera.fx * x + camera.cx, camera.fy * y + camera.cy)
}

/// Derivatives of both coordinates of a projection with respect to the point in camera coordinates.
fn projection_rows(camera: &Camera, p: DVec3) -> [DVec3; 2] {
    let scaled = DVec2::new(camera.fx, camera.fy) / p.z;
    [
        DVec3::new(scaled.x, 0.0, -scaled.x * p.x / p.z),
        DVec3::new(0.0, scaled.y, -scaled.y * p.y / p.z),
    ]
}

/// Huber's weight of a residual.
fn huber(residual: DVec2, deviation: f64) -> f64 {
    let bound = HUBER * deviation;
    let length = residual.length();
    if length <= bound { 1.0 } else { bound / length }
}
