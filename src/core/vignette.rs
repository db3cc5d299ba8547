//! Vignettes: the light that a camera loses towards the edges of its pictures.
//!
//! In linear light the factor is V(r) = 1 + a₁r² + a₂r⁴ + a₃r⁶, limited to [[`DARKEST`], 1], where r is the distance
//! from the photograph's middle as a share of its longer side. Except for the darkest values, the sRGB curve is
//! 1.055·x^(1/2.4) − 0.055, so that the factor acts on encoded values C exactly as v·(C + 0.055) − 0.055 with
//! v = V^(1/2.4). Goldman (IEEE PAMI 2010) and PPISP (nv-tlabs/ppisp) use the same polynomial.

/// Number of coefficients.
pub const COEFFICIENTS: usize = 3;
/// Smallest factor on light: six stops. The derivative of v with respect to V grows without bound towards V = 0.
pub const DARKEST: f32 = 1.0 / 64.0;
/// r² at the corner of a 4:3 photograph.
pub const CORNER: f32 = 0.25 * (1.0 + 9.0 / 16.0);
/// The offset of the sRGB curve.
pub const CURVE_OFFSET: f32 = 0.055;
/// The exponent of the sRGB curve.
const CURVE: f32 = 2.4;

/// Where a view's pixels lie in its photograph, before cropping, undistortion and shrinking.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotographPlace {
    /// The photograph's middle, from the view's upper left corner `[px]`.
    pub middle: [f32; 2],
    /// The view's pixel, along x and y, as a share of the photograph's longer side.
    pub pixel: [f32; 2],
}

/// The vignette of a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Vignette {
    /// a₁ to a₃.
    pub coefficients: [f32; COEFFICIENTS],
    /// Where the view's pixels lie.
    pub place: PhotographPlace,
}

/// What a vignette does to a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dimming {
    /// v, the factor on an encoded value plus [`CURVE_OFFSET`].
    pub factor: f32,
    /// dv/dV; 0 where V is limited.
    pub slope: f32,
    /// r².
    pub squared_radius: f32,
}

impl PhotographPlace {
    /// r² at the centre of the pixel in column `x` and row `y`.
    #[inline(always)]
    pub fn squared_radius(&self, x: f32, y: f32) -> f32 {
        let dx = (x + 0.5 - self.middle[0]) * self.pixel[0];
        let dy = (y + 0.5 - self.middle[1]) * self.pixel[1];
        dx * dx + dy * dy
    }
}

impl Vignette {
    /// What the vignette does to the pixel in column `x` and row `y`. `alpha` is the photograph's, in `[0, 1]`: where
    /// it is transparent, it shows the background, which no camera has dimmed.
    #[inline(always)]
    pub fn at(&self, x: f32, y: f32, alpha: f32) -> Dimming {
        let s = self.place.squared_radius(x, y);
        let light = light(self.coefficients, s);
        let limited = light.clamp(DARKEST, 1.0);
        let v = encoded(limited);
        let within = if (DARKEST..=1.0).contains(&light) { alpha } else { 0.0 };
        Dimming {
            factor: 1.0 - alpha * (1.0 - v),
            slope: within * v / (CURVE * limited),
            squared_radius: s,
        }
    }

    /// The encoded colour that the photograph shows of the scene's colour, at the pixel in column `x` and row `y`.
    pub fn apply(&self, x: usize, y: usize, alpha: f32, colour: [f32; 3]) -> [f32; 3] {
        let factor = self.at(x as f32, y as f32, alpha).factor;
        colour.map(|c| dimmed(factor, c))
    }

    /// The inverse of [`apply`](Self::apply).
    pub fn undo(&self, x: usize, y: usize, alpha: f32, colour: [f32; 3]) -> [f32; 3] {
        let factor = self.at(x as f32, y as f32, alpha).factor;
        colour.map(|c| undimmed(factor, c))
    }
}

