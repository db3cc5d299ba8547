//! Lenses that bend straight lines, as those of phones and action cameras do.
//!
//! Its rays are found by bisection and its images by the formula, both apart from the trainer's code: so what
//! the trainer undistorts tests that.

use std::fmt;
use std::str::FromStr;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::error::Error;

/// Most coefficients.
const MOST: usize = 4;
/// Largest angle from the axis that a lens may image `[degrees]`: beyond it a pixel has hardly a depth.
const WIDEST: f64 = 85.0;
/// Steps in which the slope of a lens is looked at.
const STEPS: u32 = 2000;

/// What becomes of the angle from the axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LensKind {
    /// An angle θ is imaged at θ·(1 + k₁θ² + k₂θ⁴ + k₃θ⁶ + k₄θ⁸): COLMAP's OPENCV_FISHEYE.
    Fisheye,
    /// A slope r = tan θ is imaged at r·(1 + k₁r² + k₂r⁴): COLMAP's OPENCV.
    Radial,
}

/// A lens, which is the same in all directions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Lens {
    /// Its plane.
    pub kind: LensKind,
    /// Its coefficients, 0 where there are fewer.
    pub k: [f64; MOST],
}

impl LensKind {
    /// Word on the command line, and most coefficients.
    const ALL: [(Self, &'static str, usize); 2] =
        [(Self::Fisheye, "fisheye", MOST), (Self::Radial, "radial", 2)];
}

impl Lens {
    /// Where an angle `[rad]` is imaged: distance from the image's middle in focal lengths.
    fn radius(&self, angle: f64) -> f64 {
        let r = match self.kind {
            LensKind::Fisheye => angle,
            LensKind::Radial => angle.tan(),
        };
        let s = r * r;
        let [a, b, c, d] = self.k;
        r * (1.0 + s * (a + s * (b + s * (c + s * d))))
    }

    /// The angle that is imaged at a distance `[rad]`; the widest where none is.
    fn angle(&self, radius: f64) -> f64 {
        let (mut low, mut high) = (0.0, WIDEST.to_radians());
        // Each step halves the interval: below the rounding of its ends.
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if self.radius(middle) < radius { low = middle } else { high = middle }
        }
        0.5 * (low + high)
    }

    /// Where a ray (x/z, y/z) is imaged, in focal lengths from the middle.
    pub(crate) fn image(&self, ray: DVec2) -> DVec2 {
        let slope = ray.length();
        if slope > 0.0 { ray * (self.radius(slope.atan()) / slope) } else { DVec2::ZERO }
    }

    /// The ray (x/z, y/z) that is imaged at a place, in focal lengths from the middle.
    pub(crate) fn ray(&self, place: DVec2) -> DVec2 {
        let radius = place.length();
        if radius > 0.0 { place * (self.angle(radius).tan() / radius) } else { DVec2::ZERO }
    }

    /// A pinhole camera with this lens in place of its own: the middle of its left and right edges still see
    /// what they saw.
    ///
    /// # Errors
    /// When the lens images two directions at one place of the picture, or the picture is wider than it images.
    pub(crate) fn on(self, camera: Camera) -> Result<Camera, Error> {
        let half = 0.5 * f64::from(camera.width);
        let factor = (half / camera.fx) / self.image(DVec2::new(half / camera.fx, 0.0)).x;
        let (fx, fy) = (camera.fx * factor, camera.fy * factor);
        let corner = DVec2::new(half / fx, 0.5 * f64::from(camera.height) / fy).length();
        let widest = WIDEST.to_radians();
        let angle = |step: u32| widest * f64::from(step) / f64::from(STEPS);
        let rises = |step: &u32| self.radius(angle(step + 1)) > self.radius(angle(*step));
        let last = (0..STEPS).find(|step| !rises(step)).unwrap_or(STEPS);
        if !(factor > 0.0
            && factor.is_finite()
            && corner < self.radius(angle(last))
            && (half / camera.fx).atan() < angle(last))
        {
            let field = 2.0 * angle(last).to_degrees();
            return Err(Error::option(
                "--lens",
                format!(
                    "{self} images each direction at a place of its own within {field:.0} degrees only, and the \
                     picture is wider from corner to corner; lower --fov or the coefficients"
                ),
            ));
        }
        Ok(Camera { fx, fy, lens: Some(self), ..camera })
    }
}

impl fmt::Display for Lens {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = LensKind::ALL.iter().find(|(kind, ..)| *kind == self.kind);
        let (_, word, most) = word.copied().unwrap_or(LensKind::ALL[0]);
        let numbers: Vec<String> = self.k[..most].iter().map(ToString::to_string).collect();
        write!(f, "{word}:{}", numbers.join(","))
    }
}

