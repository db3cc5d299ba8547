//! Flights that follow from the cameras of a dataset.

use std::f64::consts::TAU;

use glam::{DMat3, DVec3};

use super::{Flight, Key};
use crate::camera::Camera;

/// Cameras that a flight passes.
const KEYS: u32 = 48;
/// Turns of a spiral.
const TURNS: f64 = 2.0;
/// Directions lie in a plane if at most this share of their squares is across it: a roll of 13° on average.
const FLAT: f64 = 0.05;
/// And on a line if the second axis has no more than this.
const LINE: f64 = 0.1;
/// Share of the cameras within the reach of a spiral.
const WITHIN: f64 = 0.9;

/// What cameras have in common.
struct Rig {
    centre: DVec3,
    forward: DVec3,
    up: DVec3,
    /// The point nearest to all lines of sight.
    focus: DVec3,
    /// Whether most of the cameras have it before them.
    looks_inward: bool,
    fov_y: f64,
}

impl Rig {
    /// At least one camera.
    fn of(cameras: &[Camera]) -> Self {
        let mean = |of: &dyn Fn(&Camera) -> DVec3| {
            cameras.iter().map(of).sum::<DVec3>() / cameras.len() as f64
        };
        let centre = mean(&Camera::centre);
        let forward = mean(&Camera::forward).normalize_or(cameras[0].forward());
        let up = mean(&|camera| -camera.rotation.row(1)).normalize_or(-cameras[0].rotation.row(1));
        // Least squares: Σ (I − ffᵀ) (x − c) = 0. A little of the cameras' mean keeps it solvable where all
        // look the same way.
        let (mut matrix, mut right) = (DMat3::IDENTITY * 1e-9, centre * 1e-9);
        for camera in cameras {
            let f = camera.forward();
            let across = DMat3::IDENTITY - outer(f);
            matrix += across;
            right += across * camera.centre();
        }
        let focus = matrix.inverse() * right;
        let ahead = |camera: &&Camera| (focus - camera.centre()).dot(camera.forward()) > 0.0;
        let looks_inward = 2 * cameras.iter().filter(ahead).count() > cameras.len();
        // Photographs are taken upright, or with the camera on its side: then their other axis is level.
        let level = [0, 1].map(|axis| flat(cameras.iter().map(move |c| c.rotation.row(axis))));
        let up = level[0].or(level[1]).map_or(up, |normal| {
            // Of a camera on its side it is not known which: cameras are mostly above what they look at.
            let sign = if level[0].is_some() { up } else { centre - focus };
            if normal.dot(sign) < 0.0 { -normal } else { normal }
        });
        let mut fovs: Vec<f64> = cameras
            .iter()
            .map(|camera| 2.0 * (0.5 * f64::from(camera.height) / camera.fy).atan())
            .collect();
        fovs.sort_by(f64::total_cmp);
        let fov_y = fovs[fovs.len() / 2];
        Self { centre, forward, up, focus, looks_inward, fov_y }
    }
}

/// What cameras agree about.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bearings {
    /// Which way is up, of length 1.
    pub up: DVec3,
    /// The point nearest to all lines of sight.
    pub focus: DVec3,
    /// Whether most of the cameras have it before them.
    pub looks_inward: bool,
}

/// What these cameras agree about.
///
/// # Panics
/// Without cameras.
#[must_use]
pub fn bearings(cameras: &[Camera]) -> Bearings {
    let Rig { up, focus, looks_inward, .. } = Rig::of(cameras);
    Bearings { up, focus, looks_inward }
}

/// d·dᵀ.
fn outer(d: DVec3) -> DMat3 {
    DMat3::from_cols(d * d.x, d * d.y, d * d.z)
}

