//! COLMAP's camera models by number and name, converted to lenses.

use std::path::Path;

use glam::DVec2;

use super::super::error::DatasetError;
use super::super::undistort::Lens;

/// Name and number of parameters, by model id (COLMAP, `sensor/models.h`).
const MODELS: [(&str, usize); 12] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
];

const SUPPORTED: &str = "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL and OPENCV";

/// A supported model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Model(usize);

impl Model {
    pub(super) fn from_id(file: &Path, camera: &str, id: i32) -> Result<Self, DatasetError> {
        let known = usize::try_from(id).ok().filter(|&id| id < MODELS.len());
        match known {
            Some(id) => Self::from_name(file, camera, MODELS[id].0),
            None => Self::from_name(file, camera, &format!("number {id}")),
        }
    }

    pub(super) fn from_name(file: &Path, camera: &str, name: &str) -> Result<Self, DatasetError> {
        match MODELS[..5].iter().position(|(known, _)| *known == name) {
            Some(id) => Ok(Self(id)),
            None => {
                let problem = format!("the camera model {name} is not one of {SUPPORTED}");
                Err(DatasetError::lens(file, camera, problem))
            }
        }
    }

    /// Number of parameters.
    pub(super) fn parameters(self) -> usize {
        MODELS[self.0].1
    }

    /// The lens with these parameters, of which there are [`Self::parameters`].
    pub(super) fn lens(self, width: u32, height: u32, parameters: &[f64]) -> Option<Lens> {
        let (focal, principal, distortion) = match (self.0, parameters) {
            (0, &[f, cx, cy]) => ((f, f), (cx, cy), [0.0; 4]),
            (1, &[fx, fy, cx, cy]) => ((fx, fy), (cx, cy), [0.0; 4]),
            (2, &[f, cx, cy, k]) => ((f, f), (cx, cy), [k, 0.0, 0.0, 0.0]),
            (3, &[f, cx, cy, k1, k2]) => ((f, f), (cx, cy), [k1, k2, 0.0, 0.0]),
            (4, &[fx, fy, cx, cy, k1, k2, p1, p2]) => ((fx, fy), (cx, cy), [k1, k2, p1, p2]),
            _ => return None,
        };
        let (focal, principal) = (DVec2::from(focal), DVec2::from(principal));
        Some(Lens { width, height, focal, principal, distortion })
    }
}