impl FromStr for Lens {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (word, rest) = text.split_once(':').unwrap_or((text, ""));
        let found = LensKind::ALL.iter().find(|(_, name, _)| *name == word);
        let fault =
            || format!("{text:?} is no lens: write fisheye:K1[,K2,K3,K4] or radial:K1[,K2]");
        let &(kind, _, most) = found.ok_or_else(fault)?;
        let mut k = [0.0; MOST];
        let numbers = rest.split(',').filter(|_| !rest.is_empty());
        for (place, number) in numbers.enumerate() {
            let number: f64 = number.trim().parse().map_err(|_| fault())?;
            if place >= most || !number.is_finite() {
                return Err(fault());
            }
            k[place] = number;
        }
        Ok(Self { kind, k })
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn pinhole(fov: f64) -> Camera {
        let fov = fov.to_radians();
        Camera::looking(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DVec3::Y, fov, (80, 60))
    }

    #[test]
    fn rays_are_imaged_where_they_came_from() {
        for text in
            ["fisheye", "fisheye:0.03,-0.008,0.002,-0.0003", "radial:-0.1,0.02", "radial:0.2"]
        {
            let camera = text.parse::<Lens>().unwrap().on(pinhole(70.0)).unwrap();
            for (x, y) in (0..=16).flat_map(|x| (0..=12).map(move |y| (x, y))) {
                let pixel = 5.0 * DVec2::new(f64::from(x), f64::from(y));
                let (back, depth) = camera.project(camera.centre + 3.0 * camera.direction(pixel));
                assert!((depth - 3.0).abs() < 1e-12, "{text}");
                assert!((back - pixel).length() < 1e-9, "{text}: {pixel} {back}");
            }
        }
    }

    /// By hand: 30 degrees to the side lie at θ(1 + kθ²) focal lengths of a fisheye.
    #[test]
    fn a_lens_images_as_its_formula_says_and_keeps_the_field_of_view() {
        let ray = DVec2::new(30.0_f64.to_radians().tan(), 0.0);
        let angle = 30.0_f64.to_radians();
        for (text, expected) in [
            ("fisheye:0.1", angle * (1.0 + 0.1 * angle * angle)),
            ("radial:-0.1", ray.x * (1.0 - 0.1 * ray.x * ray.x)),
        ] {
            let lens: Lens = text.parse().unwrap();
            assert!((lens.image(ray).x - expected).abs() < 1e-15, "{text}");
            let [plain, bent] = [pinhole(60.0), lens.on(pinhole(60.0)).unwrap()];
            let edge = DVec2::new(0.0, 30.0);
            assert!((plain.direction(edge) - bent.direction(edge)).length() < 1e-12, "{text}");
            let inside = DVec2::new(20.0, 15.0);
            assert!((plain.direction(inside) - bent.direction(inside)).length() > 1e-3, "{text}");
        }
    }

    #[test]
    fn what_is_no_lens_or_folds_over_is_refused() {
        for bad in ["", "fish", "fisheye:x", "fisheye:1,2,3,4,5", "radial:1,2,3", "fisheye:nan"] {
            assert!(bad.parse::<Lens>().unwrap_err().contains("fisheye:K1"), "{bad}");
        }
        for (text, fov) in
            [("radial:-0.9", 70.0), ("fisheye:0,-2", 90.0), ("fisheye:0,-0.3", 150.0)]
        {
            let message = text.parse::<Lens>().unwrap().on(pinhole(fov)).unwrap_err().to_string();
            assert!(message.contains("--lens") && message.contains("degrees"), "{message}");
        }
    }
}
