//! Projections of lens models, before distortion.

/// The distance of a ray from the image centre, as a function of its angle θ from the optical axis, before distortion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Projection {
    /// tan θ: a pinhole.
    Perspective,
    /// θ: a fisheye (Kannala and Brandt 2006).
    Equidistant,
    /// atan(2 tan θ · tan(ω/2)) / ω, with ω `[rad]`, which is not 0 (Devernay and Faugeras 2001).
    Fov(f64),
}

/// Largest supported angle from the axis for projections through tan θ, which is infinite at 90 degrees `[rad]`. A
/// pinhole's pixel there covers about 1/1,500 of the solid angle of a pixel at the centre.
const WIDEST: f64 = 85.0_f64.to_radians();
/// Largest supported angle from the axis for fisheyes `[rad]`. Wide lenses are resampled to the faces of a cube
/// (`pinholes.rs`), whose side faces reach a little farther.
const WIDEST_FISHEYE: f64 = 120.0_f64.to_radians();

impl Projection {
    /// Distance from the centre, for an angle `[rad]` below [`Self::widest`].
    pub(crate) fn radius(self, angle: f64) -> f64 {
        match self {
            Self::Perspective => angle.tan(),
            Self::Equidistant => angle,
            Self::Fov(omega) => (2.0 * angle.tan() * (0.5 * omega).tan()).atan() / omega,
        }
    }

    /// Inverse of [`Self::radius`] `[rad]`.
    pub(crate) fn angle(self, radius: f64) -> f64 {
        match self {
            Self::Perspective => radius.atan(),
            Self::Equidistant => radius,
            Self::Fov(omega) => ((radius * omega).tan() / (2.0 * (0.5 * omega).tan())).atan(),
        }
    }

    /// Derivative of [`Self::radius`] on the axis: the focal length, relative to that of the lens, of a pinhole with
    /// the same number of pixels per radian on the axis.
    pub(crate) fn slope(self) -> f64 {
        match self {
            Self::Perspective | Self::Equidistant => 1.0,
            Self::Fov(omega) => 2.0 * (0.5 * omega).tan() / omega,
        }
    }

    /// Largest supported angle from the axis `[rad]`.
    pub(crate) fn widest(self) -> f64 {
        match self {
            Self::Perspective | Self::Fov(_) => WIDEST,
            Self::Equidistant => WIDEST_FISHEYE,
        }
    }
}
