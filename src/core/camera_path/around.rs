//! Camera paths computed from the cameras of a dataset.

use std::f64::consts::TAU;

use glam::{DMat3, DVec3};

use super::{CameraPath, Keyframe};
use crate::camera::Camera;

/// Number of keyframes of a path.
const KEYFRAMES: u32 = 48;
/// Number of turns of a spiral.
const TURNS: f64 = 2.0;
/// Unit vectors count as coplanar if the mean square of their components normal to the plane is less than this, which
/// allows a root mean square roll of 13°.
const MAX_NORMAL_FRACTION: f64 = 0.05;
/// Coplanar unit vectors count as collinear if the mean square of their components along the minor axis of their
/// distribution in the plane is at most this.
const MAX_LINE_FRACTION: f64 = 0.1;
/// The quantile of the cameras' offsets from their centre, along an axis, that is the radius of a spiral on this axis.
const REACH_QUANTILE: f64 = 0.9;

/// Common properties of a set of cameras.
struct Rig {
    /// Mean position.
    centre: DVec3,
    /// Mean viewing direction, unit length.
    forward: DVec3,
    /// Common up direction, unit length.
    up: DVec3,
    /// The point nearest to all lines of sight.
    focus: DVec3,
    /// True if most cameras have the focus in front of them.
    looks_inward: bool,
    /// Median vertical field of view `[rad]`.
    fov_y: f64,
}

impl Rig {
    /// Computes the common properties of `cameras`, which must not be empty.
    fn new(cameras: &[Camera]) -> Self {
        let mean = |vector: &dyn Fn(&Camera) -> DVec3| {
            cameras.iter().map(vector).sum::<DVec3>() / cameras.len() as f64
        };
        let centre = mean(&Camera::centre);
        let forward = mean(&Camera::forward).normalize_or(cameras[0].forward());
        let up = mean(&|camera| -camera.rotation.row(1)).normalize_or(-cameras[0].rotation.row(1));
        // The point x nearest to all lines of sight (camera centre c, direction f) solves Σ (I − ffᵀ)(x − c) = 0. A
        // small weight on the mean position keeps the system solvable when all cameras look the same way.
        let (mut matrix, mut rhs) = (DMat3::IDENTITY * 1e-9, centre * 1e-9);
        for camera in cameras {
            let f = camera.forward();
            let across = DMat3::IDENTITY - outer(f);
            matrix += across;
            rhs += across * camera.centre();
        }
        let focus = matrix.inverse() * rhs;
        let ahead = |camera: &&Camera| (focus - camera.centre()).dot(camera.forward()) > 0.0;
        let looks_inward = 2 * cameras.iter().filter(ahead).count() > cameras.len();
        // In upright photographs the x axis is level; with the camera on its side, the y axis is.
        let level =
            [0, 1].map(|axis| plane_normal(cameras.iter().map(move |c| c.rotation.row(axis))));
        let up = level[0].or(level[1]).map_or(up, |normal| {
            // The axes of a camera on its side do not show which way is up, but cameras are mostly above their subject.
            let roughly_up = if level[0].is_some() { up } else { centre - focus };
            if normal.dot(roughly_up) < 0.0 { -normal } else { normal }
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

/// The common orientation of a set of cameras.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orientation {
    /// The up direction, unit length.
    pub up: DVec3,
    /// The point nearest to all lines of sight.
    pub focus: DVec3,
    /// True if most cameras have the focus in front of them.
    pub looks_inward: bool,
}

/// Estimates the common orientation of cameras.
///
/// # Panics
/// If there are no cameras.
pub fn orientation(cameras: &[Camera]) -> Orientation {
    let Rig { up, focus, looks_inward, .. } = Rig::new(cameras);
    Orientation { up, focus, looks_inward }
}

/// The outer product d·dᵀ.
fn outer(d: DVec3) -> DMat3 {
    DMat3::from_cols(d * d.x, d * d.y, d * d.z)
}

/// The normal of the plane through the origin that contains the directions; `None` unless they are coplanar and not
/// collinear.
fn plane_normal(directions: impl Iterator<Item = DVec3> + Clone) -> Option<DVec3> {
    let scatter = directions.map(outer).fold(DMat3::ZERO, |sum, part| sum + part);
    let total = scatter.x_axis.x + scatter.y_axis.y + scatter.z_axis.z;
    // Power iteration finds a matrix's longest axis; with the inverse matrix, it finds the shortest.
    let axis = |matrix: DMat3| {
        (0..64).try_fold(DVec3::new(0.36, 0.48, 0.8), |axis, _| (matrix * axis).try_normalize())
    };
    let along = |axis: DVec3| axis.dot(scatter * axis) / total;
    let normal = axis((scatter + DMat3::IDENTITY * (1e-9 * total)).inverse())?;
    let longest = axis(scatter)?;
    let second = 1.0 - along(normal) - along(longest);
    (along(normal) < MAX_NORMAL_FRACTION && second > MAX_LINE_FRACTION).then_some(normal)
}

/// A circle around the cameras' focus at their mean height and distance. If the cameras look outward, as in a room seen
/// from its middle, the path is a circle around their centre and also looks outward.
///
/// # Panics
/// If there are no cameras.
pub fn orbit(cameras: &[Camera]) -> CameraPath {
    let rig = Rig::new(cameras);
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
    let keyframe = |i: u32| {
        let angle = TAU * f64::from(i) / f64::from(KEYFRAMES);
        let away = -ahead * angle.cos() + aside * angle.sin();
        let centre = middle + away * distance + rig.up * height;
        let target = if rig.looks_inward { rig.focus } else { centre + away };
        Keyframe::looking_at(centre, target, rig.up, rig.fov_y)
    };
    CameraPath { keyframes: (0..KEYFRAMES).map(keyframe).collect(), is_loop: true }
}

/// A spiral of two turns around the centre of the cameras, looking at their focus. Its radii are the 90 % quantiles of
/// the cameras' offsets from the centre (*Local Light Field Fusion*, Mildenhall et al. 2019).
///
/// # Panics
/// If there are no cameras.
pub fn spiral(cameras: &[Camera]) -> CameraPath {
    let rig = Rig::new(cameras);
    let right = rig.forward.cross(rig.up).normalize_or(rig.forward.any_orthonormal_vector());
    let down = rig.forward.cross(right);
    let radius_along = |axis: DVec3| {
        let mut along: Vec<f64> =
            cameras.iter().map(|camera| (camera.centre() - rig.centre).dot(axis).abs()).collect();
        along.sort_by(f64::total_cmp);
        along[((along.len() - 1) as f64 * REACH_QUANTILE).round() as usize]
    };
    let radii = [right, down, rig.forward].map(radius_along);
    let distance = (rig.focus - rig.centre).dot(rig.forward);
    // If the focus is not ahead of the cameras, the path looks at a point well in front of them.
    let distance =
        if distance > radii[2] { distance } else { 4.0 * radii.into_iter().fold(0.25, f64::max) };
    let target = rig.centre + rig.forward * distance;
    let keyframe = |i: u32| {
        let angle = TAU * TURNS * f64::from(i) / f64::from(KEYFRAMES);
        let centre = rig.centre
            + right * (radii[0] * angle.cos())
            + down * (radii[1] * angle.sin())
            + rig.forward * (radii[2] * (0.5 * angle).sin());
        Keyframe::looking_at(centre, target, rig.up, rig.fov_y)
    };
    CameraPath { keyframes: (0..KEYFRAMES).map(keyframe).collect(), is_loop: true }
}
