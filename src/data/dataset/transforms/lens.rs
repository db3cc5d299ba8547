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

/// The names of all supported camera models, for messages.
pub(super) fn supported_models() -> String {
    format!("{}, {FISHEYE}", PINHOLES.join(", "))
}

/// Fields that state the horizontal focal length, in order of precedence: `[px]`, `[degrees]`, `[rad]`.
const FOCAL_X: [&str; 3] = ["fl_x", "x_fov", "camera_angle_x"];
/// Fields that state the vertical focal length, as in [`FOCAL_X`].
const FOCAL_Y: [&str; 3] = ["fl_y", "y_fov", "camera_angle_y"];

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
        let focal = self.focal((width, height))?;
        let cx = self.number("cx")?.unwrap_or(0.5 * f64::from(width));
        let cy = self.number("cy")?.unwrap_or(0.5 * f64::from(height));
        let lens = Lens::new((width, height), focal, DVec2::new(cx, cy), distortion);
        check_lens(self.path, &self.full("intrinsics"), &lens)?;
        Ok((self.with_circle(lens)?, header))
    }

    /// The lens with the image circle that the file states.
    fn with_circle(&self, lens: Lens) -> Result<Lens, LoadError> {
        const FIELD: &str = "fisheye_crop_radius";
        let Some(radius) = self.number(FIELD)? else { return Ok(lens) };
        if lens.distortion.plane != Projection::Equidistant {
            let remedy = "remove it, and hide what lies outside of the circle by masks in `masks/`";
            let problem = "the lens is not a fisheye";
            return Err(LoadError::malformed(self.path, self.full(FIELD), problem, remedy));
        }
        if radius >= 1.0 {
            return Ok(lens.with_circle(radius));
        }
        Err(self.fault(FIELD, format!("{radius} px is less than 1 px")))
    }

    /// The focal lengths for an image of this size `[px]`. Those of the frame take precedence over those of the top
    /// level, however they are stated. A single one holds for both axes.
    fn focal(&self, (width, height): (u32, u32)) -> Result<DVec2, LoadError> {
        let top = Self { frame: None, place: String::new(), ..*self };
        let [own_x, top_x] = [self, &top].map(|level| level.own_focal(FOCAL_X, width));
        let [own_y, top_y] = [self, &top].map(|level| level.own_focal(FOCAL_Y, height));
        let (own_x, own_y, top_x, top_y) = (own_x?, own_y?, top_x?, top_y?);
        let x = own_x.or(top_x);
        // A frame that replaces the horizontal focal length alone replaces both.
        let y = own_y.or(if top_x.is_some() { own_x } else { None }).or(top_y);
        let problem = "no focal length: neither fl_x nor camera_angle_x is stated";
        let either = x.or(y).ok_or_else(|| self.fault(FOCAL_X[0], problem))?;
        Ok(DVec2::new(x.unwrap_or(either), y.unwrap_or(either)))
    }

    /// The focal length that the frame itself, or the top level, states in one of these fields: `[px]`, as a field of
    /// view `[degrees]`, or as one `[rad]`.
    fn own_focal(
        &self,
        [length, degrees, radians]: [&str; 3],
        side: u32,
    ) -> Result<Option<f64>, LoadError> {
        let number = |field: &str| match self.own(field) {
            None => Ok(None),
            Some(_) => self.number(field),
        };
        let from_angle = |angle: f64| 0.5 * f64::from(side) / (0.5 * angle).tan();
        if let length @ Some(_) = number(length)? {
            return Ok(length);
        }
        let angle = match number(degrees)? {
            Some(angle) => Some(angle.to_radians()),
            None => number(radians)?,
        };
        Ok(angle.map(from_angle))
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
            let (field, supported) = (self.full("camera_model"), supported_models());
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
