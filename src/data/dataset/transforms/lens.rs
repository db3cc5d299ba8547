//! The intrinsics of a frame: image size, focal lengths, principal point and distortion.

use std::path::Path;

use glam::DVec2;
use serde_json::Value;

use super::super::LoadError;
use super::super::images::{self, ImageHeader};
use super::super::lens::models::{FISHEYE_FIELDS, OPENCV_FIELDS};
use super::super::lens::{Distortion, Lens, Projection};
use super::super::pose::check_lens;
use super::fields::Fields;

/// Names of camera models that are pinholes with OpenCV's distortion.
const PINHOLES: [&str; 7] = [
    "OPENCV",
    "FULL_OPENCV",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "RADIAL",
    "SIMPLE_RADIAL",
    "PERSPECTIVE",
];
/// Name of the camera model that is a fisheye with k1 to k4.
const FISHEYE: &str = "OPENCV_FISHEYE";

impl Fields<'_> {
    /// The image size that the intrinsics are for, if the file states it.
    fn size(&self) -> Result<Option<(u32, u32)>, LoadError> {
        Ok(self.side("w")?.zip(self.side("h")?))
    }

    /// The lens at the image size stated in the file. If none is stated, the lens has the size of the image, whose
    /// header is then returned as well.
    pub(super) fn lens(
        &self,
        image: &Path,
        reduced: Option<u32>,
    ) -> Result<(Lens, Option<ImageHeader>), LoadError> {
        let distortion = self.distortion()?;
        let ((width, height), header) = match self.size()? {
            Some(size) => (size, None),
            None => {
                // Without a stated size, the intrinsics are those of the image at full size.
                let header = images::read_header(image)?;
                let k = reduced.unwrap_or(1);
                ((header.width * k, header.height * k), Some(header))
            }
        };
        let from_angle = |side: u32, angle: f64| 0.5 * f64::from(side) / (0.5 * angle).tan();
        let fx = match (self.number("fl_x")?, self.number("camera_angle_x")?) {
            (Some(fx), _) => fx,
            (None, Some(angle)) => from_angle(width, angle),
            (None, None) => {
                return Err(self.fault("fl_x", "both fl_x and camera_angle_x are missing"));
            }
        };
        let fy = match (self.number("fl_y")?, self.number("camera_angle_y")?) {
            (Some(fy), _) => fy,
            (None, Some(angle)) if self.inherited("fl_x").is_none() => from_angle(height, angle),
            _ => fx,
        };
        let cx = self.number("cx")?.unwrap_or(0.5 * f64::from(width));
        let cy = self.number("cy")?.unwrap_or(0.5 * f64::from(height));
        let (focal, principal) = (DVec2::new(fx, fy), DVec2::new(cx, cy));
        let lens = Lens::new((width, height), focal, principal, distortion);
        check_lens(self.path, &self.full("intrinsics"), &lens)?;
        Ok((lens, header))
    }

    /// The lens model and its coefficients.
    fn distortion(&self) -> Result<Distortion, LoadError> {
        let named = match self.inherited("camera_model") {
            None => None,
            Some(Value::String(model)) => Some(model.as_str()),
            Some(_) => return Err(self.fault("camera_model", "it is not a string")),
        };
        let is_fisheye = self.flag("is_fisheye")? || named == Some(FISHEYE);
        if let Some(model) = named.filter(|model| *model != FISHEYE && !PINHOLES.contains(model)) {
            let supported = format!("{}, {FISHEYE}", PINHOLES.join(", "));
            let field = self.full("camera_model");
            return Err(LoadError::lens_model(self.path, &field, model, &supported));
        }
        let (plane, fields) = if is_fisheye {
            (Projection::Equidistant, &FISHEYE_FIELDS[..])
        } else {
            (Projection::Perspective, &OPENCV_FIELDS[..])
        };
        let mut distortion = Distortion::none(plane);
        for (field, _) in OPENCV_FIELDS {
            let value = self.number(field)?.unwrap_or(0.0);
            match fields.iter().find(|(name, _)| *name == field) {
                Some(&(_, term)) => distortion.set(term, value),
                // nerfstudio writes all fields, with zeros for those that the model does not have.
                None if value == 0.0 => {}
                None => {
                    let problem = format!("{field} = {value}, but a fisheye has only k1 to k4");
                    return Err(LoadError::lens(self.path, &self.full(field), problem));
                }
            }
        }
        Ok(distortion)
    }
}
