//! Reads checkpoints. Everything is checked before use, and arrays are read some rows at a time.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use safetensors::tensor::{Dtype, Metadata};

use super::format::{
    CHECKSUM_KEY, Contents, HEADER_KEY, LENGTH_FIELD_BYTES, Record, VERSION, VERSION_KEY, name_of,
    shape_of,
};
use super::{CheckpointError, Header};
use densify_core::files::FileError;
use densify_core::gaussians::{Gaussians, MAX_SH_DEGREE, ModelArray};
use densify_core::pieces::pieces;
use densify_render::{Backend, BackendError, StateArray, StateError, Tensor, Values};

/// Longest header accepted `[bytes]`.
const MAX_HEADER: u64 = 64 << 20;
/// Bytes read at a time; a multiple of the size of every type.
const CHUNK: usize = 1 << 16;

/// A checkpoint whose file has been checked completely.
#[derive(Debug)]
pub struct Checkpoint {
    path: PathBuf,
    file: File,
    header: Header,
    /// Offset and description of each array.
    arrays: Vec<(u64, Record)>,
}

impl Checkpoint {
    /// Opens a checkpoint and checks the whole file.
    ///
    /// # Errors
    /// [`CheckpointError::File`], [`CheckpointError::Invalid`].
    pub fn open(path: &Path) -> Result<Self, CheckpointError> {
        let invalid = |problem: String| CheckpointError::invalid(path, problem);
        let failed = |source| FileError::io("read", path)(source);
        let mut file = densify_core::files::open(path).map_err(failed)?;
        let size = file.metadata().map_err(failed)?.len();
        let mut length = [0; LENGTH_FIELD_BYTES as usize];
        let short = || invalid(format!("it is cut short: {size} bytes"));
        if size < LENGTH_FIELD_BYTES {
            return Err(short());
        }
        file.read_exact(&mut length).map_err(failed)?;
        let length = u64::from_le_bytes(length);
        if length > MAX_HEADER {
            return Err(invalid(
                "it is not a safetensors file: its header would be larger than 64 MiB".into(),
            ));
        }
        if length > size - LENGTH_FIELD_BYTES {
            return Err(short());
        }
        let mut bytes = vec![0; length as usize];
        file.read_exact(&mut bytes).map_err(failed)?;
        let (header, arrays) = parse(&bytes, LENGTH_FIELD_BYTES + length, size).map_err(invalid)?;
        let mut checkpoint = Self { path: path.to_owned(), file, header, arrays };
        for i in 0..checkpoint.arrays.len() {
            ArrayReader::new(&mut checkpoint, i)?.finish()?;
        }
        Ok(checkpoint)
    }

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Everything but the arrays.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// A model of zeros with as many rows as the checkpoint, for creating the backend that is then
    /// [restored](Self::restore).
    ///
    /// # Errors
    /// [`CheckpointError::Invalid`] if the model contradicts the checkpoint's own header.
    pub fn blank_model(&self) -> Result<Gaussians, CheckpointError> {
        let Header { budget, sh_degree, .. } = self.header;
        if sh_degree > MAX_SH_DEGREE {
            return Err(self.invalid(format!("sh_degree is {sh_degree}; at most {MAX_SH_DEGREE}")));
        }
        let means = self.index_of(name_of(ModelArray::Means))?;
        let rows = self.arrays[means].1.shape.first().copied().unwrap_or(0);
        if rows > budget {
            return Err(self.invalid(format!("{rows} rows, but its budget is {budget}")));
        }
        for array in ModelArray::ALL {
            self.index_in_model(array, rows, sh_degree)?;
        }
        Ok(Gaussians::zeros(rows, sh_degree))
    }

    /// Index of an array of the model, after checking its shape.
    fn index_in_model(
        &self,
        array: ModelArray,
        rows: usize,
        sh_degree: u8,
    ) -> Result<usize, CheckpointError> {
        let name = name_of(array);
        let index = self.index_of(name)?;
        let Record { shape, kind, .. } = &self.arrays[index].1;
        let needed = shape_of(array, rows, sh_degree);
        if (shape, *kind) == (&needed, Dtype::F32) {
            return Ok(index);
        }
        Err(self.invalid(format!(
            "tensor `{name}`: it is {kind:?} of shape {shape:?}; this run needs F32 of {needed:?}"
        )))
    }

