//! COLMAP's camera models by number and name, converted to lenses.

use std::path::Path;

use glam::DVec2;

use super::super::error::DatasetError;
use super::super::pose::check_lens;
use super::super::undistort::Lens;
use super::REMEDY;

/// Names by model id (COLMAP, `sensor/models.h`).
const MODELS: [&str; 12] = [
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
];
/// Of those that are supported, the number of focal lengths and of distortion terms.
const PARAMETERS: [(usize, usize); 5] = [(1, 0), (2, 0), (1, 1), (1, 2), (2, 4)];

/// A supported model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Model {
    focals: usize,
    terms: usize,
}

impl Model {
    pub(super) fn from_id(file: &Path, camera: &str, id: i32) -> Result<Self, DatasetError> {
        let known = usize::try_from(id).ok().and_then(|id| MODELS.get(id));
        match known {
            Some(name) => Self::from_name(file, camera, name),
            None => Self::from_name(file, camera, &format!("number {id}")),
        }
    }

    pub(super) fn from_name(file: &Path, camera: &str, name: &str) -> Result<Self, DatasetError> {
        let supported = MODELS.iter().zip(PARAMETERS).find(|(known, _)| **known == name);
        let (_, (focals, terms)) = supported.ok_or_else(|| {
            let all = "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL and OPENCV";
            let problem = format!("the camera model {name} is not one of {all}");
            DatasetError::lens(file, camera, problem)
        })?;
        Ok(Self { focals, terms })
    }

    /// The lens of a camera of this size, checked. `next` reads its parameters, one after the other.
    pub(super) fn lens(
        self,
        file: &Path,
        camera: &str,
        [width, height]: [u64; 2],
        mut next: impl FnMut() -> Result<f64, DatasetError>,
    ) -> Result<Lens, DatasetError> {
        let side = |side: u64| u32::try_from(side).ok().filter(|&side| side > 0);
        let (Some(width), Some(height)) = (side(width), side(height)) else {
            let problem = format!("the size {width}x{height} px is impossible");
            return Err(DatasetError::malformed(file, camera, problem, REMEDY));
        };
        let fx = next()?;
        let fy = if self.focals == 2 { next()? } else { fx };
        let (focal, principal) = (DVec2::new(fx, fy), DVec2::new(next()?, next()?));
        let mut distortion = [0.0; 4];
        for term in &mut distortion[..self.terms] {
            *term = next()?;
        }
        let lens = Lens { width, height, focal, principal, distortion };
        check_lens(file, camera, &lens)?;
        Ok(lens)
    }
}
