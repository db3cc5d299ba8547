//! Lens distortion (Brown–Conrady: two radial, two tangential terms) and its removal.
//!
//! Distorted images are resampled on load to a pinhole camera of the same size. It covers the
//! largest axis-aligned rectangle in which every pixel was seen by the lens.

use glam::{DMat2, DVec2};

use super::pixels::Image8;
use super::resample::PixelMean;

/// A pinhole with lens distortion. The upper left corner of the image is (0, 0); pixel centres are at
/// +0.5.
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
    /// k1, k2, p1, p2: radial of orders 3 and 5, then tangential; 0 without distortion.
    pub distortion: [f64; 4],
}

/// How to resample an image of a distorted lens to a pinhole's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Undistortion {
    /// The lens that took the image, at the image's size.
    from: Lens,
    /// The pinhole, of the same size.
    to: Lens,
}

/// The distortion has no inverse over the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the distortion cannot be inverted over the image")]
pub struct NotInvertible;

/// Border samples per side. The error of a smooth border between samples is (1/64)²/8 of its
/// bend: below 0.01 px for a bend of 100 px.
const BORDER_SAMPLES: u32 = 64;
/// Steps from the principal point outwards, so that Newton's method stays on the branch of the
/// inverse that contains the principal point.
const OUTWARD_STEPS: u32 = 24;

impl Lens {
    /// Whether there is any distortion.
    #[must_use]
    pub fn is_distorted(&self) -> bool {
        self.distortion.iter().any(|&k| k != 0.0)
    }

    /// The same lens with an image of another size.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let scale = DVec2::new(
            f64::from(width) / f64::from(self.width),
            f64::from(height) / f64::from(self.height),
        );
        Self {
            width,
            height,
            focal: self.focal * scale,
            principal: self.principal * scale,
            ..*self
        }
    }

    /// Applies the distortion to a point (x/z, y/z) of the image plane.
    #[must_use]
    pub fn distort(&self, p: DVec2) -> DVec2 {
        let [k1, k2, p1, p2] = self.distortion;
        let r2 = p.length_squared();
        let tangential = DVec2::new(
            2.0 * p1 * p.x * p.y + p2 * (r2 + 2.0 * p.x * p.x),
            p1 * (r2 + 2.0 * p.y * p.y) + 2.0 * p2 * p.x * p.y,
        );
        p * (1.0 + r2 * (k1 + r2 * k2)) + tangential
    }

    /// Derivative of [`Self::distort`].
    fn distort_jacobian(&self, p: DVec2) -> DMat2 {
        let [k1, k2, p1, p2] = self.distortion;
        let r2 = p.length_squared();
        let radial = 1.0 + r2 * (k1 + r2 * k2);
        let slope = 2.0 * (k1 + 2.0 * r2 * k2);
        let off = slope * p.x * p.y + 2.0 * (p1 * p.x + p2 * p.y);
        DMat2::from_cols_array(&[
            radial + slope * p.x * p.x + 2.0 * p1 * p.y + 6.0 * p2 * p.x,
            off,
            off,
            radial + slope * p.y * p.y + 6.0 * p1 * p.y + 2.0 * p2 * p.x,
        ])
    }

    /// The point of the image plane (x/z, y/z) that the lens images at `pixel`.
    ///
    /// # Errors
    /// Where the distortion folds over between the principal point and `pixel`.
    pub fn undistort(&self, pixel: DVec2) -> Result<DVec2, NotInvertible> {
        let target = (pixel - self.principal) / self.focal;
        let mut p = DVec2::ZERO;
        for step in 1..=OUTWARD_STEPS {
            let goal = target * (f64::from(step) / f64::from(OUTWARD_STEPS));
            let mut converged = false;
            for _ in 0..20 {
                let jacobian = self.distort_jacobian(p);
                if !keeps_orientation(jacobian) {
                    return Err(NotInvertible);
                }
                let change = jacobian.inverse() * (goal - self.distort(p));
                p += change;
                // Newton converges quadratically: the next change would be far below rounding.
                if change.length() < 1e-9 * (1.0 + p.length()) {
                    converged = true;
                    break;
                }
            }
            // Folding shows as a Jacobian that is not positive, or as no convergence.
            if !converged || !p.is_finite() || !keeps_orientation(self.distort_jacobian(p)) {
                return Err(NotInvertible);
            }
        }
        Ok(p)
    }

    /// The pinhole of the same size that sees the largest axis-aligned rectangle inside what this
    /// lens saw, and how to resample to it.
    ///
    /// # Errors
    /// Where the distortion has no inverse over the image.
    pub fn undistortion(&self) -> Result<Undistortion, NotInvertible> {
        let size = DVec2::new(f64::from(self.width), f64::from(self.height));
        let (mut low, mut high) = (DVec2::NEG_INFINITY, DVec2::INFINITY);
        for sample in 0..=BORDER_SAMPLES {
            let at = size * (f64::from(sample) / f64::from(BORDER_SAMPLES));
            low.x = low.x.max(self.undistort(DVec2::new(0.0, at.y))?.x);
            high.x = high.x.min(self.undistort(DVec2::new(size.x, at.y))?.x);
            low.y = low.y.max(self.undistort(DVec2::new(at.x, 0.0))?.y);
            high.y = high.y.min(self.undistort(DVec2::new(at.x, size.y))?.y);
        }
        if !(low.cmplt(DVec2::ZERO).all() && high.cmpgt(DVec2::ZERO).all()) {
            // `undistort` starts at the principal point, so that it must be in view.
            return Err(NotInvertible);
        }
        let focal = size / (high - low);
        let to = Self { focal, principal: -low * focal, distortion: [0.0; 4], ..*self };
        Ok(Undistortion { from: *self, to })
    }
}

