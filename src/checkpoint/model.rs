//! The model's arrays: from [`Gaussians`] and back.

use super::CheckpointError;
use crate::backend::{StateError, Tensor};
use crate::gaussians::{Gaussians, MAX_SH_DEGREE, sh_coefficients};

/// Names of the arrays, in the order of the file.
pub(super) const NAMES: [&str; 5] =
    ["model.means", "model.log_scales", "model.quats", "model.opacity_logits", "model.sh"];

/// One of the arrays of [`NAMES`], of some rows.
pub(super) fn tensor(which: usize, model: Gaussians) -> Tensor {
    let rows = model.len();
    let name = NAMES[which];
    match which {
        0 => Tensor::f32(name, &[rows, 3], model.means.into_flattened()),
        1 => Tensor::f32(name, &[rows, 3], model.log_scales.into_flattened()),
        2 => Tensor::f32(name, &[rows, 4], model.quats.into_flattened()),
        3 => Tensor::f32(name, &[rows], model.opacity_logits),
        _ => Tensor::f32(name, &[rows, sh_coefficients(model.sh_degree), 3], model.sh),
    }
}

/// The model of so many rows, from a source of arrays by name.
pub(super) fn model(
    rows: usize,
    sh_degree: u8,
    mut read: impl FnMut(&'static str) -> Result<Tensor, CheckpointError>,
    fail: impl Fn(StateError) -> CheckpointError,
) -> Result<Gaussians, CheckpointError> {
    let coefficients = sh_coefficients(sh_degree.min(MAX_SH_DEGREE));
    let mut next =
        |which: usize, shape: &[usize]| read(NAMES[which])?.into_f32(shape).map_err(&fail);
    Ok(Gaussians {
        sh_degree,
        means: in_rows(next(0, &[rows, 3])?),
        log_scales: in_rows(next(1, &[rows, 3])?),
        quats: in_rows(next(2, &[rows, 4])?),
        opacity_logits: next(3, &[rows])?,
        sh: next(4, &[rows, coefficients, 3])?,
    })
}

/// The same numbers, N to a row; where they are, if that can be.
fn in_rows<const N: usize>(values: Vec<f32>) -> Vec<[f32; N]> {
    bytemuck::try_cast_vec(values).unwrap_or_else(|(_, values)| values.as_chunks().0.to_vec())
}
