//! The layout of a checkpoint file.

use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};

/// Version of the format, for writing and reading.
pub const VERSION: u32 = 2;
// Keys of the metadata.
pub(super) const VERSION_KEY: &str = "densify.version";
pub(super) const HEADER_KEY: &str = "densify.header";
pub(super) const CHECKSUM_KEY: &str = "densify.crc32c";
/// Size of the length before the header `[bytes]`.
pub(super) const LENGTH: u64 = 8;

/// Description of an array.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Record {
    pub(super) name: String,
    pub(super) kind: Dtype,
    pub(super) shape: Vec<usize>,
    /// CRC-32C of its bytes.
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
    pub(super) fn values(&self) -> Option<usize> {
        self.shape.iter().try_fold(1_usize, |product, &side| product.checked_mul(side))
    }

    pub(super) fn bytes(&self) -> Option<usize> {
        self.values()?.checked_mul(self.kind.bitsize() / 8)
    }
}
