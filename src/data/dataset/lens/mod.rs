//! Lenses: projection of rays into the image, and back.
//!
//! A lens model is a [`Projection`] to a plane, which maps the angle from the optical axis to a distance from the
//! centre, and a [`Distortion`] of that plane. `models.rs` lists all models. Only the part of the plane on which the
//! distortion is provably invertible is used (`invertible_radius.rs`).

mod distortion;
mod invertible_radius;
pub(super) mod models;
mod pinholes;
mod projection;
#[cfg(test)]
mod tests;

use std::fmt;

use glam::{DVec2, DVec3};

pub(crate) use distortion::Distortion;
pub(super) use pinholes::{PinholeError, Pinholes};
pub(crate) use projection::Projection;

/// A lens and the size of its image. The upper left corner of the image is (0, 0); pixel centres are at +0.5. The axes
/// are x right, y down, z forward.
///
/// The `Debug` text of lenses is part of the fingerprint in checkpoints: renaming a field would invalidate them.
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct Lens {
    /// Image width `[px]`.
    pub(crate) width: u32,
    /// Image height `[px]`.
    pub(crate) height: u32,
    /// Focal lengths `[px]`.
    pub(crate) focal: DVec2,
    /// Principal point `[px]`.
    pub(crate) principal: DVec2,
    /// The projection and its distortion.
    pub(crate) distortion: Distortion,
    /// Distance from the centre of the plane up to which rays are mapped: there the distortion ceases to be invertible,
    /// or the projection ends.
    reach: f64,
    /// True if the distortion folds over beyond `reach`, so that different rays meet in one pixel; false if the
    /// projection ends there.
    folds: bool,
    /// Radius of the circle around the middle of the image outside of which nothing was imaged `[px]`; `None`: the
    /// whole image counts.
    circle: Option<f64>,
}

/// Reason why a pixel has no ray.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Unseen {
    /// The distortion has no inverse at the pixel.
    Folds,
    /// The angle from the axis exceeds the largest supported angle.
    TooWide,
    /// The pixel is outside of the image circle.
    OutsideCircle,
}

impl Lens {
    /// A lens; the parameters may be invalid.
    pub(crate) fn new(
        (width, height): (u32, u32),
        focal: DVec2,
        principal: DVec2,
        distortion: Distortion,
    ) -> Self {
        let limit = distortion.plane.radius(distortion.plane.widest());
        let reach = distortion.invertible_radius(limit);
        // The factor allows for the rounding of a square root. A limit of NaN gives false.
        let is_whole = reach >= limit * (1.0 - 1e-12);
        Self { width, height, focal, principal, distortion, reach, folds: !is_whole, circle: None }
    }

    /// The same lens, of whose image only a circle around the middle counts; `radius` is in pixels.
    pub(crate) fn with_circle(self, radius: f64) -> Self {
        let is_partial = radius < 0.5 * self.size().length();
        Self { circle: is_partial.then_some(radius), ..self }
    }

    /// Returns true if the lens differs from a pinhole.
    pub(crate) fn is_distorted(&self) -> bool {
        self.distortion != Distortion::none(Projection::Perspective)
    }

    /// Returns true if all parameters are finite numbers.
    pub(crate) fn is_finite(&self) -> bool {
        let omega = match self.distortion.plane {
            Projection::Fov(omega) => omega,
            Projection::Perspective | Projection::Equidistant => 0.0,
        };
        let rest = self.distortion.coefficients().chain([omega]);
        self.focal.is_finite() && self.principal.is_finite() && { rest }.all(f64::is_finite)
    }

    /// Largest field of view that is imaged one-to-one `[degrees]`.
    pub(crate) fn usable_field(&self) -> f64 {
        2.0 * self.distortion.plane.angle(self.reach).to_degrees()
    }

