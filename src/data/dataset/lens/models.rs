//! The table of lens models: their names in files and their parameters.

use std::path::Path;

use super::{Distortion, Projection};
use crate::dataset::LoadError;

/// A parameter that follows the focal lengths and the principal point.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Term {
    /// Coefficient of r², r⁴, r⁶ or r⁸ in the numerator of the radial factor, by index.
    Radial(usize),
    /// Coefficient of r², r⁴ or r⁶ in the denominator, by index.
    Denominator(usize),
    /// p₁ or p₂, by index.
    Tangential(usize),
    /// Shift of the thin prism along x or y, by index.
    Prism(usize),
    /// The angle ω of the FOV model `[rad]`.
    Omega,
}

/// A lens model.
#[derive(Debug)]
pub(crate) struct LensModel {
    pub(crate) name: &'static str,
    /// Number of focal lengths, 1 or 2.
    pub(crate) focals: usize,
    pub(crate) plane: Projection,
    /// Terms in the order of COLMAP's files.
    pub(crate) terms: &'static [Term],
}

use Projection::{Equidistant, Perspective};
use Term::{Denominator as B, Omega, Prism as S, Radial as A, Tangential as P};

const fn model(
    name: &'static str,
    focals: usize,
    plane: Projection,
    terms: &'static [Term],
) -> LensModel {
    LensModel { name, focals, plane, terms }
}

/// The supported models; the index is COLMAP's model number (COLMAP, `sensor/models.h`).
pub(crate) const MODELS: [LensModel; 11] = [
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

/// Unsupported models, whose numbers follow those of [`MODELS`] (COLMAP 4, `sensor/models.h`).
const UNSUPPORTED: [&str; 7] = [
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
];

/// Distortion fields of nerfstudio's and instant-ngp's pinholes: OpenCV's terms, with OpenCV's names.
pub(crate) const OPENCV_FIELDS: [(&str, Term); 8] = [
    ("k1", A(0)),
    ("k2", A(1)),
    ("p1", P(0)),
    ("p2", P(1)),
    ("k3", A(2)),
    ("k4", B(0)),
    ("k5", B(1)),
    ("k6", B(2)),
];
/// Distortion fields of nerfstudio's and instant-ngp's fisheyes.
pub(crate) const FISHEYE_FIELDS: [(&str, Term); 4] =
    [("k1", A(0)), ("k2", A(1)), ("k3", A(2)), ("k4", A(3))];

impl LensModel {
    /// Number of parameters: focal lengths, the principal point and the distortion.
    pub(crate) fn parameters(&self) -> usize {
        self.focals + 2 + self.terms.len()
    }

    /// The model with this name in COLMAP's text files.
    pub(crate) fn named(file: &Path, camera: &str, name: &str) -> Result<&'static Self, LoadError> {
        MODELS.iter().find(|model| model.name == name).ok_or_else(|| {
            LoadError::lens_model(file, camera, name, &MODELS.map(|model| model.name).join(", "))
        })
    }

    /// The model with this number in COLMAP's binary files.
    pub(crate) fn numbered(
        file: &Path,
        camera: &str,
        number: i32,
    ) -> Result<&'static Self, LoadError> {
        let mut names = MODELS.iter().map(|model| model.name).chain(UNSUPPORTED);
        match usize::try_from(number).ok().and_then(|number| names.nth(number)) {
            Some(name) => Self::named(file, camera, name),
            None => Self::named(file, camera, &format!("number {number}")),
        }
    }
}

impl Distortion {
    /// Sets the coefficient of a term.
    pub(crate) fn set(&mut self, term: Term, value: f64) {
        match term {
            A(index) => self.radial[index] = value,
            B(index) => self.denominator[index] = value,
            P(index) => self.tangential[index] = value,
            S(index) => self.prism[index] = value,
            // For ω = 0 the model is a pinhole.
            Omega if value == 0.0 => {}
            Omega => self.plane = Projection::Fov(value),
        }
    }
}
