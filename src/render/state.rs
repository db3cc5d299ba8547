//! A backend's state other than the model, as named arrays for checkpoints.
//!
//! An array of rows has one entry per row in use, in the order of the rows, whatever the backend's own layout. The
//! parameters of a row are in this order: mean 3, log-scale 3, quaternion (w, x, y, z) 4,
//! opacity logit 1, then three per spherical-harmonic coefficient (red, green, blue).

use std::io;

/// Number of values converted to bytes at a time.
const CHUNK: usize = 1 << 14;

/// The name and kind of a state array.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StateArray {
    /// The name, unique within a backend.
    pub name: String,
    /// True if its first dimension is the rows, so that it can be copied in pieces. All other arrays are small.
    pub by_rows: bool,
}

impl StateArray {
    /// An array with one entry per row.
    pub(super) fn of_rows(name: impl Into<String>) -> Self {
        Self { name: name.into(), by_rows: true }
    }

    /// A small array that does not have one entry per row.
    pub(super) fn small(name: impl Into<String>) -> Self {
        Self { name: name.into(), by_rows: false }
    }
}

/// A named array.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// The name, unique within a checkpoint.
    pub name: String,
    /// The dimensions; row-major.
    pub shape: Vec<usize>,
    /// The values, as many as the product of the dimensions.
    pub values: Values,
}

impl Tensor {
    /// Returns whether the array of this name holds the optimiser's [ages](Self::ages).
    pub fn has_ages(name: &str) -> bool {
        // The names in the native and in the GPU backend.
        matches!(name, "ages" | "device.ages")
    }

    /// Number of steps since each row was last created or rewritten; `None` for an array without ages. Shape: `[rows]`.
    pub fn ages(&self) -> Option<Vec<u32>> {
        match &self.values {
            _ if !Self::has_ages(&self.name) => None,
            Values::U16(ages) => Some(ages.iter().map(|&age| age.into()).collect()),
            // One word per row; the upper half is the age of bands 1–3, which may step separately.
            Values::U8(bytes) => {
                let words = bytes.as_chunks::<4>().0.iter();
                Some(words.map(|&[low, high, ..]| u16::from_le_bytes([low, high]).into()).collect())
            }
            Values::F32(_) => None,
        }
    }
}

/// The values of a [`Tensor`].
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// 32-bit floats.
    F32(Vec<f32>),
    /// 16-bit counts.
    U16(Vec<u16>),
    /// Flags and other bytes.
    U8(Vec<u8>),
}

/// Wrong name, type or shape of a state array.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("tensor `{name}`: {problem}")]
pub struct StateError {
    /// The array's name.
    pub name: String,
    /// What is wrong with the array.
    pub problem: String,
}

impl Values {
    /// Number of values.
    pub fn len(&self) -> usize {
        match self {
            Self::F32(values) => values.len(),
            Self::U16(values) => values.len(),
            Self::U8(values) => values.len(),
        }
    }

    /// Returns whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Writes the values to `sink` as little-endian bytes, in chunks.
    ///
    /// # Errors
    /// The first error of `sink`.
    pub fn encode(&self, mut sink: impl FnMut(&[u8]) -> io::Result<()>) -> io::Result<()> {
        let mut bytes = Vec::new();
        match self {
            Self::F32(values) => values.chunks(CHUNK).try_for_each(|chunk| {
                bytes.clear();
                bytes.extend(chunk.iter().flat_map(|value| value.to_le_bytes()));
                sink(&bytes)
            }),
            Self::U16(values) => values.chunks(CHUNK).try_for_each(|chunk| {
                bytes.clear();
                bytes.extend(chunk.iter().flat_map(|value| value.to_le_bytes()));
                sink(&bytes)
            }),
            Self::U8(values) => sink(values),
        }
    }

    /// The name of the type in safetensors.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::F32(_) => "F32",
            Self::U16(_) => "U16",
            Self::U8(_) => "U8",
        }
    }
}

impl Tensor {
    /// An array of floats.
    pub fn f32(name: impl Into<String>, shape: &[usize], values: Vec<f32>) -> Self {
        Self::new(name, shape, Values::F32(values))
    }

    /// An array of counts.
    pub fn u16(name: impl Into<String>, shape: &[usize], values: Vec<u16>) -> Self {
        Self::new(name, shape, Values::U16(values))
    }

    /// An array of bytes.
    pub fn u8(name: impl Into<String>, shape: &[usize], values: Vec<u8>) -> Self {
        Self::new(name, shape, Values::U8(values))
    }

    fn new(name: impl Into<String>, shape: &[usize], values: Values) -> Self {
        debug_assert_eq!(shape.iter().product::<usize>(), values.len(), "a tensor's size");
        Self { name: name.into(), shape: shape.to_owned(), values }
    }

    /// Returns the floats of an array that must have this shape.
    ///
    /// # Errors
    /// [`StateError`] when shape or type differ.
    pub fn into_f32(self, shape: &[usize]) -> Result<Vec<f32>, StateError> {
        self.check(shape)?;
        match self.values {
            Values::F32(values) => Ok(values),
            other => Err(wrong_kind(self.name, "F32", &other)),
        }
    }

    /// Returns the counts of an array that must have this shape.
    ///
    /// # Errors
    /// [`StateError`] when shape or type differ.
    pub(crate) fn into_u16(self, shape: &[usize]) -> Result<Vec<u16>, StateError> {
        self.check(shape)?;
        match self.values {
            Values::U16(values) => Ok(values),
            other => Err(wrong_kind(self.name, "U16", &other)),
        }
    }

    /// Returns the bytes of an array that must have this shape.
    ///
    /// # Errors
    /// [`StateError`] when shape or type differ.
    pub(crate) fn into_u8(self, shape: &[usize]) -> Result<Vec<u8>, StateError> {
        self.check(shape)?;
        match self.values {
            Values::U8(values) => Ok(values),
            other => Err(wrong_kind(self.name, "U8", &other)),
        }
    }

    /// An error about this array.
    pub fn error(&self, problem: impl Into<String>) -> StateError {
        StateError { name: self.name.clone(), problem: problem.into() }
    }

    fn check(&self, shape: &[usize]) -> Result<(), StateError> {
        if self.shape == shape && shape.iter().product::<usize>() == self.values.len() {
            return Ok(());
        }
        Err(self.error(format!("its shape is {:?}; this run needs {shape:?}", self.shape)))
    }
}

fn wrong_kind(name: String, expected: &str, values: &Values) -> StateError {
    let problem = format!("its type is {}; this run needs {expected}", values.kind());
    StateError { name, problem }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_and_types_are_checked() {
        let ages = || Tensor::u16("ages", &[2], vec![1, 2]);
        assert_eq!(ages().into_u16(&[2]), Ok(vec![1, 2]));
        let message = ages().into_u16(&[3]).unwrap_err().to_string();
        assert!(message.contains("`ages`") && message.contains("[2]; this run needs [3]"));
        let message = ages().into_f32(&[2]).unwrap_err().to_string();
        assert!(message.contains("U16; this run needs F32"), "{message}");
        assert!(ages().into_u8(&[2]).is_err());
        let short = Tensor { shape: vec![3], ..ages() };
        assert!(short.into_u16(&[3]).is_err(), "two values are not three");
    }
}
