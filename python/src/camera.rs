//! Cameras from Python, and renderings for it.

use densify_core::camera::Camera;
use densify_data::dataset::normalise::Normalisation;
use densify_render::Rendering;
use glam::{DMat3, DMat4, DVec3};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arrays::shaped;

/// Largest deviation of RᵀR from the identity: matrices of f32 deviate by 1e-7.
const ORTHONORMAL: f64 = 1e-4;

/// A camera as `densify.Camera` passes it: width, height, (fx, fy, cx, cy), and camera_from_world, row by row.
pub(crate) type CameraParts = (u32, u32, [f64; 4], [[f64; 4]; 4]);

/// Checks a camera.
///
/// # Errors
/// `ValueError` when a number is not finite or out of range, or the matrix is no rotation with a translation.
pub(crate) fn camera((width, height, [fx, fy, cx, cy], rows): CameraParts) -> PyResult<Camera> {
    let wrong = |problem: &str| Err(PyValueError::new_err(format!("camera: {problem}")));
    if width == 0 || height == 0 || width > 65_535 || height > 65_535 {
        return wrong("width and height must be from 1 to 65535 pixels");
    }
    if ![fx, fy].iter().all(|focal| focal.is_finite() && *focal > 0.0) {
        return wrong("fx and fy must be positive");
    }
    if ![cx, cy].iter().all(|centre| centre.is_finite()) {
        return wrong("cx and cy must be finite");
    }
    if !rows.iter().flatten().all(|value| value.is_finite()) {
        return wrong("camera_from_world has a value that is not finite");
    }
    if rows[3]
        .iter()
        .zip([0.0, 0.0, 0.0, 1.0])
        .any(|(value, unit)| (value - unit).abs() > ORTHONORMAL)
    {
        return wrong("the last row of camera_from_world must be 0, 0, 0, 1");
    }
    let matrix = DMat4::from_cols_array_2d(&rows).transpose();
    let rotation = DMat3::from_mat4(matrix);
    let product = rotation.transpose() * rotation - DMat3::IDENTITY;
    if product.to_cols_array().iter().any(|value| value.abs() > ORTHONORMAL)
        || rotation.determinant() < 0.0
    {
        return wrong("the upper left 3×3 part of camera_from_world must be a rotation");
    }
    let translation: DVec3 = matrix.w_axis.truncate();
    Ok(Camera { width, height, fx, fy, cx, cy, rotation, translation })
}

/// A camera for Python.
pub(crate) fn parts(camera: &Camera) -> CameraParts {
    let r = camera.rotation.transpose();
    let t = camera.translation;
    let row = |row: DVec3, last: f64| [row.x, row.y, row.z, last];
    let rows = [row(r.x_axis, t.x), row(r.y_axis, t.y), row(r.z_axis, t.z), [0.0, 0.0, 0.0, 1.0]];
    (camera.width, camera.height, [camera.fx, camera.fy, camera.cx, camera.cy], rows)
}

/// Colour, alpha and depth as arrays; depth in the dataset's units.
pub(crate) fn arrays(
    py: Python<'_>,
    rendering: Rendering,
    normalisation: &Normalisation,
) -> PyResult<(Py<PyAny>, Py<PyAny>, Py<PyAny>)> {
    let (height, width) = (rendering.height as usize, rendering.width as usize);
    let units = (1.0 / normalisation.scale) as f32;
    let depth = rendering.depth.into_iter().map(|depth| depth * units).collect();
    Ok((
        shaped(py, rendering.rgb, [height, width, 3])?.unbind(),
        shaped(py, rendering.alpha, [height, width])?.unbind(),
        shaped(py, depth, [height, width])?.unbind(),
    ))
}

/// A photograph as an array. Shape: `[height, width, 3]`.
pub(crate) fn photograph(
    py: Python<'_>,
    image: &densify_core::image::Image8,
) -> PyResult<Py<PyAny>> {
    let shape = [image.height as usize, image.width as usize, 3];
    Ok(PyArray1::from_slice(py, &image.rgb).reshape(shape)?.into_any().unbind())
}
