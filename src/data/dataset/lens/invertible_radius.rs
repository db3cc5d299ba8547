//! The radius up to which a distortion is provably invertible.
//!
//! A map is injective on a disc if the symmetric part of its Jacobian is positive definite there: on the segment from
//! one point to another, the image moves strictly in the direction of the segment. On a circle of radius r the radial
//! part has the eigenvalues q and (r·q)′, where q is the radial factor; the tangential coefficients p reduce them by at
//! most 6|p|·r and the thin-prism coefficients c by at most 2|c|·r. The distortion is therefore invertible up to the
//! first radius at which the smaller eigenvalue no longer exceeds t, the sum of both reductions and [`MIN_EIGENVALUE`].
//!
//! With q = N/M, where N and M are polynomials in s = r², the condition is that M, N − t·M and
//! (N + 2sN′)·M − 2s·N·M′ − t·M² are positive. Each is bounded from below on whole intervals, so that no radius is
//! skipped: with the variable counted from the start of the interval, a polynomial is at least its constant coefficient
//! plus its negative terms at the end of the interval.

use super::Distortion;

/// Smallest accepted eigenvalue: where a lens shrinks its image a thousandfold, the image shows nothing.
const MIN_EIGENVALUE: f64 = 1e-3;
/// Smallest step of the search, as a fraction of the range of r²: near the end of the range it is far below a pixel.
const MIN_STEP: f64 = 1e-8;

impl Distortion {
    /// Radius on the plane, at most `limit`, up to which the distortion is provably invertible.
    pub(super) fn invertible_radius(&self, limit: f64) -> f64 {
        let end = limit * limit;
        let (mut from, mut step) = (0.0, end);
        while from < end {
            let to = (from + step).min(end);
            if self.is_monotone(from, to) {
                from = to;
                step *= 2.0;
            } else if step > MIN_STEP * end {
                step *= 0.5;
            } else {
                break;
            }
        }
        from.sqrt()
    }

    /// Returns true if the distortion is provably monotone where r² is between `from` and `to`.
    fn is_monotone(&self, from: f64, to: f64) -> bool {
        let length = |[a, b]: [f64; 2]| a.hypot(b);
        let reduction =
            (6.0 * length(self.tangential) + 2.0 * length(self.prism)) * to.sqrt() + MIN_EIGENVALUE;
        let with_one = |terms: &[f64]| std::iter::once(1.0).chain(terms.iter().copied()).collect();
        let (n, m): (Vec<f64>, Vec<f64>) = (with_one(&self.radial), with_one(&self.denominator));
        let minus_reduced = |mut a: Vec<f64>, b: &[f64]| -> Vec<f64> {
            a.resize(a.len().max(b.len()), 0.0);
            for (sum, value) in a.iter_mut().zip(b) {
                *sum -= reduction * value;
            }
            a
        };
        // If P has the coefficients cₖ, 2s·P′ has the coefficients 2k·cₖ.
        let scaled_slope = |p: &[f64]| -> Vec<f64> {
            (0..).zip(p).map(|(power, c)| 2.0 * f64::from(power) * c).collect()
        };
        let slope_of_rn: Vec<f64> = n.iter().zip(scaled_slope(&n)).map(|(a, b)| a + b).collect();
        let mut slope = product(&slope_of_rn, &m);
        for (sum, value) in slope.iter_mut().zip(product(&n, &scaled_slope(&m))) {
            *sum -= value;
        }
        let factor = minus_reduced(n, &m);
        let slope = minus_reduced(slope, &product(&m, &m));
        [m, factor, slope].iter().all(|p| lower_bound(p, from, to) > 0.0)
    }
}

fn product(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut product = vec![0.0; a.len() + b.len() - 1];
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            product[i + j] += x * y;
        }
    }
    product
}

