//! The layout of a checkpoint file, and the names and shapes of the model's arrays in it.

use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};

use densify_core::gaussians::{ModelArray, sh_coefficients};

/// Version of the format that is written and read.
pub const VERSION: u32 = 2;
// Keys of the metadata.
pub(super) const VERSION_KEY: &str = "densify.version";
pub(super) const HEADER_KEY: &str = "densify.header";
pub(super) const CHECKSUM_KEY: &str = "densify.crc32c";
/// Size of the field that states the header's length `[bytes]`.
pub(super) const LENGTH_FIELD_BYTES: u64 = 8;

/// Description of an array in the file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Record {
    pub(super) name: String,
    pub(super) kind: Dtype,
    pub(super) shape: Vec<usize>,
    /// CRC-32C of the values.
    pub(super) crc32c: u32,
}

/// The JSON in the metadata.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Contents<H> {
    pub(super) header: H,
    pub(super) tensors: Vec<Record>,
}

impl Record {
    /// The number of values; `None` if it overflows.
    pub(super) fn value_count(&self) -> Option<usize> {
        self.shape.iter().try_fold(1_usize, |product, &side| product.checked_mul(side))
    }

    /// The number of bytes; `None` if it overflows.
    pub(super) fn bytes(&self) -> Option<usize> {
        self.value_count()?.checked_mul(self.kind.bitsize() / 8)
    }
}

/// The name of a model array in the file.
pub(super) fn name_of(array: ModelArray) -> &'static str {
    match array {
        ModelArray::Means => "model.means",
        ModelArray::LogScales => "model.log_scales",
        ModelArray::Quats => "model.quats",
        ModelArray::OpacityLogits => "model.opacity_logits",
        ModelArray::Sh => "model.sh",
    }
}

/// The shape of a model array; `sh_degree` is at most
/// [`MAX_SH_DEGREE`](densify_core::gaussians::MAX_SH_DEGREE).
pub(super) fn shape_of(array: ModelArray, rows: usize, sh_degree: u8) -> Vec<usize> {
    match array {
        ModelArray::OpacityLogits => vec![rows],
        ModelArray::Sh => vec![rows, sh_coefficients(sh_degree), 3],
        _ => vec![rows, array.parameters(sh_degree).len()],
    }
}
