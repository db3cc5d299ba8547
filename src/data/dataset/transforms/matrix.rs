//! The pose of a frame, which is a matrix.

use glam::{DMat3, DVec3};
use serde_json::Value;

use super::super::LoadError;
use super::super::pose::checked_pose;
use super::fields::Fields;

impl Fields<'_> {
    /// The pose `camera_from_world`, with OpenCV axes.
    pub(super) fn pose(&self, file: &str) -> Result<(DMat3, DVec3), LoadError> {
        const FIELD: &str = "transform_matrix";
        let shape = || self.fault(FIELD, "it is not a matrix of 3 or 4 rows of 4 numbers");
        let rows = self.own(FIELD).and_then(Value::as_array).ok_or_else(shape)?;
        let mut m = [[0.0; 4]; 3];
        if !(3..=4).contains(&rows.len()) {
            return Err(shape());
        }
        for (row, values) in m.iter_mut().zip(rows) {
            let values = values.as_array().filter(|values| values.len() == 4).ok_or_else(shape)?;
            for (entry, value) in row.iter_mut().zip(values) {
                *entry = value.as_f64().ok_or_else(shape)?;
            }
        }
        // In OpenCV, y and z point the opposite way.
        let column = |j: usize| DVec3::new(m[0][j], m[1][j], m[2][j]);
        let world_from_camera = DMat3::from_cols(column(0), -column(1), -column(2));
        let frame = format!("{} ({file})", self.full(FIELD));
        let (rotation, centre) =
            checked_pose(self.path, &frame, world_from_camera.transpose(), column(3))?;
        Ok((rotation, -(rotation * centre)))
    }
}
