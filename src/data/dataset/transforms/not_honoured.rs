//! Fields that change the cameras or the pictures in nerfstudio or instant-ngp, but not here.
//!
//! Those that would spoil the model are refused, the others noted.

use serde_json::Value;

use super::super::LoadError;
use super::DeclaredSplit;
use super::fields::Fields;
use super::lens::supported_models;

/// Fields of instant-ngp that mark panoramas.
const PANORAMAS: [&str; 2] = ["equirectangular", "latlong"];
/// Fields that are refused, with the problem and the remedy.
const REFUSED: [(&[&str], &str, &str); 3] = [
    (
        &["ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4"],
        "f-theta lenses are not supported",
        "estimate the cameras again with a fisheye model, or undistort the images first",
    ),
    (
        &["white_transparent"],
        "white pixels are not made transparent",
        "make them transparent in the images, and remove the field",
    ),
    (
        &["black_transparent"],
        "black pixels are not made transparent",
        "make them transparent in the images, and remove the field",
    ),
];
/// Fields that are noted, with what is lost.
const NOTED: [(&str, &str); 4] = [
    ("rolling_shutter", "each image has one pose"),
    ("transform_matrix_end", "each image has one pose"),
    ("sharpness_discard_threshold", "blurred images are read, too"),
    ("sharpen", "images are not sharpened"),
];

impl Fields<'_> {
    /// Refuses fields without which the model would be spoiled.
    pub(super) fn check_honoured(&self) -> Result<(), LoadError> {
        let is_set = |field: &&&str| self.inherited(field).is_some_and(is_set);
        if let Some(field) = PANORAMAS.iter().find(is_set) {
            let (field, supported) = (self.full(field), supported_models());
            return Err(LoadError::lens_model(self.path, &field, "EQUIRECTANGULAR", &supported));
        }
        for (fields, problem, remedy) in REFUSED {
            if let Some(field) = fields.iter().find(is_set) {
                return Err(LoadError::malformed(self.path, self.full(field), problem, remedy));
            }
        }
        Ok(())
    }

    /// Notes about fields of the top level or of a frame that are not honoured.
    pub(super) fn notes(&self, listed: &[(Self, DeclaredSplit)]) -> Result<Vec<String>, LoadError> {
        let name = self.path.file_name().unwrap_or_default().display();
        let is_used = |field: &str| {
            let is_set = |level: &Self| level.own(field).is_some_and(is_set);
            is_set(self) || listed.iter().any(|(frame, _)| is_set(frame))
        };
        let used = NOTED.iter().filter(|(field, _)| is_used(field));
        let mut notes: Vec<String> =
            used.map(|(field, lost)| format!("{name}: {field} is not honoured: {lost}")).collect();
        if let Some(count) = self.number("n_frames")?
            && count < listed.len() as f64
        {
            let all = listed.len();
            notes.push(format!(
                "{name}: n_frames = {count} is not honoured: all {all} frames are read"
            ));
        }
        Ok(notes)
    }
}

/// Returns true unless a value is false, 0, null, or made up of such values.
fn is_set(value: &Value) -> bool {
    match value {
        Value::Null => false,
        Value::Bool(value) => *value,
        Value::Number(number) => number.as_f64() != Some(0.0),
        Value::Array(values) => values.iter().any(is_set),
        Value::String(_) | Value::Object(_) => true,
    }
}
