//! The model's arrays: from [`Gaussians`] and back.

use super::CheckpointError;
use crate::backend::{StateError, Tensor};
use crate::gaussians::{Gaussians, MAX_SH_DEGREE, sh_coefficients};

/// Names of the arrays, in the order of the file.
pub(super) const NAMES: [&str; 5] =
    ["model.means", "model.log_scales", "model.quats", "model.opacity_logits", "model.sh"];

/// The arrays of [`NAMES`]. None is copied: a model may be most of what there is memory for.
pub(super) fn tensors(model: Gaussians) -> [Tensor; NAMES.len()] {
    let rows = model.len();
    let [means, log_scales, quats, opacity_logits, sh] = NAMES;
    let coefficients = sh_coefficients(model.sh_degree);
    [
        Tensor::f32(means, &[rows, 3], model.means.into_flattened()),
        Tensor::f32(log_scales, &[rows, 3], model.log_scales.into_flattened()),
        Tensor::f32(quats, &[rows, 4], model.quats.into_flattened()),
        Tensor::f32(opacity_logits, &[rows], model.opacity_logits),
        Tensor::f32(sh, &[rows, coefficients, 3], model.sh),
    ]
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
        means: next(0, &[rows, 3])?.as_chunks::<3>().0.to_vec(),
        log_scales: next(1, &[rows, 3])?.as_chunks::<3>().0.to_vec(),
        quats: next(2, &[rows, 4])?.as_chunks::<4>().0.to_vec(),
        opacity_logits: next(3, &[rows])?,
        sh: next(4, &[rows, coefficients, 3])?,
    })
}
