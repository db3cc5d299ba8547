//! Errors that real depth and real poses have, so that anyone can test how a trainer copes with them.
//!
//! Only what trainers read of the training views is damaged: the depth in `.npy` files, and the poses. The depth in
//! `.exr` files, which judges a trained scene, stays true.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::error::Error;
use crate::random::Draws;
use crate::trace::Frame;

/// Errors of the depth and of the poses of training views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Damage {
    /// Standard deviation of the noise on depth, as a share of the depth, in `[0, 1]`.
    pub noise: f64,
    /// Distance over which the noise is correlated `[px]`; up to 1: white noise.
    pub noise_width: f64,
    /// Share of the pixels without depth, in patches, in `[0, 1]`.
    pub holes: f64,
    /// Share of the remaining pixels that keep their depth, chosen at random, in `[0, 1]`.
    pub sparse: f64,
    /// Factor on all depths, > 0.
    pub scale: f64,
    /// Standard deviation of the logarithm of a further factor of each view, >= 0.
    pub scale_jitter: f64,
    /// True for distances along rays instead of depth along the optical axis.
    pub along_rays: bool,
    /// Displacement of the depth to the right and down `[px]`.
    pub shift: [i32; 2],
    /// Standard deviation of a rotation of each camera about its centre `[degrees]`, in `[0, 90]`.
    pub pose_noise: f64,
    /// Standard deviation of a displacement of each camera along each axis, as a share of the largest distance of a
    /// training camera from their mean, in `[0, 1]`.
    pub position_noise: f64,
    /// Relative error of the focal lengths of all training views, in `[-0.5, 1]`.
    pub focal_error: f64,
}

impl Default for Damage {
    fn default() -> Self {
        Self {
            noise: 0.0,
            noise_width: 0.0,
            holes: 0.0,
            sparse: 1.0,
            scale: 1.0,
            scale_jitter: 0.0,
            along_rays: false,
            shift: [0; 2],
            pose_noise: 0.0,
            position_noise: 0.0,
            focal_error: 0.0,
        }
    }
}

/// Width of the patches without depth `[px]`.
const HOLE_WIDTH: f64 = 16.0;
/// Largest displacement `[px]`.
const MAX_SHIFT: i32 = 1 << 14;
/// Keys of the random streams.
const NOISE: u64 = 0x006e_6f69_7365;
const HOLES: u64 = 0x0068_6f6c_6573;
const SPARSE: u64 = 0x0073_7061_7273;
const SCALES: u64 = 0x0073_6361_6c65;
const POSES: u64 = 0x0070_6f73_6573;
const POSITIONS: u64 = 0x706f_7369_7469;

impl Damage {
    /// True if nothing is damaged.
    pub(crate) fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Fails if a value is out of range.
    pub(crate) fn check(&self) -> Result<(), Error> {
        let within = |option, value: f64, most: f64| match value {
            value if (0.0..=most).contains(&value) => Ok(()),
            _ => Err(Error::option(option, format!("{value} is not between 0 and {most}"))),
        };
        within("--depth-noise", self.noise, 1.0)?;
        within("--depth-noise-width", self.noise_width, 1024.0)?;
        within("--depth-holes", self.holes, 1.0)?;
        within("--depth-sparse", self.sparse, 1.0)?;
        within("--depth-scale-jitter", self.scale_jitter, 2.0)?;
        within("--pose-noise", self.pose_noise, 90.0)?;
        within("--position-noise", self.position_noise, 1.0)?;
        if !(-0.5..=1.0).contains(&self.focal_error) {
            let problem = format!("{} is not between -0.5 and 1", self.focal_error);
            return Err(Error::option("--focal-error", problem));
        }
        if !(self.scale > 0.0 && self.scale.is_finite()) {
            return Err(Error::option("--depth-scale", "it must be positive and finite"));
        }
        if self.shift.iter().any(|shift| shift.abs() > MAX_SHIFT) {
            return Err(Error::option("--depth-shift", format!("at most {MAX_SHIFT} px")));
        }
        Ok(())
    }

