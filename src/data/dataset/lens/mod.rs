//! Lenses: from the direction of a ray to its place in the image, and back.
//!
//! A lens model is a [`Plane`] onto which rays fall by their angle from the axis, and a [`Distortion`] of that
//! plane; `table.rs` has all of them. Nothing beyond the radius that is proven invertible is used (`reach.rs`).

mod cut;
mod distortion;
mod plane;
mod reach;
pub(super) mod table;
#[cfg(test)]
mod tests;

use std::fmt;

use glam::{DVec2, DVec3};

pub(super) use cut::{Cut, CutFault};
pub use distortion::Distortion;
pub use plane::Plane;

/// A lens with its image. The upper left corner of the image is (0, 0); pixel centres are at +0.5. Axes as
/// of a camera: x right, y down, z forward.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    /// Image width `[px]`.
    pub width: u32,
    /// Image height `[px]`.
    pub height: u32,
    /// Focal lengths `[px]`.
    pub focal: DVec2,
    /// Principal point `[px]`.
    pub principal: DVec2,
    distortion: Distortion,
    /// Distance from the centre of the plane up to which it is inverted.
    reach: f64,
    /// Whether the distortion folds over there; else the plane ends.
    folds: bool,
}

/// Why no ray is known for a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unseen {
    /// The distortion has no inverse there.
    Folds,
    /// It is farther from the axis than is followed.
    TooWide,
}

impl Lens {
    /// A lens; its parameters need not be sensible.
    #[must_use]
    pub fn new(
        (width, height): (u32, u32),
        focal: DVec2,
        principal: DVec2,
        distortion: Distortion,
    ) -> Self {
        let limit = distortion.plane.radius(distortion.plane.widest());
        let reach = distortion.reach(limit);
        // But for the rounding of a square root; false where the limit is not a number.
        let is_whole = reach >= limit * (1.0 - 1e-12);
        Self { width, height, focal, principal, distortion, reach, folds: !is_whole }
    }

    /// The distortion.
    #[must_use]
    pub fn distortion(&self) -> &Distortion {
        &self.distortion
    }

    /// Whether it is anything but a pinhole.
    #[must_use]
    pub fn is_distorted(&self) -> bool {
        self.distortion != Distortion::of(Plane::Perspective)
    }

    /// Whether all parameters are finite numbers.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        let omega = match self.distortion.plane {
            Plane::Fov(omega) => omega,
            Plane::Perspective | Plane::Equidistant => 0.0,
        };
        let rest = self.distortion.coefficients().chain([omega]);
        self.focal.is_finite() && self.principal.is_finite() && { rest }.all(f64::is_finite)
    }

    /// Largest angle between two rays opposite to each other that it images one-to-one `[degrees]`.
    #[must_use]
    pub fn usable_field(&self) -> f64 {
        2.0 * self.distortion.plane.angle(self.reach).to_degrees()
    }

    /// The same lens with an image of another size.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let scale = DVec2::new(
            f64::from(width) / f64::from(self.width),
            f64::from(height) / f64::from(self.height),
        );
        let (focal, principal) = (self.focal * scale, self.principal * scale);
        Self { width, height, focal, principal, ..*self }
    }

    /// Image size `[px]`.
    #[must_use]
    pub fn size(&self) -> DVec2 {
        DVec2::new(f64::from(self.width), f64::from(self.height))
    }

    /// Where the plane has a ray; `None` where it has none.
    fn on_plane(&self, direction: DVec3) -> Option<DVec2> {
        let (flat, plane) = (direction.truncate(), self.distortion.plane);
        if plane == Plane::Perspective {
            return (direction.z > 0.0).then(|| flat / direction.z);
        }
        let sine = flat.length();
        let angle = sine.atan2(direction.z);
        if angle > plane.widest() {
            return None;
        }
        Some(if sine > 0.0 { flat * (plane.radius(angle) / sine) } else { DVec2::ZERO })
    }

    /// Where a ray is imaged `[px]`, in the image or not; `None` beyond what is inverted.
    #[must_use]
    pub fn project(&self, direction: DVec3) -> Option<DVec2> {
        // A relative 1e-9 is below any pixel, and above the rounding of a point on the rim.
        let is_within = |p: &DVec2| p.length() <= self.reach * (1.0 + 1e-9);
        self.on_plane(direction).filter(is_within).map(|p| self.imaged(p))
    }

    /// The same without regard to whether it can be inverted.
    #[must_use]
    pub fn extrapolate(&self, direction: DVec3) -> Option<DVec2> {
        self.on_plane(direction).map(|p| self.imaged(p))
    }

    fn imaged(&self, on_plane: DVec2) -> DVec2 {
        self.distortion.apply(on_plane) * self.focal + self.principal
    }

    /// The ray that is imaged at a place `[px]`, of any length.
    ///
    /// # Errors
    /// Where none is known.
    pub fn unproject(&self, pixel: DVec2) -> Result<DVec3, Unseen> {
        let target = (pixel - self.principal) / self.focal;
        let unseen = if self.folds { Unseen::Folds } else { Unseen::TooWide };
        let p = self.distortion.inverse(target, self.reach).ok_or(unseen)?;
        if self.distortion.plane == Plane::Perspective {
            return Ok(p.extend(1.0));
        }
        let radius = p.length();
        let (sine, cosine) = self.distortion.plane.angle(radius).sin_cos();
        Ok(if radius > 0.0 { (p * (sine / radius)).extend(cosine) } else { DVec3::Z })
    }
}

impl fmt::Display for Distortion {
    /// Plane and terms, for messages.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { plane, radial, denominator, tangential, prism } = self;
        write!(f, "{plane:?}, radial {radial:?}")?;
        if denominator.iter().any(|&b| b != 0.0) {
            write!(f, " over {denominator:?}")?;
        }
        write!(f, ", tangential {tangential:?}")?;
        if prism.iter().any(|&s| s != 0.0) {
            write!(f, ", prism {prism:?}")?;
        }
        Ok(())
    }
}