/// An encoded value after the factor v.
#[inline(always)]
pub fn dimmed(factor: f32, value: f32) -> f32 {
    factor * (value + CURVE_OFFSET) - CURVE_OFFSET
}

/// An encoded value before the factor v.
#[inline(always)]
pub fn undimmed(factor: f32, value: f32) -> f32 {
    (value + CURVE_OFFSET) / factor - CURVE_OFFSET
}

/// V at a squared radius, without its limits.
#[inline(always)]
pub fn light([a, b, c]: [f32; COEFFICIENTS], squared_radius: f32) -> f32 {
    let s = squared_radius;
    1.0 + s * (a + s * (b + s * c))
}

/// V^(1/2.4) for V in [[`DARKEST`], 1]: the product of its fourth and sixth roots. Unlike `powf` it is the same on
/// every platform, and compiles to vectors.
#[inline(always)]
fn encoded(light: f32) -> f32 {
    let root = light.sqrt();
    // A third of the bits approximates the cube root to 5 %, and each of Halley's steps cubes the error.
    let mut y = f32::from_bits(root.to_bits() / 3 + 709_921_077);
    y *= (y * y * y + 2.0 * root) / (2.0 * y * y * y + root);
    y *= (y * y * y + 2.0 * root) / (2.0 * y * y * y + root);
    root.sqrt() * y
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests {
    use super::*;

    const PLACE: PhotographPlace = PhotographPlace { middle: [20.0, 10.0], pixel: [0.025, 0.025] };

    #[test]
    fn the_root_is_exact_to_rounding() {
        let worst = (0..=2000)
            .map(|i| DARKEST + (1.0 - DARKEST) * i as f32 / 2000.0)
            .map(|v| (f64::from(encoded(v)) / f64::from(v).powf(1.0 / 2.4) - 1.0).abs())
            .fold(0.0, f64::max);
        assert!(worst < 4e-7, "{worst}");
    }

    /// A stop at the corner halves linear light, and r is measured from the photograph's middle.
    #[test]
    fn light_is_lost_by_distance_from_the_middle() {
        let vignette = Vignette { coefficients: [-1.6, 0.0, 0.0], place: PLACE };
        let corner = vignette.at(39.5, 19.5, 1.0);
        assert!((corner.squared_radius - 0.3125).abs() < 1e-6, "{corner:?}");
        let value = 0.6_f32;
        let light = |c: f32| ((f64::from(c) + 0.055) / 1.055).powf(2.4);
        let [seen, ..] = vignette.apply(39, 19, 1.0, [value; 3]);
        let expected = 1.0 - 1.6 * f64::from(vignette.at(39.0, 19.0, 1.0).squared_radius);
        assert!((light(seen) / light(value) - expected).abs() < 1e-5, "{seen}");
        let [back, ..] = vignette.undo(39, 19, 1.0, [seen; 3]);
        assert!((back - value).abs() < 1e-6, "{back}");
        // The background of a transparent photograph stays as it is.
        assert_eq!(vignette.at(39.0, 19.0, 0.0).factor, 1.0);
    }

    #[test]
    fn slopes_are_central_differences_and_zero_at_the_limits() {
        for (a, x) in [(-1.0, 35.0), (-2.5, 30.0), (-0.2, 0.0)] {
            let at =
                |a: f32| Vignette { coefficients: [a, 0.1, -0.3], place: PLACE }.at(x, 15.0, 0.75);
            let (low, high) = (at(a - 1e-2), at(a + 1e-2));
            let s = at(a).squared_radius;
            let difference = (high.factor - low.factor) / (2e-2 * s);
            assert!((at(a).slope / difference - 1.0).abs() < 1e-3, "{a}: {difference} {:?}", at(a));
        }
        for a in [2.0, -9.0] {
            let limited =
                Vignette { coefficients: [a, 0.0, 0.0], place: PLACE }.at(39.0, 19.0, 1.0);
            assert_eq!(limited.slope, 0.0, "{limited:?}");
            assert!((0.17..=1.0001).contains(&limited.factor), "{limited:?}");
        }
    }
}
