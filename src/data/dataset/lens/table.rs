//! The table of lens models: by which names files call them, and what their parameters are.

use std::path::Path;

use super::{Distortion, Plane};
use crate::dataset::DatasetError;

/// A parameter after focal lengths and principal point.
#[derive(Debug, Clone, Copy)]
pub(in crate::dataset) enum Term {
    /// Coefficient of r², r⁴, r⁶, r⁸ in the numerator of the radial factor, by place.
    Radial(usize),
    /// The same of r², r⁴, r⁶ in the denominator.
    Denominator(usize),
    /// p1, p2.
    Tangential(usize),
    /// The shifts of a thin prism along x and y.
    Prism(usize),
    /// The angle ω of the FOV model `[rad]`.
    Omega,
}

/// A lens model.
#[derive(Debug)]
pub(in crate::dataset) struct LensModel {
    pub(in crate::dataset) name: &'static str,
    /// Number of focal lengths, 1 or 2.
    pub(in crate::dataset) focals: usize,
    pub(in crate::dataset) plane: Plane,
    /// Its terms in the order of COLMAP's files.
    pub(in crate::dataset) terms: &'static [Term],
}

use Plane::{Equidistant, Perspective};
use Term::{Denominator as B, Omega, Prism as S, Radial as A, Tangential as P};

const fn model(
    name: &'static str,
    focals: usize,
    plane: Plane,
    terms: &'static [Term],
) -> LensModel {
    LensModel { name, focals, plane, terms }
}

/// The models that can be read, by COLMAP's number (COLMAP, `sensor/models.h`).
pub(in crate::dataset) const MODELS: [LensModel; 11] = [
    model("SIMPLE_PINHOLE", 1, Perspective, &[]),
    model("PINHOLE", 2, Perspective, &[]),
    model("SIMPLE_RADIAL", 1, Perspective, &[A(0)]),
    model("RADIAL", 1, Perspective, &[A(0), A(1)]),
    model("OPENCV", 2, Perspective, &[A(0), A(1), P(0), P(1)]),
    model("OPENCV_FISHEYE", 2, Equidistant, &[A(0), A(1), A(2), A(3)]),
    model("FULL_OPENCV", 2, Perspective, &[A(0), A(1), P(0), P(1), A(2), B(0), B(1), B(2)]),
    model("FOV", 2, Perspective, &[Omega]),
    model("SIMPLE_RADIAL_FISHEYE", 1, Equidistant, &[A(0)]),
    model("RADIAL_FISHEYE", 1, Equidistant, &[A(0), A(1)]),
    model("THIN_PRISM_FISHEYE", 2, Equidistant, &[A(0), A(1), P(0), P(1), A(2), A(3), S(0), S(1)]),
];

/// The fields of nerfstudio's and instant-ngp's files for a pinhole: OpenCV's terms under OpenCV's names.
pub(in crate::dataset) const OPENCV_FIELDS: [(&str, Term); 8] = [
    ("k1", A(0)),
    ("k2", A(1)),
    ("p1", P(0)),
    ("p2", P(1)),
    ("k3", A(2)),
    ("k4", B(0)),
    ("k5", B(1)),
    ("k6", B(2)),
];
/// The same for a fisheye.
pub(in crate::dataset) const FISHEYE_FIELDS: [(&str, Term); 4] =
    [("k1", A(0)), ("k2", A(1)), ("k3", A(2)), ("k4", A(3))];

impl LensModel {
    /// The model of this name in COLMAP's files.
    pub(in crate::dataset) fn named(
        file: &Path,
        camera: &str,
        name: &str,
    ) -> Result<&'static Self, DatasetError> {
        MODELS.iter().find(|model| model.name == name).ok_or_else(|| {
            let all = MODELS.map(|model| model.name).join(", ");
            let problem = format!("the camera model {name} is not one of {all}");
            DatasetError::lens(file, camera, problem)
        })
    }

    /// The model of this number in COLMAP's files.
    pub(in crate::dataset) fn numbered(
        file: &Path,
        camera: &str,
        number: i32,
    ) -> Result<&'static Self, DatasetError> {
        match usize::try_from(number).ok().and_then(|number| MODELS.get(number)) {
            Some(model) => Ok(model),
            None if number == 11 => Self::named(file, camera, "RAD_TAN_THIN_PRISM_FISHEYE"),
            None => Self::named(file, camera, &format!("number {number}")),
        }
    }
}

impl Distortion {
    /// Sets one of its terms.
    pub(in crate::dataset) fn set(&mut self, term: Term, value: f64) {
        match term {
            A(place) => self.radial[place] = value,
            B(place) => self.denominator[place] = value,
            P(place) => self.tangential[place] = value,
            S(place) => self.prism[place] = value,
            // At 0 the model is a pinhole.
            Omega if value == 0.0 => {}
            Omega => self.plane = Plane::Fov(value),
        }
    }
}