    /// The damaged depth of a training view `[world units]`, 0 where there is none. Shape: `[height, width]`.
    pub(crate) fn depth(&self, frame: &Frame, camera: &Camera, seed: u64, view: usize) -> Vec<f32> {
        let (width, height) = (frame.width as usize, frame.height as usize);
        let view = view as u64;
        let stream = |purpose: u64| Draws::new(seed, &[purpose, view]);
        let factor = self.scale * (self.scale_jitter * stream(SCALES).normal()).exp();
        let at = |i: usize| [i % width, i / width];
        let limit = self.hole_limit(stream(HOLES), [width, height]);
        let damaged = |i: usize| {
            let [x, y] = at(i);
            let from =
                [(x, self.shift[0], width), (y, self.shift[1], height)].map(|(at, shift, side)| {
                    usize::try_from(at as i64 - i64::from(shift)).ok().filter(|&from| from < side)
                });
            let [Some(from_x), Some(from_y)] = from else { return 0.0 };
            let mut depth = f64::from(frame.depth[from_y * width + from_x]) * factor;
            if self.along_rays {
                let pixel = DVec2::new(from_x as f64, from_y as f64) + 0.5;
                depth *= camera.direction(pixel).length();
            }
            if self.noise > 0.0 {
                depth *=
                    (1.0 + self.noise * field(stream(NOISE), self.noise_width, [x, y])).max(0.0);
            }
            let is_hole =
                limit.is_some_and(|limit| field(stream(HOLES), HOLE_WIDTH, [x, y]) < limit);
            let is_left_out =
                self.sparse < 1.0 && stream(SPARSE).with(i as u64).unit64() >= self.sparse;
            if is_hole || is_left_out { 0.0 } else { depth as f32 }
        };
        (0..width * height).map(damaged).collect()
    }

    /// The value of the field of holes below which the wanted share of all pixels lies.
    fn hole_limit(&self, draws: Draws, [width, height]: [usize; 2]) -> Option<f64> {
        if self.holes <= 0.0 {
            return None;
        }
        let mut values: Vec<f64> =
            (0..width * height).map(|i| field(draws, HOLE_WIDTH, [i % width, i / width])).collect();
        values.sort_unstable_by(f64::total_cmp);
        let count = (self.holes * values.len() as f64).round() as usize;
        Some(values.get(count).copied().unwrap_or(f64::INFINITY))
    }

    /// The camera that is written for a training view; `reach` is the largest distance of a training camera from their
    /// mean.
    pub(crate) fn camera(&self, camera: &Camera, seed: u64, view: usize, reach: f64) -> Camera {
        let mut damaged = *camera;
        let mut draws = Draws::new(seed, &[POSES, view as u64]);
        let vector = |draws: &mut Draws| DVec3::new(draws.normal(), draws.normal(), draws.normal());
        if self.pose_noise > 0.0 {
            let axis = vector(&mut draws).normalize_or(DVec3::Z);
            let angle = (self.pose_noise * draws.normal()).to_radians();
            let turn = DMat3::from_axis_angle(axis, angle);
            damaged.world_from_camera = turn * camera.world_from_camera;
        }
        if self.position_noise > 0.0 {
            let mut draws = Draws::new(seed, &[POSITIONS, view as u64]);
            damaged.centre += self.position_noise * reach * vector(&mut draws);
        }
        for focal in [&mut damaged.fx, &mut damaged.fy] {
            *focal *= 1.0 + self.focal_error;
        }
        damaged
    }
}

