//! The planes that lens models start from: how far from the centre a ray falls, by its angle from the axis.

/// How the angle between a ray and the optical axis becomes a distance on the plane that is then distorted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Plane {
    /// tan θ: a pinhole.
    Perspective,
    /// θ: a fisheye (Kannala and Brandt 2006).
    Equidistant,
    /// atan(2 tan θ · tan(ω/2)) / ω, with ω `[rad]`, which is not 0 (Devernay and Faugeras 2001).
    Fov(f64),
}

/// Largest angle from the axis that is followed where a plane is infinite at 90 degrees `[rad]`: beyond it a
/// pixel sees less than a hundredth of what one at the centre does.
const WIDEST: f64 = 85.0_f64.to_radians();
/// The same of a fisheye `[rad]`: the sides of the cube around the camera reach a little farther.
const WIDEST_FISHEYE: f64 = 120.0_f64.to_radians();

impl Plane {
    /// Distance from the centre of a ray at this angle `[rad]`, which is below [`Self::widest`].
    #[must_use]
    pub fn radius(self, angle: f64) -> f64 {
        match self {
            Self::Perspective => angle.tan(),
            Self::Equidistant => angle,
            Self::Fov(omega) => (2.0 * angle.tan() * (0.5 * omega).tan()).atan() / omega,
        }
    }

    /// Inverse of [`Self::radius`] `[rad]`.
    #[must_use]
    pub fn angle(self, radius: f64) -> f64 {
        match self {
            Self::Perspective => radius.atan(),
            Self::Equidistant => radius,
            Self::Fov(omega) => ((radius * omega).tan() / (2.0 * (0.5 * omega).tan())).atan(),
        }
    }

    /// Derivative of [`Self::radius`] on the axis: how many focal lengths of the lens a pinhole needs for as
    /// many pixels per radian.
    #[must_use]
    pub fn slope(self) -> f64 {
        match self {
            Self::Perspective | Self::Equidistant => 1.0,
            Self::Fov(omega) => 2.0 * (0.5 * omega).tan() / omega,
        }
    }

    /// Largest angle from the axis that is followed `[rad]`.
    #[must_use]
    pub fn widest(self) -> f64 {
        match self {
            Self::Perspective | Self::Fov(_) => WIDEST,
            Self::Equidistant => WIDEST_FISHEYE,
        }
    }
}
