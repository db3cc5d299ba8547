//! ZIP archives (PKWARE APPNOTE 6.3) that hold a model: a bounded reader, and a writer that stores files uncompressed.

use std::borrow::Cow;
use std::io::{self, BufReader, Read, Seek, Write};
use std::path::Path;

use flate2::Crc;
use zip::ZipArchive;
use zip::result::ZipError;

use super::unpack::{read_exactly, read_to_end};
use super::write::unfit;
use crate::error::LoadError;
use densify_core::files::max_unpacked_bytes;

/// The date of all files, 1 January 1980 in MS-DOS format. It is fixed, so that equal models give equal files.
const DATE: u16 = 1 << 5 | 1;
/// Version 2.0, which every reader supports.
const VERSION: u16 = 20;

/// An archive that is being read.
pub(super) struct ZipReader<'a, R> {
    path: &'a Path,
    length: u64,
    files: ZipArchive<BufReader<R>>,
}

impl<'a, R: Read + Seek> ZipReader<'a, R> {
    /// Reads the table of contents of an archive of `length` bytes.
    pub(super) fn open(path: &'a Path, input: R, length: u64) -> Result<Self, LoadError> {
        let files = ZipArchive::new(BufReader::new(input));
        let files = files.map_err(|error| LoadError::damaged(path, "archive", error))?;
        Ok(Self { path, length, files })
    }

    /// The names of all files; names that are not valid text are left out.
    pub(super) fn names(&self) -> Vec<Cow<'_, str>> {
        self.files.file_names().flatten().collect()
    }

    /// The contents of a file, with its checksum checked.
    pub(super) fn read(&mut self, name: &str) -> Result<Vec<u8>, LoadError> {
        let Self { path, length, files } = self;
        let mut file = files.by_name(name).map_err(|error| match error {
            ZipError::FileNotFound => {
                LoadError::damaged(path, "archive", format!("there is no {name:?} in it"))
            }
            other => LoadError::damaged(path, name, other),
        })?;
        let bytes = file.size();
        if bytes > max_unpacked_bytes(*length) {
            let problem = format!("{bytes} bytes are too many for an archive of {length}");
            return Err(LoadError::damaged(path, name, problem));
        }
        let contents = read_exactly(path, name, &mut file, bytes)?;
        read_to_end(path, name, &mut file)?;
        Ok(contents)
    }
}

/// An archive that is being written.
pub(super) struct ZipWriter<'a> {
    out: &'a mut dyn Write,
    offset: u64,
    /// The table of contents.
    table: Vec<u8>,
    count: u16,
}

impl<'a> ZipWriter<'a> {
    pub(super) fn new(out: &'a mut dyn Write) -> Self {
        Self { out, offset: 0, table: Vec::new(), count: 0 }
    }

    /// Adds a file.
    pub(super) fn add(&mut self, name: &str, bytes: &[u8]) -> io::Result<()> {
        let too_large =
            |_| unfit("an archive has at most 4 GiB; choose another format, such as ply");
        let size = u32::try_from(bytes.len()).map_err(too_large)?;
        let offset = u32::try_from(self.offset).map_err(too_large)?;
        let mut checksum = Crc::new();
        checksum.update(bytes);
        let mut fields = Vec::new();
        // Flags, method, time, date.
        for half in [VERSION, 0, 0, 0, DATE] {
            fields.extend(half.to_le_bytes());
        }
        for word in [checksum.sum(), size, size] {
            fields.extend(word.to_le_bytes());
        }
        fields.extend((name.len() as u16).to_le_bytes());
        // No extra field.
        fields.extend([0; 2]);
        let local = [b"PK\x03\x04", &fields[..], name.as_bytes()].concat();
        self.out.write_all(&local)?;
        self.out.write_all(bytes)?;
        self.table.extend(b"PK\x01\x02");
        self.table.extend(VERSION.to_le_bytes());
        self.table.extend(fields);
        // No comment, first disk, no attributes.
        self.table.extend([0; 10]);
        self.table.extend(offset.to_le_bytes());
        self.table.extend(name.as_bytes());
        self.offset += (local.len() + bytes.len()) as u64;
        self.count += 1;
        Ok(())
    }

    /// Writes the table of contents.
    pub(super) fn finish(self) -> io::Result<()> {
        let mut end = b"PK\x05\x06\0\0\0\0".to_vec();
        end.extend(self.count.to_le_bytes());
        end.extend(self.count.to_le_bytes());
        end.extend((self.table.len() as u32).to_le_bytes());
        end.extend((self.offset as u32).to_le_bytes());
        end.extend([0; 2]);
        self.out.write_all(&self.table)?;
        self.out.write_all(&end)
    }
}