/// A random field of mean 0 and variance 1, correlated over `width` pixels: a lattice of normal numbers, between which
/// values are interpolated.
fn field(draws: Draws, width: f64, [x, y]: [usize; 2]) -> f64 {
    let node = |x: u64, y: u64| draws.with(x).with(y).normal();
    if width <= 1.0 {
        return node(x as u64, y as u64);
    }
    let place = [x, y].map(|at| (at as f64 + 0.5) / width);
    let first = place.map(f64::floor);
    let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
    let [u, v] = [0, 1].map(|axis| smooth(place[axis] - first[axis]));
    let (mut sum, mut squares) = (0.0, 0.0);
    for (dx, wx) in [(0, 1.0 - u), (1, u)] {
        for (dy, wy) in [(0, 1.0 - v), (1, v)] {
            let weight = wx * wy;
            sum += weight * node(first[0] as u64 + dx, first[1] as u64 + dy);
            squares += weight * weight;
        }
    }
    sum / f64::sqrt(squares)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: u32 = 64;

    fn frame() -> Frame {
        let pixels = (SIDE * SIDE) as usize;
        Frame {
            width: SIDE,
            height: SIDE,
            rgba: Vec::new(),
            exposed: None,
            mask: None,
            depth: (0..pixels).map(|i| if i % SIDE as usize == 0 { 0.0 } else { 2.0 }).collect(),
            normals: Vec::new(),
            triangles: Vec::new(),
        }
    }

    fn camera() -> Camera {
        Camera::looking(DVec3::Z, DVec3::ZERO, DVec3::Y, 1.4, (SIDE, SIDE))
    }

    fn damaged(damage: Damage) -> Vec<f32> {
        damage.check().unwrap();
        damage.depth(&frame(), &camera(), 7, 3)
    }

    #[test]
    fn nothing_is_damaged_by_default() {
        assert!(Damage::default().is_none());
        assert_eq!(damaged(Damage::default()), frame().depth);
        let pose = Damage::default().camera(&camera(), 7, 3, 1.0);
        assert_eq!(pose, camera());
    }

    #[test]
    fn noise_has_the_wanted_size_and_width() {
        for width in [0.0, 16.0] {
            let noisy = damaged(Damage { noise: 0.05, noise_width: width, ..Damage::default() });
            let errors: Vec<f64> = noisy.iter().map(|z| f64::from(*z) / 2.0 - 1.0).collect();
            let inside: Vec<(usize, f64)> =
                errors.iter().copied().enumerate().filter(|(i, _)| i % 64 > 0).collect();
            let rms = (inside.iter().map(|(_, e)| e * e).sum::<f64>() / inside.len() as f64).sqrt();
            assert!((rms - 0.05).abs() < 0.015, "{rms} at width {width}");
            let beside: f64 = inside.windows(2).map(|pair| (pair[0].1 - pair[1].1).powi(2)).sum();
            let beside = (beside / inside.len() as f64).sqrt();
            assert_eq!(beside > 0.05, width < 1.0, "{beside} at width {width}");
        }
    }

    #[test]
    fn holes_and_sparse_depth_leave_the_wanted_share() {
        let share = |damage| {
            let left = damaged(damage).iter().filter(|z| **z > 0.0).count();
            left as f64 / f64::from((SIDE - 1) * SIDE)
        };
        assert!((share(Damage { holes: 0.3, ..Damage::default() }) - 0.7).abs() < 0.02);
        assert!((share(Damage { sparse: 0.1, ..Damage::default() }) - 0.1).abs() < 0.02);
        assert!(share(Damage { holes: 1.0, ..Damage::default() }) < 1e-9);
    }

    #[test]
    fn scales_rays_and_shifts_are_applied() {
        let scaled = damaged(Damage { scale: 1.5, ..Damage::default() });
        assert!((scaled[5] - 3.0).abs() < 1e-6);
        let views = |view| {
            Damage { scale_jitter: 0.1, ..Damage::default() }.depth(&frame(), &camera(), 7, view)[5]
        };
        assert!((views(0) - views(1)).abs() > 1e-3);
        let rays = damaged(Damage { along_rays: true, ..Damage::default() });
        let middle = (SIDE * SIDE / 2 + SIDE / 2) as usize;
        assert!(
            (rays[middle] - 2.0).abs() < 0.01 && rays[SIDE as usize - 1] > 2.2,
            "{}",
            rays[SIDE as usize - 1]
        );
        let shifted = damaged(Damage { shift: [2, -1], ..Damage::default() });
        let at = |x: u32, y: u32| shifted[(y * SIDE + x) as usize];
        // The column without depth has moved, and what lies outside is unknown.
        let is_known = [(0, 5), (1, 5), (2, 5), (3, 5), (9, SIDE - 1)].map(|(x, y)| at(x, y) > 0.0);
        assert_eq!(is_known, [false, false, false, true, false]);
    }

    #[test]
    fn poses_are_turned_about_the_centre() {
        let damage = Damage { pose_noise: 0.2, ..Damage::default() };
        let turned = damage.camera(&camera(), 7, 3, 1.0);
        assert_eq!(turned.centre, camera().centre);
        let angle = |camera: Camera| camera.world_from_camera.z_axis;
        let angle = angle(turned).angle_between(angle(camera())).to_degrees();
        assert!(angle > 1e-4 && angle < 1.5, "{angle}");
    }

    #[test]
    fn positions_and_focal_lengths_are_changed() {
        let damage = Damage { position_noise: 0.01, focal_error: 0.02, ..Damage::default() };
        let moved = [3, 4].map(|view| damage.camera(&camera(), 7, view, 5.0));
        let apart = moved.map(|moved| moved.centre.distance(camera().centre));
        assert!(apart.iter().all(|apart| (1e-3..0.3).contains(apart)), "{apart:?}");
        assert!((apart[0] - apart[1]).abs() > 1e-6);
        assert_eq!(moved[0].world_from_camera, camera().world_from_camera);
        assert!((moved[0].fx / camera().fx - 1.02).abs() < 1e-12);
    }

    #[test]
    fn values_out_of_range_are_refused_with_their_option() {
        let none = Damage::default();
        for (damage, option) in [
            (Damage { noise: 2.0, ..none }, "--depth-noise"),
            (Damage { holes: -0.1, ..none }, "--depth-holes"),
            (Damage { sparse: f64::NAN, ..none }, "--depth-sparse"),
            (Damage { scale: 0.0, ..none }, "--depth-scale"),
            (Damage { shift: [1 << 20, 0], ..none }, "--depth-shift"),
            (Damage { pose_noise: 91.0, ..none }, "--pose-noise"),
            (Damage { position_noise: -1.0, ..none }, "--position-noise"),
            (Damage { focal_error: 2.0, ..none }, "--focal-error"),
        ] {
            let message = damage.check().unwrap_err().to_string();
            assert!(message.contains(option), "{message}");
        }
    }
}
