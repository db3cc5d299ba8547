//! Writes checkpoints array by array, some rows at a time, to limit memory.

use std::collections::BTreeMap;
use std::io;
use std::ops::Range;
use std::path::Path;

use safetensors::tensor::{Dtype, Metadata, TensorInfo};
use serde::Serialize;

use super::format::{
    CHECKSUM_KEY, Contents, HEADER_KEY, LENGTH_FIELD_BYTES, Record, VERSION, VERSION_KEY, name_of,
    shape_of,
};
use super::{CheckpointError, Header};
use densify_core::files::{WriteError, write_atomically_from};
use densify_core::gaussians::ModelArray;
use densify_core::pieces::pieces;
use densify_render::{Backend, BackendError, StateArray, Tensor, Values};

/// Writes the header of a checkpoint, and the model and state of the backend. The file appears under its name when it
/// is complete and on disk; an existing file stays until then.
///
/// # Errors
/// [`CheckpointError::File`], [`CheckpointError::Backend`].
pub fn write(path: &Path, header: &Header, backend: &dyn Backend) -> Result<(), CheckpointError> {
    write_atomically_from(path, |out| {
        // The arrays are encoded twice, because the header, which comes first, contains their checksums.
        let records = write_arrays(backend, |_| Ok(()))?;
        let bytes = header_bytes(header, &records)?;
        out.write_all(&(bytes.len() as u64).to_le_bytes())?;
        out.write_all(&bytes)?;
        let written = write_arrays(backend, |bytes| out.write_all(bytes))?;
        match records.iter().zip(&written).find(|(was, is)| was != is) {
            Some((Record { name, .. }, _)) => {
                Err(io::Error::other(format!("`{name}` changed while it was written")).into())
            }
            None => Ok(()),
        }
    })
}

/// Passes the arrays of the model and of the backend's state to `sink`, some rows at a time, in the
/// order of the file; returns their descriptions.
fn write_arrays(
    backend: &dyn Backend,
    mut sink: impl FnMut(&[u8]) -> io::Result<()>,
) -> Result<Vec<Record>, WriteError<CheckpointError>> {
    let (rows, sh_degree) = (backend.rows(), backend.sh_degree());
    let mut records = Vec::new();
    for array in ModelArray::ALL {
        let piece = |rows: Range<usize>| {
            let shape = shape_of(array, rows.len(), sh_degree);
            let values = backend.download_array(array, rows)?;
            Ok(Tensor::f32(name_of(array), &shape, values))
        };
        records.push(Record::write(pieces(rows).map(piece), &mut sink)?);
    }
    for StateArray { name, by_rows } in backend.state() {
        let piece = |rows| backend.save_rows(&name, rows);
        records.push(if by_rows {
            Record::write(pieces(rows).map(piece), &mut sink)?
        } else {
            Record::write([piece(0..rows)], &mut sink)?
        });
    }
    Ok(records)
}

impl Record {
    /// Passes the bytes of an array, which consists of one or more pieces of rows, to `sink`; returns its
    /// description.
    fn write(
        pieces: impl IntoIterator<Item = Result<Tensor, BackendError>>,
        mut sink: impl FnMut(&[u8]) -> io::Result<()>,
    ) -> Result<Self, WriteError<CheckpointError>> {
        let mut record = Self { name: String::new(), kind: Dtype::U8, shape: vec![], crc32c: 0 };
        let mut rows = 0;
        for piece in pieces {
            let Tensor { name, shape, values } =
                piece.map_err(|error| WriteError::Source(error.into()))?;
            rows += shape.first().copied().unwrap_or(0);
            let encoded = values.encode(|bytes| {
                record.crc32c = crc32c::crc32c_append(record.crc32c, bytes);
                sink(bytes)
            });
            encoded?;
            record.kind = match values {
                Values::F32(_) => Dtype::F32,
                Values::U16(_) => Dtype::U16,
                Values::U8(_) => Dtype::U8,
            };
            (record.name, record.shape) = (name, shape);
        }
        if let Some(first) = record.shape.first_mut() {
            *first = rows;
        }
        Ok(record)
    }
}

/// The safetensors header. The library's own type writes the metadata in an order that changes from run to run.
#[derive(Serialize)]
struct Table {
    #[serde(rename = "__metadata__")]
    metadata: BTreeMap<&'static str, String>,
    #[serde(flatten)]
    tensors: Metadata,
}

/// Encodes the safetensors header, padded to align the arrays.
fn header_bytes(header: &Header, records: &[Record]) -> io::Result<Vec<u8>> {
    let contents = Contents { header, tensors: records.to_vec() };
    let json = serde_json::to_string(&contents)?;
    let metadata = BTreeMap::from([
        (VERSION_KEY, VERSION.to_string()),
        (CHECKSUM_KEY, format!("{:08x}", crc32c::crc32c(json.as_bytes()))),
        (HEADER_KEY, json),
    ]);
    let mut end = 0;
    let infos = records.iter().map(|record| {
        let start = end;
        end += record.bytes().unwrap_or(usize::MAX);
        let info = TensorInfo {
            dtype: record.kind,
            shape: record.shape.clone(),
            data_offsets: (start, end),
        };
        (record.name.clone(), info)
    });
    let tensors = Metadata::new(None, infos.collect()).map_err(io::Error::other)?;
    let mut bytes = serde_json::to_vec(&Table { metadata, tensors })?;
    bytes.resize(bytes.len().next_multiple_of(LENGTH_FIELD_BYTES as usize), b' ');
    Ok(bytes)
}
