//! Similarity transforms of a model: a rotation, a uniform scale and a translation. The rotation also turns the
//! spherical harmonics.

use glam::{DMat3, DMat4, DQuat, DVec3};

use super::coordinates::{is_remote, middle_and_largest_spread};
use densify_core::gaussians::{Gaussians, sh_coefficients};
use densify_core::sh;

/// Deviations below this are rounding errors: of a matrix from a uniform scale, and of an entry of a colour rotation
/// from 0 or ±1. About ten times the relative precision of f32, in which transforms are mostly computed.
const ROUNDING: f64 = 1e-6;
/// Directions to which a colour rotation is fitted; a band has at most seven coefficients.
const DIRECTIONS: usize = 32;

/// A rotation, then a uniform scale, then a translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Similarity {
    rotation: DQuat,
    scale: f64,
    translation: DVec3,
}

impl Similarity {
    /// The transform of a matrix, if it is a similarity.
    pub(super) fn from_matrix(matrix: &DMat4) -> Option<Self> {
        let linear = DMat3::from_mat4(*matrix);
        let scale = linear.determinant().cbrt();
        if !matrix.is_finite() || !(1e-30..1e30).contains(&scale) {
            return None;
        }
        // Half turns and quarter turns stay exact.
        let rotation = linear * (1.0 / scale);
        let error = rotation * rotation.transpose() - DMat3::IDENTITY;
        let is_uniform = error.to_cols_array().iter().all(|v| v.abs() < ROUNDING);
        is_uniform.then(|| Self {
            rotation: DQuat::from_mat3(&rotation).normalize(),
            scale,
            translation: matrix.w_axis.truncate(),
        })
    }

    /// Transforms a model; the identity changes no bit. A pure translation only moves the model's origin, so that no
    /// position is rounded. With a rotation or a scale, only remote models, for which f32 may be too coarse, keep an
    /// origin of their own.
    pub(super) fn apply(&self, model: &mut Gaussians) {
        let Self { rotation, scale, translation } = *self;
        if rotation.abs_diff_eq(DQuat::IDENTITY, 0.0) && scale.to_bits() == 1f64.to_bits() {
            model.origin = (DVec3::from(model.origin) + translation).to_array();
            return;
        }
        let apply = |point: DVec3| scale * (rotation * point) + translation;
        let (middle, spread) = middle_and_largest_spread(model);
        let is_far = is_remote(apply(middle).to_array(), scale * spread);
        let origin = if is_far { apply(DVec3::from(model.origin)) } else { DVec3::ZERO };
        for row in 0..model.len() {
            let moved = apply(DVec3::from(model.position(row))) - origin;
            model.means[row] = moved.as_vec3().to_array();
        }
        model.origin = origin.to_array();
        for log in model.log_scales.as_flattened_mut() {
            *log = (f64::from(*log) + scale.ln()) as f32;
        }
        for quat in &mut model.quats {
            let [w, x, y, z] = quat.map(f64::from);
            let turned = rotation * DQuat::from_xyzw(x, y, z, w);
            *quat = [turned.w, turned.x, turned.y, turned.z].map(|v| v as f32);
        }
        self.rotate_colours(model);
    }

    fn rotate_colours(&self, model: &mut Gaussians) {
        let degree = model.sh_degree;
        let bands: Vec<Vec<f64>> =
            (1..=degree).map(|band| band_rotation(self.rotation, band)).collect();
        let mut turned = Vec::new();
        for row in model.sh.chunks_exact_mut(3 * sh_coefficients(degree)) {
            for (band, matrix) in (1..=usize::from(degree)).zip(&bands) {
                let (first, count) = (band * band, 2 * band + 1);
                turned.clear();
                for (k, channel) in (0..count).flat_map(|k| (0..3).map(move |c| (k, c))) {
                    let old = |j: usize| f64::from(row[3 * (first + j) + channel]);
                    let sum: f64 = (0..count).map(|j| matrix[count * k + j] * old(j)).sum();
                    turned.push(sum as f32);
                }
                row[3 * first..3 * (first + count)].copy_from_slice(&turned);
            }
        }
    }
}