    /// Restores the model and the state of `backend`, which was created with the
    /// [blank model](Self::blank_model).
    ///
    /// # Errors
    /// [`CheckpointError::Invalid`] if the arrays do not match the backend;
    /// [`CheckpointError::File`], [`CheckpointError::Backend`].
    pub fn restore(&mut self, backend: &mut dyn Backend) -> Result<(), CheckpointError> {
        let expected = backend.state();
        let known = |name: &str| {
            ModelArray::ALL.into_iter().any(|array| name_of(array) == name)
                || expected.iter().any(|array| array.name == name)
        };
        if let Some((_, record)) = self.arrays.iter().find(|(_, record)| !known(&record.name)) {
            let name = &record.name;
            return Err(
                self.invalid(format!("it has a tensor `{name}`, which this run does not have"))
            );
        }
        let path = self.path.clone();
        let refused = |error: StateError| CheckpointError::invalid(&path, error);
        let (rows, sh_degree) = (backend.rows(), backend.sh_degree());
        for array in ModelArray::ALL {
            let index = self.index_in_model(array, rows, sh_degree)?;
            let mut reader = ArrayReader::new(self, index)?;
            for rows in pieces(rows) {
                let shape = shape_of(array, rows.len(), sh_degree);
                let values = reader.tensor(rows.len())?.into_f32(&shape).map_err(&refused)?;
                backend.upload_array(array, rows, &values)?;
            }
            reader.finish()?;
        }
        for StateArray { name, by_rows } in expected {
            let index = self.index_of(&name)?;
            let has_rows = self.arrays[index].1.shape.first() == Some(&rows);
            if has_rows && by_rows {
                let mut reader = ArrayReader::new(self, index)?;
                for rows in pieces(rows) {
                    backend.restore_rows(reader.tensor(rows.len())?, rows).map_err(&refused)?;
                }
                reader.finish()?;
            } else {
                // `restore` refuses an array with one entry per row if its number of rows is wrong.
                backend.restore(self.tensor(index)?).map_err(&refused)?;
            }
        }
        Ok(())
    }

    /// Optimiser steps since each row was created or rewritten. Shape: `[rows]`.
    ///
    /// # Errors
    /// [`CheckpointError::Invalid`] if the checkpoint has no ages, [`CheckpointError::File`].
    pub fn ages(&mut self) -> Result<Vec<u32>, CheckpointError> {
        let index = self.arrays.iter().position(|(_, record)| Tensor::has_ages(&record.name));
        let tensor = index.map(|index| self.tensor(index)).transpose()?;
        let ages = tensor.and_then(|tensor| tensor.ages());
        ages.ok_or_else(|| self.invalid("it has no ages of rows"))
    }

    fn invalid(&self, problem: impl ToString) -> CheckpointError {
        CheckpointError::invalid(&self.path, problem)
    }

    /// Index of an array in `arrays`.
    fn index_of(&self, name: &str) -> Result<usize, CheckpointError> {
        let index = self.arrays.iter().position(|(_, record)| record.name == name);
        index.ok_or_else(|| self.invalid(format!("there is no tensor `{name}`")))
    }

    /// Reads a whole array.
    fn tensor(&mut self, index: usize) -> Result<Tensor, CheckpointError> {
        let mut reader = ArrayReader::new(self, index)?;
        let whole = reader.tensor(reader.record.shape.first().copied().unwrap_or(0))?;
        reader.finish()?;
        Ok(whole)
    }
}

/// Reads an array piece by piece.
struct ArrayReader<'a> {
    path: &'a Path,
    file: &'a mut File,
    record: &'a Record,
    /// Bytes left to read.
    left: usize,
    /// Checksum of the bytes read.
    crc: u32,
}

impl<'a> ArrayReader<'a> {
    fn new(checkpoint: &'a mut Checkpoint, index: usize) -> Result<Self, CheckpointError> {
        let Checkpoint { path, file, arrays, .. } = checkpoint;
        let (start, record) = &arrays[index];
        let left = record.bytes().unwrap_or(usize::MAX);
        let reader = Self { path, file, record, left, crc: 0 };
        reader.file.seek(SeekFrom::Start(*start)).map_err(|e| reader.failed(e))?;
        Ok(reader)
    }

    fn failed(&self, source: io::Error) -> CheckpointError {
        FileError::io("read", self.path)(source).into()
    }

