//! Planes of lens models: the distance of a ray from the centre, as a function of its angle from the axis.

/// The map from the angle between a ray and the optical axis to a distance on the plane that is then distorted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Plane {
    /// tan θ: a pinhole.
    Perspective,
    /// θ: a fisheye (Kannala and Brandt 2006).
    Equidistant,
    /// atan(2 tan θ · tan(ω/2)) / ω, with ω `[rad]`, which is not 0 (Devernay and Faugeras 2001).
    Fov(f64),
}

/// Largest supported angle from the axis, for planes that are infinite at 90 degrees `[rad]`. Beyond it a pixel covers
/// less than a hundredth of the solid angle of a pixel at the centre.
const WIDEST: f64 = 85.0_f64.to_radians();
/// Largest supported angle from the axis for fisheyes `[rad]`; the sides of the cube around the camera extend a little
/// farther.
const WIDEST_FISHEYE: f64 = 120.0_f64.to_radians();

impl Plane {
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

    /// Derivative of [`Self::radius`] on the axis: the focal length, relative to that of the lens, with which a pinhole
    /// has as many pixels per radian.
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