/// The normal of the plane through the origin in which directions lie, if they lie in one and not on a line.
fn flat(directions: impl Iterator<Item = DVec3> + Clone) -> Option<DVec3> {
    let scatter = directions.map(outer).fold(DMat3::ZERO, |sum, part| sum + part);
    let total = scatter.x_axis.x + scatter.y_axis.y + scatter.z_axis.z;
    // Powers of a matrix turn a vector to the axis along which there is most, and those of the inverse to the
    // one along which there is least.
    let axis = |matrix: DMat3| {
        (0..64).try_fold(DVec3::new(0.36, 0.48, 0.8), |axis, _| (matrix * axis).try_normalize())
    };
    let along = |axis: DVec3| axis.dot(scatter * axis) / total;
    let normal = axis((scatter + DMat3::IDENTITY * (1e-9 * total)).inverse())?;
    let longest = axis(scatter)?;
    let across = 1.0 - along(normal) - along(longest);
    (along(normal) < FLAT && across > LINE).then_some(normal)
}

/// Once around: about what the cameras look at, at their mean height and distance. Where they look away
/// from each other, as in a room seen from its middle, once around there, looking outward.
///
/// # Panics
/// Without cameras.
#[must_use]
pub fn orbit(cameras: &[Camera]) -> Flight {
    let rig = Rig::of(cameras);
    let level = |v: DVec3| v - rig.up * v.dot(rig.up);
    let middle = if rig.looks_inward { rig.focus } else { rig.centre };
    let offsets = cameras.iter().map(|camera| camera.centre() - middle);
    let (distance, height) = offsets
        .map(|offset| (level(offset).length(), offset.dot(rig.up)))
        .fold((0.0, 0.0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
    let count = cameras.len() as f64;
    let (distance, height) = (distance / count, height / count);
    let ahead = level(rig.forward).normalize_or(rig.up.any_orthonormal_vector());
    let aside = rig.up.cross(ahead);
    let key = |i: u32| {
        let angle = TAU * f64::from(i) / f64::from(KEYS);
        let away = -ahead * angle.cos() + aside * angle.sin();
        let centre = middle + away * distance + rig.up * height;
        let target = if rig.looks_inward { rig.focus } else { centre + away };
        Key::looking_at(centre, target, rig.up, rig.fov_y)
    };
    Flight { keys: (0..KEYS).map(key).collect(), is_loop: true }
}

/// Two turns of a spiral about the middle of the cameras, as far as nine tenths of them reach, looking at
/// what they look at (*Local Light Field Fusion*, Mildenhall et al. 2019).
///
/// # Panics
/// Without cameras.
#[must_use]
pub fn spiral(cameras: &[Camera]) -> Flight {
    let rig = Rig::of(cameras);
    let right = rig.forward.cross(rig.up).normalize_or(rig.forward.any_orthonormal_vector());
    let down = rig.forward.cross(right);
    let reach = |axis: DVec3| {
        let mut along: Vec<f64> =
            cameras.iter().map(|camera| (camera.centre() - rig.centre).dot(axis).abs()).collect();
        along.sort_by(f64::total_cmp);
        along[((along.len() - 1) as f64 * WITHIN).round() as usize]
    };
    let reaches = [right, down, rig.forward].map(reach);
    let distance = (rig.focus - rig.centre).dot(rig.forward);
    // Where there is no common point ahead, one well beyond the cameras.
    let distance = if distance > reaches[2] {
        distance
    } else {
        4.0 * reaches.into_iter().fold(0.25, f64::max)
    };
    let target = rig.centre + rig.forward * distance;
    let key = |i: u32| {
        let angle = TAU * TURNS * f64::from(i) / f64::from(KEYS);
        let centre = rig.centre
            + right * (reaches[0] * angle.cos())
            + down * (reaches[1] * angle.sin())
            + rig.forward * (reaches[2] * (0.5 * angle).sin());
        Key::looking_at(centre, target, rig.up, rig.fov_y)
    };
    Flight { keys: (0..KEYS).map(key).collect(), is_loop: true }
}
