//! The pose of a frame, which is a matrix.

use glam::{DMat3, DVec3};
use serde_json::Value;

use super::super::LoadError;
use super::super::pose::{ROTATION_TOLERANCE, checked_pose};
use super::fields::Fields;

/// Fourth row of every pose.
const LAST_ROW: [f64; 4] = [0.0, 0.0, 0.0, 1.0];
/// Accepted deviation of entries of the fourth row, which programs write in single precision.
const TOLERANCE: f64 = 1e-6;

impl Fields<'_> {
    /// The pose `camera_from_world`, with OpenCV axes.
    pub(super) fn pose(&self, file: &str) -> Result<(DMat3, DVec3), LoadError> {
        const FIELD: &str = "transform_matrix";
        let shape = || self.fault(FIELD, "it is not a matrix of 3 or 4 rows of 4 numbers");
        let rows = self.own(FIELD).and_then(Value::as_array).ok_or_else(shape)?;
        let mut m = [[0.0; 4], [0.0; 4], [0.0; 4], LAST_ROW];
        if !(3..=4).contains(&rows.len()) {
            return Err(shape());
        }
        for (row, values) in m.iter_mut().zip(rows) {
            let values = values.as_array().filter(|values| values.len() == 4).ok_or_else(shape)?;
            for (entry, value) in row.iter_mut().zip(values) {
                *entry = value.as_f64().ok_or_else(shape)?;
            }
        }
        let is_last = |row: [f64; 4]| {
            row.iter().zip(LAST_ROW).all(|(entry, expected)| (entry - expected).abs() <= TOLERANCE)
        };
        if !is_last(m[3]) {
            return Err(if is_last([m[0][3], m[1][3], m[2][3], m[3][3]]) {
                self.fault(FIELD, "the matrix is transposed: its fourth row has the translation")
            } else {
                self.fault(FIELD, format!("its fourth row is {:?} instead of {LAST_ROW:?}", m[3]))
            });
        }
        // In OpenCV, y and z point the opposite way.
        let column = |j: usize| DVec3::new(m[0][j], m[1][j], m[2][j]);
        let world_from_camera = DMat3::from_cols(column(0), -column(1), -column(2));
        // Axes that are all scaled alike, as those of a scaled camera in Blender, show every point in the same pixel as
        // without the scale.
        let scale = world_from_camera.determinant().abs().cbrt();
        let is_scaled = scale.is_normal() && (scale * scale - 1.0).abs() > ROTATION_TOLERANCE;
        let world_from_camera =
            if is_scaled { world_from_camera * scale.recip() } else { world_from_camera };
        let frame = format!("{} ({file})", self.full(FIELD));
        let (rotation, centre) =
            checked_pose(self.path, &frame, world_from_camera.transpose(), column(3))?;
        Ok((rotation, -(rotation * centre)))
    }
}