    /// Reads the next `entries` along the first dimension.
    fn tensor(&mut self, entries: usize) -> Result<Tensor, CheckpointError> {
        let Record { name, kind, shape, .. } = self.record;
        let mut shape = shape.clone();
        if let Some(first) = shape.first_mut() {
            *first = entries;
        }
        let count = shape.iter().try_fold(1, |all: usize, &side| all.checked_mul(side));
        let count = count.unwrap_or(usize::MAX);
        let values = match kind {
            Dtype::F32 => Values::F32(self.values(count, f32::from_le_bytes)?),
            Dtype::U16 => Values::U16(self.values(count, u16::from_le_bytes)?),
            Dtype::U8 => Values::U8(self.values(count, |[byte]: [u8; 1]| byte)?),
            other => {
                let problem = format!("tensor `{name}` has the unsupported type {other:?}");
                return Err(CheckpointError::invalid(self.path, problem));
            }
        };
        Ok(Tensor { name: name.clone(), shape, values })
    }

    /// Reads `count` bytes, and passes them to `sink` in pieces of whole values.
    fn bytes(&mut self, count: usize, mut sink: impl FnMut(&[u8])) -> Result<(), CheckpointError> {
        let mut left = count;
        let mut buffer = vec![0; left.min(CHUNK)];
        while left > 0 {
            let bytes = &mut buffer[..left.min(CHUNK)];
            self.file.read_exact(bytes).map_err(|e| self.failed(e))?;
            self.crc = crc32c::crc32c_append(self.crc, bytes);
            sink(bytes);
            left -= bytes.len();
        }
        self.left -= count;
        Ok(())
    }

    fn values<T, const N: usize>(
        &mut self,
        count: usize,
        decode: impl Fn([u8; N]) -> T,
    ) -> Result<Vec<T>, CheckpointError> {
        let mut values = Vec::new();
        if values.try_reserve_exact(count).is_err() {
            let what = "a tensor of the checkpoint";
            return Err(BackendError::OutOfMemory { what, bytes: (count * N) as u64 }.into());
        }
        self.bytes(count * N, |bytes| {
            values.extend(bytes.as_chunks::<N>().0.iter().map(|&b| decode(b)));
        })?;
        Ok(values)
    }

    /// Reads the rest of the array and verifies the checksum.
    fn finish(mut self) -> Result<(), CheckpointError> {
        self.bytes(self.left, |_| ())?;
        let (Record { name, crc32c, .. }, crc) = (self.record, self.crc);
        if crc == *crc32c {
            return Ok(());
        }
        let problem =
            format!("tensor `{name}` is damaged: its checksum is {crc:08x}, not {crc32c:08x}");
        Err(CheckpointError::invalid(self.path, problem))
    }
}

/// Reads the header of a file of `size` bytes whose arrays begin at `start`.
fn parse(bytes: &[u8], start: u64, size: u64) -> Result<(Header, Vec<(u64, Record)>), String> {
    let table: Metadata =
        serde_json::from_slice(bytes).map_err(|e| format!("its header is not safetensors: {e}"))?;
    let metadata = table.metadata().as_ref();
    let entry = |key: &str| {
        let entry = metadata.and_then(|metadata| metadata.get(key));
        entry.ok_or_else(|| format!("it is not a checkpoint of densify: its header has no `{key}`"))
    };
    let version = entry(VERSION_KEY)?;
    if *version != VERSION.to_string() {
        return Err(format!(
            "it has version {version} of the format, but this densify reads version {VERSION}; \
             continue with the densify that wrote it"
        ));
    }
    let json = entry(HEADER_KEY)?;
    let crc = format!("{:08x}", crc32c::crc32c(json.as_bytes()));
    if *entry(CHECKSUM_KEY)? != crc {
        return Err("its header is damaged: the checksum is wrong".to_owned());
    }
    let contents: Contents<Header> =
        serde_json::from_str(json).map_err(|e| format!("its header: {e}"))?;
    let Contents { header, tensors } = contents;
    if tensors.len() != table.offset_keys().len() {
        return Err("its header is damaged: it lists other tensors than the file has".to_owned());
    }
    let mut arrays = Vec::new();
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
        arrays.push((end, record));
        end = next;
    }
    if end != size {
        let how = if size < end { "it is cut short" } else { "it is too long" };
        return Err(format!("{how}: it has {size} bytes, but its header says {end}"));
    }
    Ok((header, arrays))
}
