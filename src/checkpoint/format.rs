//! The file: written array by array, so that only one is held at a time, and read with every part
//! checked before it is used.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use safetensors::tensor::{Dtype, Metadata, TensorInfo};
use serde::{Deserialize, Serialize};

use super::{CheckpointError, Header, model};
use crate::backend::{Backend, BackendError, Tensor, Values};
use crate::gaussians::{Gaussians, MAX_SH_DEGREE};
use crate::output::write_atomically;

/// Version of the format that this program writes, and the only one that it reads.
pub const VERSION: u32 = 1;
/// Keys of the metadata.
const VERSION_KEY: &str = "densify.version";
const HEADER_KEY: &str = "densify.header";
const CHECKSUM_KEY: &str = "densify.crc32c";
/// Longest header accepted `[bytes]`.
const MAX_HEADER: u64 = 64 << 20;
/// Bytes before the header: its length.
const LENGTH: u64 = 8;
/// Bytes read at a time; a multiple of every type's size.
const CHUNK: usize = 1 << 16;

/// What is known of an array beside its values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Record {
    name: String,
    kind: Dtype,
    shape: Vec<usize>,
    /// CRC-32C of its bytes.
    crc32c: u32,
}

/// The JSON in the metadata.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Contents<H> {
    header: H,
    tensors: Vec<Record>,
}

