//! Names and shapes of the model's arrays in a checkpoint.

use crate::gaussians::{ModelArray, sh_coefficients};

/// The name of an array.
pub(super) fn name(array: ModelArray) -> &'static str {
    match array {
        ModelArray::Means => "model.means",
        ModelArray::LogScales => "model.log_scales",
        ModelArray::Quats => "model.quats",
        ModelArray::OpacityLogits => "model.opacity_logits",
        ModelArray::Sh => "model.sh",
    }
}

/// The shape of an array of so many rows; `sh_degree` is at most
/// [`MAX_SH_DEGREE`](crate::gaussians::MAX_SH_DEGREE).
pub(super) fn shape(array: ModelArray, rows: usize, sh_degree: u8) -> Vec<usize> {
    match array {
        ModelArray::OpacityLogits => vec![rows],
        ModelArray::Sh => vec![rows, sh_coefficients(sh_degree), 3],
        _ => vec![rows, array.parameters(sh_degree).len()],
    }
}
