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
/// Name of the pinhole whose k4 to k6 are OpenCV's.
const RATIONAL: &str = "FULL_OPENCV";

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
        if !is_fisheye && named != Some(RATIONAL) {
            self.check_k4()?;
        }
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

    /// Refuses a k4 of a pinhole that may be nerfstudio's: there it is the coefficient of r⁸, in OpenCV that of r² in
    /// the denominator. Only OpenCV has k5 and k6.
    fn check_k4(&self) -> Result<(), LoadError> {
        let [k4, k5, k6] = ["k4", "k5", "k6"].map(|field| self.number(field));
        let (k4, k5, k6) = (k4?.unwrap_or(0.0), k5?.unwrap_or(0.0), k6?.unwrap_or(0.0));
        if k4 == 0.0 || k5 != 0.0 || k6 != 0.0 {
            return Ok(());
        }
        let problem = format!(
            "k4 = {k4} has two meanings: in OpenCV it divides by 1 + k4 r², in nerfstudio and Metashape it adds k4 r⁸"
        );
        let remedy = "if it is OpenCV's, set `camera_model` to FULL_OPENCV; else calibrate without k4, or undistort \
                      the images first";
        Err(LoadError::malformed(self.path, self.full("k4"), problem, remedy))
    }
}
