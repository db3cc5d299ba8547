//! Affine colour transforms, which model the exposure of a photograph, and their gradients.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// An affine colour transform: c ↦ `matrix`·c + `offset`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ColourTransform {
    /// Row-major.
    pub matrix: [[f32; 3]; 3],
    /// Per channel.
    pub offset: [f32; 3],
}

/// Derivatives of a loss with respect to a [`ColourTransform`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColourGradient {
    /// Row-major.
    pub matrix: [[f32; 3]; 3],
    /// Per channel.
    pub offset: [f32; 3],
}

/// Sums over the pixels of a transformed image, from which [`ColourTransform::gradient`] is computed. C' is the
/// transformed colour, g the derivative of the loss with respect to it, T the transmittance to the background.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ExposureSums {
    /// Σ gᵢ·C'ⱼ, row-major.
    pub by_colour: [[f64; 3]; 3],
    /// Σ gᵢ.
    pub plain: [f64; 3],
    /// Σ gᵢ·T.
    pub behind: [f64; 3],
}

impl ColourTransform {
    /// The transform that changes no colour.
    pub const IDENTITY: Self =
        Self { matrix: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], offset: [0.0; 3] };

    /// The transformed colour.
    pub fn apply(&self, colour: [f32; 3]) -> [f32; 3] {
        let [r, g, b] = colour;
        std::array::from_fn(|i| {
            let [x, y, z] = self.matrix[i];
            x * r + y * g + z * b + self.offset[i]
        })
    }

    /// The inverse transform; the identity if this one is singular.
    pub fn inverse(&self) -> Self {
        let inverse = self.inverse_matrix();
        let offset = -(inverse * DVec3::from(self.offset.map(f64::from)));
        let matrix = std::array::from_fn(|i| inverse.row(i).as_vec3().to_array());
        let back = Self { matrix, offset: offset.as_vec3().to_array() };
        if back.is_finite() { back } else { Self::IDENTITY }
    }

    /// The colour that the transform turns into `background`. A scene rendered over this colour has the
    /// same background in every photograph, whatever the exposure.
    pub fn behind(&self, background: [f32; 3]) -> [f32; 3] {
        self.inverse().apply(background)
    }

    /// Returns whether all coefficients are finite.
    pub fn is_finite(&self) -> bool {
        self.matrix.as_flattened().iter().chain(&self.offset).all(|x| x.is_finite())
    }

    fn inverse_matrix(&self) -> DMat3 {
        let rows = self.matrix.map(|row| row.map(f64::from));
        DMat3::from_cols_array_2d(&rows).transpose().inverse()
    }

    /// The gradient of the loss with respect to this transform, for an image rendered over the colour that
    /// [`behind`](Self::behind) returns for `background`.
    pub fn gradient(&self, background: [f32; 3], sums: &ExposureSums) -> ColourGradient {
        let inverse = self.inverse_matrix();
        let behind = self.behind(background);
        let offset = self.offset.map(f64::from);
        let matrix = std::array::from_fn(|i| {
            // Σ gᵢ·C over the colours C before the transform, minus the background's contribution.
            let exposed = DVec3::from(sums.by_colour[i]) - sums.plain[i] * DVec3::from(offset);
            let unexposed = inverse * exposed;
            let of_background = sums.behind[i] * DVec3::from(behind.map(f64::from));
            (unexposed - of_background).as_vec3().to_array()
        });
        let offset = std::array::from_fn(|i| (sums.plain[i] - sums.behind[i]) as f32);
        ColourGradient { matrix, offset }
    }

    /// The transform as a 3×4 matrix, as INRIA's trainer writes it.
    pub fn rows(&self) -> [[f32; 4]; 3] {
        std::array::from_fn(|i| {
            let [x, y, z] = self.matrix[i];
            [x, y, z, self.offset[i]]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXAMPLE: ColourTransform = ColourTransform {
        matrix: [[1.25, 0.0625, -0.125], [0.0, 0.75, 0.25], [-0.0625, 0.125, 1.5]],
        offset: [0.03, -0.05, 0.1],
    };

    #[test]
    fn the_inverse_restores_colours() {
        let colour = [0.2, 0.9, 0.4];
        let back = EXAMPLE.inverse().apply(EXAMPLE.apply(colour));
        assert!(back.iter().zip(colour).all(|(a, b)| (a - b).abs() < 1e-6), "{back:?}");
        let flat = ColourTransform { matrix: [[1.0; 3]; 3], ..EXAMPLE };
        assert_eq!(flat.inverse(), ColourTransform::IDENTITY, "this transform has no inverse");
    }

    #[test]
    fn the_background_looks_the_same_with_any_exposure() {
        let background = [0.0, 0.5, 1.0];
        let seen = EXAMPLE.apply(EXAMPLE.behind(background));
        assert!(seen.iter().zip(background).all(|(a, b)| (a - b).abs() < 1e-6), "{seen:?}");
    }

    /// A pixel with foreground F and transmittance T shows matrix·F + offset·(1 − T) + T·background.
    #[test]
    fn gradients_exclude_the_background() {
        let (foreground, t, background) = ([0.3, 0.2, 0.6], 0.25_f32, [0.5, 1.0, 0.125]);
        let upstream = [0.7, -1.1, 0.4];
        let behind = EXAMPLE.behind(background);
        let pixel: [f32; 3] = std::array::from_fn(|i| foreground[i] + t * behind[i]);
        let shown = EXAMPLE.apply(pixel);
        let expected: [f32; 3] = std::array::from_fn(|i| {
            let [x, y, z] = EXAMPLE.matrix[i];
            let [r, g, b] = foreground;
            x * r + y * g + z * b + EXAMPLE.offset[i] * (1.0 - t) + t * background[i]
        });
        assert!(shown.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{shown:?}");
        let g = upstream.map(f64::from);
        let sums = ExposureSums {
            by_colour: g.map(|g| shown.map(|colour| g * f64::from(colour))),
            plain: g,
            behind: g.map(|g| g * f64::from(t)),
        };
        let gradient = EXAMPLE.gradient(background, &sums);
        for (i, upstream) in upstream.into_iter().enumerate() {
            for (j, foreground) in foreground.into_iter().enumerate() {
                let error = gradient.matrix[i][j] - upstream * foreground;
                assert!(error.abs() < 1e-6, "{i}, {j}: {gradient:?}");
            }
            let error = gradient.offset[i] - upstream * (1.0 - t);
            assert!(error.abs() < 1e-6, "{i}: {gradient:?}");
        }
    }
}