/// Whether the map has an inverse nearby on the branch of the principal point, where the
/// determinant is 1. At 1e-6 areas shrink a million times, which no lens does.
fn keeps_orientation(jacobian: DMat2) -> bool {
    jacobian.determinant() > 1e-6
}

impl Undistortion {
    /// The pinhole resampled to.
    #[must_use]
    pub fn pinhole(&self) -> &Lens {
        &self.to
    }

    /// Position in the distorted image of a pixel of the pinhole `[px]`.
    #[must_use]
    pub fn source_of(&self, pixel: DVec2) -> DVec2 {
        let p = (pixel - self.to.principal) / self.to.focal;
        self.from.distort(p) * self.from.focal + self.from.principal
    }

    /// Resamples an image of the lens, bilinearly, in one row-major pass.
    #[must_use]
    pub fn apply(&self, image: &Image8) -> Image8 {
        let (width, height) = (image.width, image.height);
        let mut out = Image8::blank(width, height, image);
        for y in 0..height {
            for x in 0..width {
                let at = self.source_of(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)) - 0.5;
                let at =
                    at.clamp(DVec2::ZERO, DVec2::new(f64::from(width - 1), f64::from(height - 1)));
                let (x0, y0) = (at.x as u32, at.y as u32);
                let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
                let (tx, ty) = ((at.x - f64::from(x0)) as f32, (at.y - f64::from(y0)) as f32);
                let mut mean = PixelMean::default();
                mean.add(image, x0, y0, (1.0 - tx) * (1.0 - ty));
                mean.add(image, x1, y0, tx * (1.0 - ty));
                mean.add(image, x0, y1, (1.0 - tx) * ty);
                mean.add(image, x1, y1, tx * ty);
                mean.push_to(&mut out);
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lens(distortion: [f64; 4]) -> Lens {
        Lens {
            width: 288,
            height: 192,
            focal: DVec2::new(210.0, 214.0),
            principal: DVec2::new(150.0, 92.0),
            distortion,
        }
    }

    const LENSES: [[f64; 4]; 4] = [
        [0.058, -0.08, -9.8e-4, 1.6e-4],
        [-0.12, 0.02, 0.0, 0.0],
        [0.3, 0.0, 2e-3, -3e-3],
        [0.0, 0.0, 0.0, 1e-3],
    ];

    #[test]
    fn undistortion_inverts_distortion() {
        for k in LENSES {
            let lens = lens(k);
            for (x, y) in [(0.0, 0.0), (288.0, 0.0), (13.5, 190.0), (150.0, 92.0), (288.0, 192.0)] {
                let pixel = DVec2::new(x, y);
                let back =
                    lens.distort(lens.undistort(pixel).unwrap()) * lens.focal + lens.principal;
                assert!((back - pixel).length() < 1e-9, "{k:?} at {pixel}: {back}");
            }
        }
    }

    #[test]
    fn the_pinhole_sees_only_what_the_lens_saw_and_touches_every_side() {
        for k in LENSES {
            let undistortion = lens(k).undistortion().unwrap();
            let mut slack = [f64::INFINITY; 4];
            for i in 0..=500 {
                let (u, v) = (288.0 * f64::from(i) / 500.0, 192.0 * f64::from(i) / 500.0);
                for pixel in [
                    DVec2::new(u, 0.0),
                    DVec2::new(u, 192.0),
                    DVec2::new(0.0, v),
                    DVec2::new(288.0, v),
                ] {
                    let s = undistortion.source_of(pixel);
                    let inside = [s.x, s.y, 288.0 - s.x, 192.0 - s.y];
                    assert!(inside.iter().all(|&d| d > -0.01), "{k:?} at {pixel}: {s}");
                    slack = std::array::from_fn(|side| slack[side].min(inside[side]));
                }
            }
            assert!(slack.iter().all(|&d| d < 0.5), "{k:?}: a side could be wider: {slack:?}");
        }
    }

    #[test]
    fn a_distortion_that_folds_over_is_refused() {
        for k in [
            [-1.5, 0.0, 0.0, 0.0],
            [0.0, -4.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [f64::NAN, 0.0, 0.0, 0.0],
        ] {
            assert_eq!(lens(k).undistortion(), Err(NotInvertible), "{k:?}");
        }
        let aside = Lens { principal: DVec2::new(-40.0, 92.0), ..lens(LENSES[0]) };
        assert_eq!(aside.undistortion(), Err(NotInvertible));
    }

    /// Dots drawn where the lens would image known rays are found, after undistortion, where the
    /// pinhole projects those rays.
    #[test]
    fn dots_land_where_the_pinhole_projects_them() {
        for k in LENSES {
            let lens = lens(k);
            let undistortion = lens.undistortion().unwrap();
            let pinhole = undistortion.pinhole();
            let mut image = Image8 {
                width: 288,
                height: 192,
                rgb: vec![0; 288 * 192 * 3],
                alpha: None,
                mask: None,
            };
            let mut expected = Vec::new();
            for (i, j) in (0..7).flat_map(|i| (0..5).map(move |j| (i, j))) {
                let pixel = DVec2::new(30.0 + 38.0 * f64::from(i), 24.0 + 36.0 * f64::from(j));
                let ray = (pixel - pinhole.principal) / pinhole.focal;
                expected.push(pixel);
                let dot = lens.distort(ray) * lens.focal + lens.principal;
                for (index, rgb) in image.rgb.chunks_exact_mut(3).enumerate() {
                    let centre = DVec2::new((index % 288) as f64 + 0.5, (index / 288) as f64 + 0.5);
                    let value =
                        255.0 * (-(centre - dot).length_squared() / (2.0 * 1.5 * 1.5)).exp();
                    rgb.fill(rgb[0].max(value.round() as u8));
                }
            }
            let out = undistortion.apply(&image);
            for pixel in expected {
                let (mut sum, mut moment) = (0.0, DVec2::ZERO);
                for (index, rgb) in out.rgb.chunks_exact(3).enumerate() {
                    let centre = DVec2::new((index % 288) as f64 + 0.5, (index / 288) as f64 + 0.5);
                    if (centre - pixel).length() < 7.0 {
                        sum += f64::from(rgb[0]);
                        moment += centre * f64::from(rgb[0]);
                    }
                }
                let error = (moment / sum - pixel).length();
                assert!(error < 0.05, "{k:?}: the dot at {pixel} is off by {error} px");
            }
        }
    }
}