/// Mirrors a model in the plane x = 0.
pub(super) fn mirror_x(model: &mut Gaussians) {
    // Subtracting keeps 0 positive.
    model.origin[0] = 0.0 - model.origin[0];
    model.means.iter_mut().for_each(|[x, ..]| *x = -*x);
    for [_, _, y, z] in &mut model.quats {
        (*y, *z) = (-*y, -*z);
    }
    // The coefficients of functions that are odd in x.
    let odd = [3, 4, 7, 10, 13, 15];
    for row in model.sh.chunks_exact_mut(3 * sh_coefficients(model.sh_degree)) {
        for (at, colour) in row.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            if odd.contains(&at) {
                colour.iter_mut().for_each(|value| *value = -*value);
            }
        }
    }
}

/// The matrix that rotates the coefficients of a band, by least squares over directions on a spiral: in the rotated
/// direction, the new coefficients give the colour that the old ones give in the original direction.
/// Shape: `[2·band + 1, 2·band + 1]`.
fn band_rotation(rotation: DQuat, band: u8) -> Vec<f64> {
    let (first, count) = (usize::from(band * band), usize::from(2 * band + 1));
    let basis = |d: DVec3| {
        let mut y = [0f32; 16];
        sh::basis(band, d.as_vec3().to_array(), &mut y);
        y.map(f64::from)
    };
    // The normal equations, row by row: the matrix, then the right-hand sides.
    let width = 2 * count;
    let mut rows = vec![0.0; count * width];
    for point in 0..DIRECTIONS {
        let z = 1.0 - (2 * point + 1) as f64 / DIRECTIONS as f64;
        let (sin, cos) = (2.399_963 * point as f64).sin_cos();
        let d = DVec3::new(cos * (1.0 - z * z).sqrt(), sin * (1.0 - z * z).sqrt(), z);
        let (old, new) = (basis(d), basis(rotation * d));
        for i in 0..count {
            for j in 0..count {
                rows[i * width + j] += new[first + i] * new[first + j];
                rows[i * width + count + j] += new[first + i] * old[first + j];
            }
        }
    }
    // Gauss-Jordan elimination; the matrix is close to a multiple of the identity, so no pivot is small.
    for i in 0..count {
        let pivot = rows[i * width + i];
        rows[i * width..(i + 1) * width].iter_mut().for_each(|v| *v /= pivot);
        for other in (0..count).filter(|&other| other != i) {
            let factor = rows[other * width + i];
            for j in 0..width {
                rows[other * width + j] -= factor * rows[i * width + j];
            }
        }
    }
    let entries = (0..count).flat_map(|i| (count..width).map(move |j| i * width + j));
    let exact = |v: f64| if (v - v.round()).abs() < ROUNDING { v.round() } else { v };
    entries.map(|at| exact(rows[at])).collect()
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests {
    use super::*;
    use crate::models::tests::model;

    /// Colour of a Gaussian in a direction.
    fn shown(model: &Gaussians, row: usize, d: DVec3) -> [f64; 3] {
        let mut y = [0f32; 16];
        y[0] = sh::C0;
        sh::basis(3, d.as_vec3().to_array(), &mut y);
        let sh = model.sh_of(row).as_chunks::<3>().0;
        [0, 1, 2].map(|c| sh.iter().zip(y).map(|(k, y)| f64::from(k[c]) * f64::from(y)).sum())
    }

    #[test]
    fn colours_rotate_with_the_model() {
        let before = model(3, 3);
        let rotation = DQuat::from_axis_angle(DVec3::new(0.3, -0.5, 0.8).normalize(), 1.1);
        let matrix = DMat4::from_scale_rotation_translation(DVec3::splat(2.0), rotation, DVec3::X);
        let transform = Similarity::from_matrix(&matrix).unwrap();
        let mut after = before.clone();
        transform.apply(&mut after);
        assert!(!after.is_local());
        for row in 0..3 {
            let mean = DVec3::from(before.means[row].map(f64::from));
            let found = DVec3::from(after.means[row].map(f64::from));
            assert!((2.0 * (rotation * mean) + DVec3::X - found).length() < 1e-6, "{found}");
            let larger = after.log_scales[row][1] - before.log_scales[row][1];
            assert!((larger - 2f32.ln()).abs() < 1e-6);
            for d in [DVec3::X, DVec3::new(0.6, 0.0, -0.8), DVec3::new(0.36, -0.8, 0.48)] {
                let (old, new) = (shown(&before, row, d), shown(&after, row, rotation * d));
                assert!((0..3).all(|c| (old[c] - new[c]).abs() < 2e-5), "{old:?} and {new:?}");
            }
        }
    }

    #[test]
    fn a_remote_model_keeps_its_precision() {
        let before = model(5, 0);
        let there = DVec3::new(512_345.25, 5_400_123.5, 81.0);
        let rotation = DQuat::from_axis_angle(DVec3::Z, 0.7);
        let matrix = DMat4::from_scale_rotation_translation(DVec3::splat(0.5), rotation, there);
        let mut after = before.clone();
        Similarity::from_matrix(&matrix).unwrap().apply(&mut after);
        assert_eq!(after.origin, there.to_array());
        for row in 0..5 {
            let expected = matrix.transform_point3(DVec3::from(before.position(row)));
            assert!((DVec3::from(after.position(row)) - expected).length() < 1e-6);
        }
    }

    #[test]
    fn a_half_turn_changes_only_signs_and_the_identity_changes_nothing() {
        let before = model(2, 3);
        let mut after = before.clone();
        Similarity::from_matrix(&DMat4::IDENTITY).unwrap().apply(&mut after);
        assert_eq!(after, before);
        let turn = Similarity::from_matrix(&DMat4::from_quat(DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0)));
        let turn = turn.unwrap();
        turn.apply(&mut after);
        assert_ne!(after, before);
        assert!(after.sh.iter().zip(&before.sh).all(|(a, b)| a.abs() == b.abs()));
        turn.apply(&mut after);
        assert_eq!((after.means, after.sh), (before.means, before.sh));
    }

    #[test]
    fn a_mirrored_model_shows_mirrored_colours() {
        let before = model(3, 3);
        let mut after = before.clone();
        mirror_x(&mut after);
        let mirror = DVec3::new(-1.0, 1.0, 1.0);
        for row in 0..3 {
            let d = DVec3::new(0.36, -0.8, 0.48);
            let (old, new) = (shown(&before, row, d), shown(&after, row, mirror * d));
            assert!((0..3).all(|c| (old[c] - new[c]).abs() < 1e-6), "{old:?} and {new:?}");
            let [old, new] = [&before, &after].map(|model| {
                let [w, x, y, z] = model.quats[row].map(f64::from);
                (model.means[row], DQuat::from_xyzw(x, y, z, w).normalize())
            });
            assert_eq!(new.0, [-old.0[0], old.0[1], old.0[2]]);
            // A mirrored ellipsoid has the mirrored axes, in either direction.
            let axis = (new.1 * DVec3::Y).dot(mirror * (old.1 * DVec3::Y));
            assert!((axis.abs() - 1.0).abs() < 1e-6, "{axis}");
        }
    }

    #[test]
    fn matrices_that_are_not_similarities_are_refused() {
        let uneven = DMat4::from_scale(DVec3::new(1.0, 1.0, 1.1));
        let mirrored = DMat4::from_scale(DVec3::new(1.0, 1.0, -1.0));
        for matrix in [uneven, mirrored, DMat4::ZERO, DMat4::from_scale(DVec3::NAN)] {
            assert_eq!(Similarity::from_matrix(&matrix), None);
        }
    }
}