/// A lower bound of a polynomial on an interval, NaN if not finite. Coefficients are in order of increasing power.
fn lower_bound(polynomial: &[f64], from: f64, to: f64) -> f64 {
    // Repeated Horner's scheme gives the coefficients of P(from + x).
    let mut shifted = polynomial.to_vec();
    for done in 0..shifted.len() {
        for power in (done..shifted.len() - 1).rev() {
            shifted[power] += from * shifted[power + 1];
        }
    }
    let length = to - from;
    let (mut bound, mut power) = (0.0, 1.0);
    for (index, &coefficient) in shifted.iter().enumerate() {
        // The constant counts whatever its sign is; `coefficient.min(0.0)` would hide NaN.
        let smallest = if index > 0 && coefficient > 0.0 { 0.0 } else { coefficient };
        bound += smallest * power;
        power *= length;
    }
    bound
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::lens::Projection;

    #[test]
    fn bounds_are_below_all_values_and_tight_on_short_intervals() {
        let p = [1.0, -3.0, 0.5, 0.25, -0.1];
        let value = |x: f64| p.iter().rev().fold(0.0, |sum, c| sum * x + c);
        for from in [0.0, 0.7, 2.0] {
            for length in [1.0, 0.1, 1e-4] {
                let bound = lower_bound(&p, from, from + length);
                let values = (0..=100).map(|i| value(from + length * f64::from(i) / 100.0));
                let min = values.fold(f64::INFINITY, f64::min);
                assert!(bound <= min + 1e-12 && bound > min - 10.0 * length, "{from} {length}");
            }
        }
        assert!(lower_bound(&[1.0, f64::NAN], 0.0, 1.0).is_nan());
    }

    #[test]
    fn the_radius_ends_where_the_radial_part_folds_over() {
        let radius = |radial: [f64; 4], denominator: [f64; 3]| {
            let plain = Distortion::none(Projection::Perspective);
            Distortion { radial, denominator, ..plain }.invertible_radius(10.0)
        };
        assert!((radius([0.0; 4], [0.0; 3]) - 10.0).abs() < 1e-12);
        assert!((radius([0.3, 0.1, 0.0, 0.0], [0.2, 0.0, 0.0]) - 10.0).abs() < 1e-12);
        // r + k r³ folds over at r² = −1/(3k).
        let fold = radius([-0.2, 0.0, 0.0, 0.0], [0.0; 3]);
        assert!((fold - (1.0 / 0.6_f64).sqrt()).abs() < 2e-3, "{fold}");
        // r / (1 + k r²) folds over at r² = 1/k; a pole also ends the radius.
        let fold = radius([0.0; 4], [0.5, 0.0, 0.0]);
        assert!((fold - 2.0_f64.sqrt()).abs() < 5e-3, "{fold}");
        let pole = radius([0.0; 4], [-0.25, 0.0, 0.0]);
        assert!(pole < 2.0 && pole > 1.99, "{pole}");
        for bad in [f64::NAN, f64::INFINITY, -f64::MAX] {
            assert!(radius([bad, 0.0, 0.0, 0.0], [0.0; 3]) < 0.01, "{bad}");
        }
    }

    #[test]
    fn within_the_radius_the_symmetric_part_of_the_jacobian_is_positive_definite() {
        let plain = Distortion::none(Projection::Perspective);
        let tangential = Distortion { tangential: [0.03, -0.02], prism: [0.01, 0.04], ..plain };
        for distortion in [
            tangential,
            Distortion { radial: [-0.1, 0.02, -0.003, 0.0], ..tangential },
            Distortion {
                radial: [0.3, 0.0, 0.0, 0.0],
                denominator: [0.2, 0.05, 0.0],
                ..tangential
            },
        ] {
            let radius = distortion.invertible_radius(3.0);
            assert!(radius > 0.5, "{distortion:?}: {radius}");
            for (i, j) in (0..=60).flat_map(|i| (0..72).map(move |j| (i, j))) {
                let (r, turn) = (radius * f64::from(i) / 60.0, f64::from(j) / 72.0);
                let p = r * glam::DVec2::from_angle(std::f64::consts::TAU * turn);
                let j = distortion.jacobian(p);
                let (a, b, c) = (j.x_axis.x, 0.5 * (j.x_axis.y + j.y_axis.x), j.y_axis.y);
                let eigenvalue = 0.5 * (a + c) - (0.25 * (a - c) * (a - c) + b * b).sqrt();
                assert!(eigenvalue > 0.0, "{distortion:?} at {p}: {eigenvalue}");
            }
        }
    }
}
