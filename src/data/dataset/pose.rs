//! Checks poses and intrinsics from data files.

use std::path::Path;

use glam::{DMat3, DVec3};

use super::LoadError;
use super::lens::{Lens, Projection};

/// Accepted fields of view of pinhole cameras `[degrees]`.
const FIELD_OF_VIEW: std::ops::RangeInclusive<f64> = 0.5..=160.0;

/// Largest accepted field of view of a fisheye, computed without its distortion `[degrees]`. It exceeds 360 because the
/// corners of the image may lie outside the image circle.
const MAX_FISHEYE_FOV: f64 = 720.0;
/// Largest accepted |ω| of the FOV model `[rad]`; tan(ω/2) is then 20.
const MAX_OMEGA: f64 = 3.04;

/// Largest accepted entry of |RᵀR − I|; smaller deviations are corrected.
pub(super) const ROTATION_TOLERANCE: f64 = 1e-3;

pub(super) const POSE_REMEDY: &str = "repair the pose or remove the frame";

/// Checks a pose `camera_from_world` and makes its rotation orthonormal.
pub(super) fn checked_pose(
    file: &Path,
    frame: &str,
    rotation: DMat3,
    translation: DVec3,
) -> Result<(DMat3, DVec3), LoadError> {
    let fault = |problem: String| Err(LoadError::malformed(file, frame, problem, POSE_REMEDY));
    if !rotation.is_finite() || !translation.is_finite() {
        return fault("the pose is not finite".into());
    }
    let error = (rotation.transpose() * rotation - DMat3::IDENTITY).to_cols_array();
    let error = error.iter().fold(0.0, |largest: f64, e| largest.max(e.abs()));
    if error > ROTATION_TOLERANCE {
        return fault(format!(
            "the rotation is not orthonormal: |RᵀR − I| = {error:.3e} > {ROTATION_TOLERANCE:e}"
        ));
    }
    if rotation.determinant() < 0.0 {
        return fault("the rotation is a reflection (determinant −1)".into());
    }
    // Newton–Schulz converges quadratically to the nearest rotation: 1e-3 → 1e-6 → 1e-12 → 1e-24.
    let mut r = rotation;
    for _ in 0..3 {
        r = r * (3.0 * DMat3::IDENTITY - r.transpose() * r) * 0.5;
    }
    Ok((r, translation))
}

/// Checks that a quaternion (w, x, y, z) has unit length, and returns its rotation.
pub(super) fn checked_quaternion(
    file: &Path,
    frame: &str,
    q: [f64; 4],
) -> Result<DMat3, LoadError> {
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    if !norm.is_finite() || (norm - 1.0).abs() > ROTATION_TOLERANCE {
        let problem = format!("the quaternion {q:?} has length {norm} instead of 1");
        return Err(LoadError::malformed(file, frame, problem, POSE_REMEDY));
    }
    let [w, x, y, z] = q.map(|v| v / norm);
    Ok(DMat3::from_quat(glam::DQuat::from_xyzw(x, y, z, w)))
}

/// Checks the parameters of a lens.
pub(super) fn check_lens(file: &Path, camera: &str, lens: &Lens) -> Result<(), LoadError> {
    let fault = |problem: String| {
        Err(LoadError::malformed(file, camera, problem, "repair the camera's parameters"))
    };
    let size = lens.size();
    if lens.width == 0 || lens.height == 0 {
        return fault(format!("the size {}x{} px is impossible", lens.width, lens.height));
    }
    for (name, focal) in [("fx", lens.focal.x), ("fy", lens.focal.y)] {
        if !focal.is_finite() || focal <= 0.0 {
            return fault(format!("the focal length {name} = {focal} is not above 0"));
        }
    }
    if !lens.is_finite() {
        return fault("the principal point or the distortion is not finite".into());
    }
    if let Projection::Fov(omega) = lens.distortion.plane
        && omega.abs() > MAX_OMEGA
    {
        return fault(format!("omega = {omega} is not within {MAX_OMEGA} of 0"));
    }
    for (name, focal, side) in [("fx", lens.focal.x, size.x), ("fy", lens.focal.y, size.y)] {
        let (half, max) = match lens.distortion.plane {
            Projection::Perspective => ((0.5 * side / focal).atan(), *FIELD_OF_VIEW.end()),
            Projection::Equidistant | Projection::Fov(_) => (0.5 * side / focal, MAX_FISHEYE_FOV),
        };
        let degrees = 2.0 * half.to_degrees();
        if !(*FIELD_OF_VIEW.start()..=max).contains(&degrees) {
            let hint = if degrees > max && lens.distortion.plane == Projection::Perspective {
                "; a lens this wide is a fisheye: use a fisheye model, or undistort its images to a pinhole"
            } else {
                ""
            };
            return fault(format!(
                "the focal length {name} = {focal} px at {side} px means a field of view of {degrees:.2} degrees, \
                 outside of {:?}{hint}",
                *FIELD_OF_VIEW.start()..=max
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::super::lens::Distortion;
    use super::*;

    #[test]
    fn a_slightly_skewed_rotation_is_repaired_and_a_skewed_one_refused() {
        let exact = DMat3::from_rotation_y(0.7) * DMat3::from_rotation_x(-0.2);
        let skew =
            |amount: f64| exact * DMat3::from_diagonal(DVec3::new(1.0 + amount, 1.0, 1.0 - amount));
        let check = |r| checked_pose(Path::new("f"), "frame 3", r, DVec3::ZERO);
        let (repaired, _) = check(skew(4e-4)).unwrap();
        let left = repaired.transpose() * repaired - DMat3::IDENTITY;
        assert!(left.to_cols_array().iter().all(|e| e.abs() < 1e-15), "{left}");
        assert!((repaired - exact).to_cols_array().iter().all(|e| e.abs() < 1e-6));
        for bad in [skew(1e-3), exact * -1.0, exact * 2.0, DMat3::ZERO, exact * f64::NAN] {
            let message = check(bad).unwrap_err().to_string();
            assert!(message.contains("frame 3"), "{message}");
        }
        assert!(
            checked_pose(Path::new("f"), "g", exact, DVec3::new(0.0, f64::INFINITY, 0.0)).is_err()
        );
    }

    #[test]
    fn fields_of_view_that_no_pinhole_has_are_refused() {
        let check = |degrees: f64| {
            let focal = 50.0 / (0.5 * degrees.to_radians()).tan();
            // A principal point outside the image is allowed.
            let principal = DVec2::new(-70.0, 130.0);
            let none = Distortion::none(Projection::Perspective);
            let lens = Lens::new((100, 100), DVec2::splat(focal), principal, none);
            check_lens(Path::new("f"), "camera 7", &lens)
        };
        for degrees in [0.51, 1.0, 120.0, 159.9] {
            assert!(check(degrees).is_ok(), "{degrees}");
        }
        for (degrees, word) in [(0.4, "field of view"), (175.0, "fisheye"), (180.0, "fisheye")] {
            let message = check(degrees).unwrap_err().to_string();
            assert!(message.contains(word) && message.contains("camera 7"), "{message}");
        }
    }
}
