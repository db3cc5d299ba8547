//! Accessors of a glTF document: arrays of numbers in its buffers, with their bounds checked.

use std::path::Path;

use serde::Deserialize;

use super::layout::SHAPES;
use crate::error::LoadError;

/// An array of numbers.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    #[serde(rename = "type")]
    shape: String,
    sparse: Option<serde::de::IgnoredAny>,
}

/// A part of a buffer.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

/// The binary data of a document.
pub(super) struct Buffers<'a> {
    pub(super) path: &'a Path,
    pub(super) accessors: &'a [Accessor],
    pub(super) views: &'a [View],
    pub(super) buffers: Vec<Vec<u8>>,
}

impl Buffers<'_> {
    /// The bytes of a view.
    pub(super) fn view(&self, index: usize) -> Result<&[u8], LoadError> {
        let bytes = self.views.get(index).and_then(|view| {
            let end = view.byte_offset.checked_add(view.byte_length)?;
            self.buffers.get(view.buffer)?.get(view.byte_offset..end)
        });
        let problem = "it does not exist, or reaches beyond its buffer (truncated?)";
        bytes.ok_or_else(|| LoadError::damaged(self.path, format!("bufferViews {index}"), problem))
    }

    /// The numbers of an accessor for the attribute `name`, with `width` numbers per element.
    pub(super) fn numbers(
        &self,
        name: &str,
        index: usize,
        width: usize,
    ) -> Result<Vec<f32>, LoadError> {
        let wrong = |problem: &str| LoadError::damaged(self.path, name, problem);
        let accessor =
            self.accessors.get(index).ok_or_else(|| wrong("there is no such accessor"))?;
        let shape = SHAPES[width];
        if accessor.shape != shape {
            return Err(wrong(&format!("it is not {shape}")));
        }
        let Some(view) = accessor.buffer_view.filter(|_| accessor.sparse.is_none()) else {
            return Err(wrong("sparse accessors, and those without data, are not read"));
        };
        let bytes = self.view(view)?.get(accessor.byte_offset..).unwrap_or_default();
        let scale = |largest: f32| if accessor.normalized { 1.0 / largest } else { 1.0 };
        // The smallest signed integer is one step below −1 when normalised (glTF 2.0, section 3.11).
        let min = if accessor.normalized { -1.0 } else { f32::NEG_INFINITY };
        let size = match accessor.component_type {
            5120 | 5121 => 1,
            5122 | 5123 => 2,
            5126 => 4,
            _ => return Err(wrong("its numbers must be floats, bytes or shorts")),
        };
        let number = |bytes: &[u8]| match (accessor.component_type, bytes) {
            (5120, &[a]) => (f32::from(a as i8) * scale(127.0)).max(min),
            (_, &[a]) => f32::from(a) * scale(255.0),
            (5122, &[a, b]) => (f32::from(i16::from_le_bytes([a, b])) * scale(32_767.0)).max(min),
            (_, &[a, b]) => f32::from(u16::from_le_bytes([a, b])) * scale(65_535.0),
            (_, bytes) => f32::from_le_bytes(std::array::from_fn(|i| bytes[i])),
        };
        let stride = self.views[view].byte_stride.unwrap_or(size * width);
        let needed = accessor
            .count
            .checked_sub(1)
            .map_or(Some(0), |others| others.checked_mul(stride)?.checked_add(size * width));
        if stride < size * width || needed.is_none_or(|needed| needed > bytes.len()) {
            return Err(wrong("it reaches beyond its view (truncated?)"));
        }
        let element = |row: usize| &bytes[row * stride..row * stride + size * width];
        let rows = (0..accessor.count).flat_map(|row| element(row).chunks_exact(size));
        Ok(rows.map(number).collect())
    }
}
