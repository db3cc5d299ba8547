//! Lens distortion and its inverse by Newton's method.

use glam::{DMat2, DVec2};

use super::Projection;

/// The projection of a lens to a plane, and radial, tangential and thin-prism distortion of that plane (OpenCV, *Camera
/// Calibration and 3D Reconstruction*; COLMAP, `sensor/models`). Coefficients of 0 have no effect.
///
/// p becomes p·(1 + a₁r² + a₂r⁴ + a₃r⁶ + a₄r⁸) / (1 + b₁r² + b₂r⁴ + b₃r⁶), where r = |p|, plus the tangential and
/// thin-prism shifts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Distortion {
    /// The projection to the plane, before distortion.
    pub(crate) plane: Projection,
    /// a₁ to a₄.
    pub(crate) radial: [f64; 4],
    /// b₁ to b₃.
    pub(crate) denominator: [f64; 3],
    /// p₁ and p₂.
    pub(crate) tangential: [f64; 2],
    /// Shifts of the thin prism along x and y, per r².
    pub(crate) prism: [f64; 2],
}

/// Maximum number of steps of Newton's method. It converges quadratically, but more slowly while steps are halved.
const STEPS: u32 = 60;

impl Distortion {
    /// A projection without distortion.
    pub(crate) fn none(plane: Projection) -> Self {
        let (radial, denominator) = ([0.0; 4], [0.0; 3]);
        Self { plane, radial, denominator, tangential: [0.0; 2], prism: [0.0; 2] }
    }

    /// All coefficients.
    pub(super) fn coefficients(&self) -> impl Iterator<Item = f64> {
        let radial = self.radial.into_iter().chain(self.denominator);
        radial.chain(self.tangential).chain(self.prism)
    }

    /// Numerator and denominator of the radial factor at r² = `s`, and their derivatives.
    fn radial_at(&self, s: f64) -> ([f64; 2], [f64; 2]) {
        let [a1, a2, a3, a4] = self.radial;
        let [b1, b2, b3] = self.denominator;
        let value =
            [1.0 + s * (a1 + s * (a2 + s * (a3 + s * a4))), 1.0 + s * (b1 + s * (b2 + s * b3))];
        let slope = [
            a1 + s * (2.0 * a2 + s * (3.0 * a3 + s * 4.0 * a4)),
            b1 + s * (2.0 * b2 + s * 3.0 * b3),
        ];
        (value, slope)
    }

    /// Distorts a point of the plane.
    pub(crate) fn apply(&self, p: DVec2) -> DVec2 {
        let s = p.length_squared();
        let ([n, m], _) = self.radial_at(s);
        let ([p1, p2], prism) = (self.tangential, DVec2::from(self.prism));
        let tangential = DVec2::new(
            2.0 * p1 * p.x * p.y + p2 * (s + 2.0 * p.x * p.x),
            p1 * (s + 2.0 * p.y * p.y) + 2.0 * p2 * p.x * p.y,
        );
        p * (n / m) + tangential + prism * s
    }

    /// Derivative of [`Self::apply`].
    pub(super) fn jacobian(&self, p: DVec2) -> DMat2 {
        let ([n, m], [dn, dm]) = self.radial_at(p.length_squared());
        let (factor, slope) = (n / m, 2.0 * (dn * m - n * dm) / (m * m));
        let ([p1, p2], [s1, s2]) = (self.tangential, self.prism);
        let off = slope * p.x * p.y + 2.0 * (p1 * p.x + p2 * p.y);
        DMat2::from_cols_array(&[
            factor + slope * p.x * p.x + 2.0 * p1 * p.y + (6.0 * p2 + 2.0 * s1) * p.x,
            off + 2.0 * s2 * p.x,
            off + 2.0 * s1 * p.y,
            factor + slope * p.y * p.y + (6.0 * p1 + 2.0 * s2) * p.y + 2.0 * p2 * p.x,
        ])
    }

    /// The point of the plane that is distorted to `target`; `None` if no such point lies within `reach` of the centre.
    /// `reach` may not exceed the invertible radius.
    pub(crate) fn inverse(&self, target: DVec2, reach: f64) -> Option<DVec2> {
        let mut p = target.clamp_length_max(reach);
        let mut miss = self.apply(p) - target;
        for _ in 0..STEPS {
            let mut step = self.jacobian(p).inverse() * miss;
            // The Jacobian is regular within the invertible radius, so a short step always approaches the target.
            let next = loop {
                let next = (p - step).clamp_length_max(reach);
                let missed = self.apply(next) - target;
                if missed.length() <= miss.length() || step.length() < 1e-16 {
                    miss = missed;
                    break next;
                }
                if !step.is_finite() {
                    return None;
                }
                step *= 0.5;
            };
            let change = (next - p).length();
            p = next;
            // Because of quadratic convergence, the next change would be far below rounding.
            if change < 1e-11 * (1.0 + p.length()) {
                break;
            }
        }
        // For a target beyond the rim, the search ends at the rim, too far from the target.
        (miss.length() < 1e-9 * (1.0 + target.length())).then_some(p)
    }
}