/// Writes the state of a run: `header`, and the model and all else that `backend` holds. The file
/// appears under its name when it is complete and on disk; whatever was there stays until then.
///
/// # Errors
/// [`CheckpointError::Write`], [`CheckpointError::Backend`].
pub fn write(path: &Path, header: &Header, backend: &dyn Backend) -> Result<(), CheckpointError> {
    // Twice over the arrays: the header, which comes first, has their checksums.
    let mut records = Vec::new();
    let noted = for_each_tensor(backend, |tensor| {
        records.push(Record::of(tensor));
        Ok(())
    });
    noted.map_err(|stop| stop.into_error(path))?;
    let mut lost = None;
    let written = write_atomically(path, |out| {
        let bytes = header_bytes(header, &records)?;
        out.write_all(&(bytes.len() as u64).to_le_bytes())?;
        out.write_all(&bytes)?;
        let mut expected = records.iter();
        let done = for_each_tensor(backend, |tensor| {
            let mut crc = 0;
            tensor.values.encode(|bytes| {
                crc = crc32c::crc32c_append(crc, bytes);
                out.write_all(bytes)
            })?;
            if expected.next().is_some_and(|record| record.crc32c == crc) {
                return Ok(());
            }
            Err(io::Error::other(format!("`{}` changed while it was written", tensor.name)))
        });
        done.map_err(|stop| match stop {
            Stop::Io(error) => error,
            Stop::Backend(error) => {
                lost = Some(error);
                io::Error::other("the backend is lost")
            }
        })
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

/// Calls `f` with each array of the model and of the backend's state, in the order of the file.
fn for_each_tensor(
    backend: &dyn Backend,
    mut f: impl FnMut(&Tensor) -> io::Result<()>,
) -> Result<(), Stop> {
    for tensor in model::tensors(backend.download().map_err(Stop::Backend)?) {
        f(&tensor).map_err(Stop::Io)?;
    }
    for name in backend.state() {
        let tensor = backend.save(&name).map_err(Stop::Backend)?;
        f(&tensor).map_err(Stop::Io)?;
    }
    Ok(())
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

impl Record {
    fn of(tensor: &Tensor) -> Self {
        let mut crc = 0;
        // The sink does not fail.
        let _ = tensor.values.encode(|bytes| {
            crc = crc32c::crc32c_append(crc, bytes);
            Ok(())
        });
        let kind = match tensor.values {
            Values::F32(_) => Dtype::F32,
            Values::U16(_) => Dtype::U16,
            Values::U8(_) => Dtype::U8,
        };
        Self { name: tensor.name.clone(), kind, shape: tensor.shape.clone(), crc32c: crc }
    }

    fn values(&self) -> Option<usize> {
        self.shape.iter().try_fold(1_usize, |product, &side| product.checked_mul(side))
    }

    fn bytes(&self) -> Option<usize> {
        self.values()?.checked_mul(self.kind.bitsize() / 8)
    }
}

/// A checkpoint that is sound: every part of the file has been checked.
#[derive(Debug)]
pub struct Checkpoint {
    path: PathBuf,
    file: File,
    header: Header,
    /// Where each array begins in the file, with what is known of it.
    places: Vec<(u64, Record)>,
}

impl Checkpoint {
    /// Opens a checkpoint and checks all of it.
    ///
    /// # Errors
    /// [`CheckpointError::Read`], [`CheckpointError::Invalid`].
    pub fn open(path: &Path) -> Result<Self, CheckpointError> {
        let invalid = |problem: String| CheckpointError::invalid(path, problem);
        let failed = |source| CheckpointError::Read { path: path.to_owned(), source };
        let mut file = File::open(path).map_err(failed)?;
        let size = file.metadata().map_err(failed)?.len();
        let mut length = [0; LENGTH as usize];
        let short = || invalid(format!("it is cut short: {size} bytes"));
        if size < LENGTH {
            return Err(short());
        }
        file.read_exact(&mut length).map_err(failed)?;
        let length = u64::from_le_bytes(length);
        if length > MAX_HEADER {
            return Err(invalid(
                "it is no safetensors file: its header would be larger than 64 MiB".into(),
            ));
        }
        if length > size - LENGTH {
            return Err(short());
        }
        let mut bytes = vec![0; length as usize];
        file.read_exact(&mut bytes).map_err(failed)?;
        let (header, places) = parse(&bytes, LENGTH + length, size).map_err(invalid)?;
        let mut checkpoint = Self { path: path.to_owned(), file, header, places };
        for i in 0..checkpoint.places.len() {
            checkpoint.scan(i, |_| ())?;
        }
        Ok(checkpoint)
    }

    /// Where it was read from.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// All but the arrays.
    #[must_use]
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The model, in the coordinates of training.
    ///
    /// # Errors
    /// [`CheckpointError::Invalid`] where it does not fit its own configuration;
    /// [`CheckpointError::Read`].
    pub fn model(&mut self) -> Result<Gaussians, CheckpointError> {
        let train = &self.header.config.train;
        let (budget, sh_degree) = (train.budget, train.sh_degree);
        if sh_degree > MAX_SH_DEGREE {
            return Err(self.invalid(format!("sh_degree is {sh_degree}; at most {MAX_SH_DEGREE}")));
        }
        let means = self.places.iter().find(|(_, record)| record.name == model::NAMES[0]);
        let rows = means.and_then(|(_, record)| record.shape.first().copied()).unwrap_or(0);
        if rows > budget {
            return Err(self.invalid(format!("{rows} rows, but its budget is {budget}")));
        }
        let path = self.path.clone();
        let fail = |error| CheckpointError::invalid(&path, error);
        model::model(rows, sh_degree, |name| self.tensor(name), fail)
    }

    /// Gives `backend`, which holds the [model](Self::model), the state of that moment.
    ///
    /// # Errors
    /// [`CheckpointError::Invalid`] where the arrays are not those that this backend keeps;
    /// [`CheckpointError::Read`].
    pub fn restore(&mut self, backend: &mut dyn Backend) -> Result<(), CheckpointError> {
        let wanted = backend.state();
        let known = |name: &str| model::NAMES.contains(&name) || wanted.iter().any(|w| w == name);
        if let Some((_, record)) = self.places.iter().find(|(_, record)| !known(&record.name)) {
            let name = &record.name;
            return Err(self.invalid(format!("this run keeps nothing like its tensor `{name}`")));
        }
        for name in wanted {
            let tensor = self.tensor(&name)?;
            backend.restore(tensor).map_err(CheckpointError::state(&self.path))?;
        }
        Ok(())
    }

    fn invalid(&self, problem: impl ToString) -> CheckpointError {
        CheckpointError::invalid(&self.path, problem)
    }

    fn tensor(&mut self, name: &str) -> Result<Tensor, CheckpointError> {
        let found = self.places.iter().position(|(_, record)| record.name == name);
        let Some(i) = found else {
            return Err(self.invalid(format!("there is no tensor `{name}`")));
        };
        let record = self.places[i].1.clone();
        let count = record.values().unwrap_or(usize::MAX);
        let values = match record.kind {
            Dtype::F32 => Values::F32(self.values(i, count, |b: [u8; 4]| f32::from_le_bytes(b))?),
            Dtype::U16 => Values::U16(self.values(i, count, |b: [u8; 2]| u16::from_le_bytes(b))?),
            Dtype::U8 => Values::U8(self.values(i, count, |[b]: [u8; 1]| b)?),
            other => return Err(self.invalid(format!("tensor `{name}` is of type {other:?}"))),
        };
        Ok(Tensor { name: record.name, shape: record.shape, values })
    }

    /// The values of an array. The file is known to hold so many.
    fn values<T, const N: usize>(
        &mut self,
        place: usize,
        count: usize,
        decode: impl Fn([u8; N]) -> T,
    ) -> Result<Vec<T>, CheckpointError> {
        let mut values = Vec::new();
        if values.try_reserve_exact(count).is_err() {
            let what = "a tensor of the checkpoint";
            return Err(BackendError::OutOfMemory { what, bytes: (count * N) as u64 }.into());
        }
        self.scan(place, |bytes| {
            values.extend(bytes.as_chunks::<N>().0.iter().map(|&b| decode(b)));
        })?;
        Ok(values)
    }

    /// Reads an array from front to back, in pieces of whole values, and checks its sum.
    fn scan(&mut self, place: usize, mut seen: impl FnMut(&[u8])) -> Result<(), CheckpointError> {
        let Self { path, file, places, .. } = self;
        let (start, record) = &places[place];
        let failed = |source| CheckpointError::Read { path: path.clone(), source };
        file.seek(SeekFrom::Start(*start)).map_err(failed)?;
        let mut left = record.bytes().unwrap_or(usize::MAX);
        let mut buffer = vec![0; left.min(CHUNK)];
        let mut crc = 0;
        while left > 0 {
            let bytes = &mut buffer[..left.min(CHUNK)];
            file.read_exact(bytes).map_err(failed)?;
            crc = crc32c::crc32c_append(crc, bytes);
            seen(bytes);
            left -= bytes.len();
        }
        if crc == record.crc32c {
            return Ok(());
        }
        let Record { name, crc32c, .. } = record;
        let problem =
            format!("tensor `{name}` is damaged: its checksum is {crc:08x}, not {crc32c:08x}");
        Err(CheckpointError::invalid(path, problem))
    }
}

/// Reads the header of a file of `size` bytes whose arrays begin at `start`.
fn parse(bytes: &[u8], start: u64, size: u64) -> Result<(Header, Vec<(u64, Record)>), String> {
    let table: Metadata =
        serde_json::from_slice(bytes).map_err(|e| format!("its header is no safetensors: {e}"))?;
    let metadata = table.metadata().as_ref();
    let entry = |key: &str| {
        let entry = metadata.and_then(|metadata| metadata.get(key));
        entry.ok_or_else(|| format!("it is no checkpoint of densify: its header has no `{key}`"))
    };
    let version = entry(VERSION_KEY)?;
    if *version != VERSION.to_string() {
        return Err(format!(
            "it is of version {version} of the format, but this densify reads version {VERSION}; \
             go on with the densify that wrote it"
        ));
    }
    let json = entry(HEADER_KEY)?;
    let crc = format!("{:08x}", crc32c::crc32c(json.as_bytes()));
    if *entry(CHECKSUM_KEY)? != crc {
        return Err("its header is damaged: the checksum does not hold".to_owned());
    }
    let contents: Contents<Header> =
        serde_json::from_str(json).map_err(|e| format!("its header: {e}"))?;
    let Contents { header, tensors } = contents;
    if tensors.len() != table.offset_keys().len() {
        return Err("its header is damaged: it lists other tensors than the file".to_owned());
    }
    let mut places = Vec::new();
    let mut end = start;
    for record in tensors {
        let info = table.info(&record.name);
        let here = (end - start) as usize;
        let same = info.is_some_and(|info| {
            (info.dtype, &info.shape) == (record.kind, &record.shape)
                && info.data_offsets.0 == here
                && record.bytes() == Some(info.data_offsets.1 - here)
        });
        let next = record.bytes().and_then(|bytes| end.checked_add(bytes as u64));
        let (true, Some(next)) = (same, next) else {
            let name = &record.name;
            return Err(format!(
                "its header is damaged: tensor `{name}` is not where it should be"
            ));
        };
        places.push((end, record));
        end = next;
    }
    if end != size {
        let how =
            if size < end { "it is cut short" } else { "there is more in it than there should" };
        return Err(format!("{how}: {size} bytes, its header tells of {end}"));
    }
    Ok((header, places))
}
