//! Lenses with distortion, as in phones and action cameras.
//!
//! The image of a ray is computed by the formula, and the ray of an image point by bisection, independently of the
//! trainer's code, so that rendered images test the trainer's undistortion.

use std::fmt;
use std::str::FromStr;

use glam::DVec2;
use serde::{Deserialize, Serialize};

/// Maximum number of coefficients.
const MAX_COEFFICIENTS: usize = 4;
/// Largest angle from the axis that a lens may image `[degrees]`. Beyond it, depths along the axis are meaningless.
const MAX_ANGLE: f64 = 85.0;
/// Number of angles at which a lens is tested for monotonicity.
const STEPS: u32 = 2000;

/// The projection of a lens: the distance from the image's centre at which an angle from the axis is imaged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LensKind {
    /// An angle θ is imaged at θ·(1 + k₁θ² + k₂θ⁴ + k₃θ⁶ + k₄θ⁸): COLMAP's OPENCV_FISHEYE.
    Fisheye,
    /// A slope r = tan θ is imaged at r·(1 + k₁r² + k₂r⁴): COLMAP's OPENCV.
    Radial,
}

/// A radially symmetric lens.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Lens {
    /// Kind of projection.
    pub kind: LensKind,
    /// Distortion coefficients k₁ to k₄; unused ones are 0.
    pub k: [f64; MAX_COEFFICIENTS],
}

impl LensKind {
    /// All kinds, with their names on the command line and maximum numbers of coefficients.
    const ALL: [(Self, &'static str, usize); 2] =
        [(Self::Fisheye, "fisheye", MAX_COEFFICIENTS), (Self::Radial, "radial", 2)];
}

impl Lens {
    /// Distance from the image's centre at which an angle `[rad]` is imaged, in focal lengths.
    pub(crate) fn radius(&self, angle: f64) -> f64 {
        let r = match self.kind {
            LensKind::Fisheye => angle,
            LensKind::Radial => angle.tan(),
        };
        let s = r * r;
        let [a, b, c, d] = self.k;
        r * (1.0 + s * (a + s * (b + s * (c + s * d))))
    }

    /// The angle `[rad]` that is imaged at distance `radius`, at most [`MAX_ANGLE`].
    fn angle(&self, radius: f64) -> f64 {
        let (mut low, mut high) = (0.0, MAX_ANGLE.to_radians());
        // 60 halvings make the interval smaller than the rounding error.
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if self.radius(middle) < radius { low = middle } else { high = middle }
        }
        0.5 * (low + high)
    }

    /// The angle `[rad]` up to which no two directions are imaged at the same point.
    pub(crate) fn invertible_angle(&self) -> f64 {
        let angle = |step: u32| MAX_ANGLE.to_radians() * f64::from(step) / f64::from(STEPS);
        let rises = |step: &u32| self.radius(angle(step + 1)) > self.radius(angle(*step));
        angle((0..STEPS).find(|step| !rises(step)).unwrap_or(STEPS))
    }

    /// The image of a ray (x/z, y/z), in focal lengths from the centre.
    pub(crate) fn image(&self, ray: DVec2) -> DVec2 {
        let slope = ray.length();
        if slope > 0.0 { ray * (self.radius(slope.atan()) / slope) } else { DVec2::ZERO }
    }

    /// The ray (x/z, y/z) whose image is this point, in focal lengths from the centre.
    pub(crate) fn ray(&self, image: DVec2) -> DVec2 {
        let radius = image.length();
        if radius > 0.0 { image * (self.angle(radius).tan() / radius) } else { DVec2::ZERO }
    }
}

impl fmt::Display for Lens {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let entry = LensKind::ALL.iter().find(|(kind, ..)| *kind == self.kind);
        let (_, name, max_count) = entry.copied().unwrap_or(LensKind::ALL[0]);
        let numbers: Vec<String> = self.k[..max_count].iter().map(ToString::to_string).collect();
        write!(f, "{name}:{}", numbers.join(","))
    }
}

impl FromStr for Lens {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (word, rest) = text.split_once(':').unwrap_or((text, ""));
        let entry = LensKind::ALL.iter().find(|(_, name, _)| *name == word);
        let fault =
            || format!("{text:?} is not a lens: use fisheye:K1[,K2,K3,K4] or radial:K1[,K2]");
        let &(kind, _, max_count) = entry.ok_or_else(fault)?;
        let mut k = [0.0; MAX_COEFFICIENTS];
        let numbers = rest.split(',').filter(|_| !rest.is_empty());
        for (i, number) in numbers.enumerate() {
            let number: f64 = number.trim().parse().map_err(|_| fault())?;
            if i >= max_count || !number.is_finite() {
                return Err(fault());
            }
            k[i] = number;
        }
        Ok(Self { kind, k })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: a fisheye images a direction 30 degrees to the side at θ(1 + kθ²) focal lengths.
    #[test]
    fn images_follow_the_formula_of_the_lens() {
        let ray = DVec2::new(30.0_f64.to_radians().tan(), 0.0);
        let angle = 30.0_f64.to_radians();
        for (text, expected) in [
            ("fisheye:0.1", angle * (1.0 + 0.1 * angle * angle)),
            ("radial:-0.1", ray.x * (1.0 - 0.1 * ray.x * ray.x)),
        ] {
            let lens: Lens = text.parse().unwrap();
            assert!((lens.image(ray).x - expected).abs() < 1e-15, "{text}");
        }
    }

    #[test]
    fn malformed_lenses_are_refused() {
        for bad in ["", "fish", "fisheye:x", "fisheye:1,2,3,4,5", "radial:1,2,3", "fisheye:nan"] {
            assert!(bad.parse::<Lens>().unwrap_err().contains("fisheye:K1"), "{bad}");
        }
    }
}
