//! Writing: array by array and some rows at a time, so that no more than these are held.

use std::collections::HashMap;
use std::io;
use std::path::Path;

use safetensors::tensor::{Dtype, Metadata, TensorInfo};

use super::format::{CHECKSUM_KEY, Contents, HEADER_KEY, LENGTH, Record, VERSION, VERSION_KEY};
use super::{CheckpointError, Header, model};
use crate::backend::{Backend, BackendError, Tensor, Values, pieces};
use crate::output::write_atomically;

/// Writes the state of a run: `header`, and the model and all else that `backend` holds. The file
/// appears under its name when it is complete and on disk; whatever was there stays until then.
///
/// # Errors
/// [`CheckpointError::Write`], [`CheckpointError::Backend`].
pub fn write(path: &Path, header: &Header, backend: &dyn Backend) -> Result<(), CheckpointError> {
    // Twice over the arrays: the header, which comes first, has their checksums.
    let noted = records_of(backend, |_| Ok(()));
    let records = noted.map_err(|stop| stop.into_error(path))?;
    let mut lost = None;
    let written = write_atomically(path, |out| {
        let bytes = header_bytes(header, &records)?;
        out.write_all(&(bytes.len() as u64).to_le_bytes())?;
        out.write_all(&bytes)?;
        match records_of(backend, |bytes| out.write_all(bytes)) {
            Ok(written) => match records.iter().zip(&written).find(|(was, is)| was != is) {
                Some((was, _)) => {
                    Err(io::Error::other(format!("`{}` changed while it was written", was.name)))
                }
                None => Ok(()),
            },
            Err(Stop::Io(error)) => Err(error),
            Err(Stop::Backend(error)) => {
                lost = Some(error);
                Err(io::Error::other("the backend is lost"))
            }
        }
    });
    match lost {
        Some(error) => Err(error.into()),
        None => Ok(written?),
    }
}

/// Why arrays stop coming.
enum Stop {
    Io(io::Error),
    Backend(BackendError),
}

impl Stop {
    fn into_error(self, path: &Path) -> CheckpointError {
        match self {
            Self::Io(source) => CheckpointError::Read { path: path.to_owned(), source },
            Self::Backend(error) => error.into(),
        }
    }
}

/// The arrays of the model and of the backend's state, in the order of the file, whose bytes `sink` gets
/// some rows at a time.
fn records_of(
    backend: &dyn Backend,
    mut sink: impl FnMut(&[u8]) -> io::Result<()>,
) -> Result<Vec<Record>, Stop> {
    let rows = backend.rows();
    let mut records = Vec::new();
    for which in 0..model::NAMES.len() {
        let piece = |rows| Ok(model::tensor(which, backend.download_rows(rows)?));
        records.push(Record::of(pieces(rows).map(piece), &mut sink)?);
    }
    for name in backend.state() {
        let piece = |rows| backend.save_rows(&name, rows);
        records.push(match backend.is_by_rows(&name) {
            true => Record::of(pieces(rows).map(piece), &mut sink)?,
            false => Record::of([piece(0..rows)], &mut sink)?,
        });
    }
    Ok(records)
}

impl Record {
    /// What is known of an array that comes in pieces, one below the other, of which there is at least
    /// one; `sink` gets its bytes.
    fn of(
        pieces: impl IntoIterator<Item = Result<Tensor, BackendError>>,
        mut sink: impl FnMut(&[u8]) -> io::Result<()>,
    ) -> Result<Self, Stop> {
        let mut record = Self { name: String::new(), kind: Dtype::U8, shape: vec![], crc32c: 0 };
        let mut rows = 0;
        for piece in pieces {
            let Tensor { name, shape, values } = piece.map_err(Stop::Backend)?;
            rows += shape.first().copied().unwrap_or(0);
            let encoded = values.encode(|bytes| {
                record.crc32c = crc32c::crc32c_append(record.crc32c, bytes);
                sink(bytes)
            });
            encoded.map_err(Stop::Io)?;
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

/// The header as safetensors has it, padded so that the arrays are aligned.
fn header_bytes(header: &Header, records: &[Record]) -> io::Result<Vec<u8>> {
    let contents = Contents { header, tensors: records.to_vec() };
    let json = serde_json::to_string(&contents)?;
    let metadata = HashMap::from([
        (VERSION_KEY.to_owned(), VERSION.to_string()),
        (CHECKSUM_KEY.to_owned(), format!("{:08x}", crc32c::crc32c(json.as_bytes()))),
        (HEADER_KEY.to_owned(), json),
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
    let table = Metadata::new(Some(metadata), infos.collect()).map_err(io::Error::other)?;
    let mut bytes = serde_json::to_vec(&table)?;
    bytes.resize(bytes.len().next_multiple_of(LENGTH as usize), b' ');
    Ok(bytes)
}