    /// The same lens with another image size.
    pub(crate) fn resized(&self, width: u32, height: u32) -> Self {
        let scale = DVec2::new(
            f64::from(width) / f64::from(self.width),
            f64::from(height) / f64::from(self.height),
        );
        let (focal, principal) = (self.focal * scale, self.principal * scale);
        let circle = self.circle.map(|radius| radius * scale.min_element());
        Self { width, height, focal, principal, circle, ..*self }
    }

    /// Returns true if a point `[px]` is in the image, and in its circle; `tolerance` is for rounding `[px]`.
    pub(crate) fn images(&self, pixel: DVec2, tolerance: f64) -> bool {
        let low = DVec2::splat(-tolerance);
        (pixel.cmpge(low) & pixel.cmple(self.size() - low)).all()
            && self.is_in_circle(pixel, tolerance)
    }

    fn is_in_circle(&self, pixel: DVec2, tolerance: f64) -> bool {
        let distance = (pixel - 0.5 * self.size()).length();
        self.circle.is_none_or(|radius| distance <= radius + tolerance)
    }

    /// Image size `[px]`.
    pub(crate) fn size(&self) -> DVec2 {
        DVec2::new(f64::from(self.width), f64::from(self.height))
    }

    /// The point on the undistorted plane to which a ray projects; `None` if the ray is too far from the axis.
    fn plane_from_ray(&self, direction: DVec3) -> Option<DVec2> {
        let (flat, plane) = (direction.truncate(), self.distortion.plane);
        if plane == Projection::Perspective {
            return (direction.z > 0.0).then(|| flat / direction.z);
        }
        let sine = flat.length();
        let angle = sine.atan2(direction.z);
        if angle > plane.widest() {
            return None;
        }
        Some(if sine > 0.0 { flat * (plane.radius(angle) / sine) } else { DVec2::ZERO })
    }

    /// Projection of a ray `[px]`, which may lie outside the image; `None` where the distortion is not invertible.
    pub(crate) fn project(&self, direction: DVec3) -> Option<DVec2> {
        // A relative 1e-9 is far below a pixel, and above the rounding of a point on the rim.
        let is_within = |p: &DVec2| p.length() <= self.reach * (1.0 + 1e-9);
        self.plane_from_ray(direction).filter(is_within).map(|p| self.pixel_from_plane(p))
    }

    /// Projection of a ray `[px]`, even where the distortion is not invertible.
    pub(crate) fn extrapolate(&self, direction: DVec3) -> Option<DVec2> {
        self.plane_from_ray(direction).map(|p| self.pixel_from_plane(p))
    }

    fn pixel_from_plane(&self, point: DVec2) -> DVec2 {
        self.distortion.apply(point) * self.focal + self.principal
    }

    /// The ray, not normalised, that projects to a point of the image `[px]`.
    ///
    /// # Errors
    /// When no such ray is known.
    pub(crate) fn unproject(&self, pixel: DVec2) -> Result<DVec3, Unseen> {
        if !self.is_in_circle(pixel, 0.0) {
            return Err(Unseen::OutsideCircle);
        }
        let target = (pixel - self.principal) / self.focal;
        let unseen = if self.folds { Unseen::Folds } else { Unseen::TooWide };
        let p = self.distortion.inverse(target, self.reach).ok_or(unseen)?;
        if self.distortion.plane == Projection::Perspective {
            return Ok(p.extend(1.0));
        }
        let radius = p.length();
        let (sine, cosine) = self.distortion.plane.angle(radius).sin_cos();
        Ok(if radius > 0.0 { (p * (sine / radius)).extend(cosine) } else { DVec3::Z })
    }
}

impl fmt::Debug for Lens {
    /// The fields; the circle only if there is one.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut fields = f.debug_struct("Lens");
        fields.field("width", &self.width).field("height", &self.height);
        fields.field("focal", &self.focal).field("principal", &self.principal);
        fields.field("distortion", &self.distortion);
        fields.field("reach", &self.reach).field("folds", &self.folds);
        if let Some(circle) = self.circle {
            fields.field("circle", &circle);
        }
        fields.finish()
    }
}

impl fmt::Display for Distortion {
    /// The projection and the coefficients, for messages.
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
