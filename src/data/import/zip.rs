//! Reads the files of a ZIP archive of a model, which is bounded by its own length.

use std::io::{BufReader, Read, Seek};
use std::path::Path;

use zip::ZipArchive;
use zip::result::ZipError;

use super::model::malformed;
use super::unfold::{exactly, to_the_end};
use crate::dataset::DatasetError;
use densify_core::files::most_unpacked;

/// An archive, with its table of contents.
pub(super) struct Archive<'a, R> {
    path: &'a Path,
    length: u64,
    files: ZipArchive<BufReader<R>>,
}

impl<'a, R: Read + Seek> Archive<'a, R> {
    /// Reads the table of contents.
    pub(super) fn open(path: &'a Path, input: R, length: u64) -> Result<Self, DatasetError> {
        let files = ZipArchive::new(BufReader::new(input));
        let files = files.map_err(|error| malformed(path, "archive", error))?;
        Ok(Self { path, length, files })
    }

    /// The contents of a file, whose checksum is right.
    pub(super) fn read(&mut self, name: &str) -> Result<Vec<u8>, DatasetError> {
        let Self { path, length, files } = self;
        let mut file = files.by_name(name).map_err(|error| match error {
            ZipError::FileNotFound => {
                malformed(path, "archive", format!("there is no {name:?} in it"))
            }
            other => malformed(path, name, other),
        })?;
        let bytes = file.size();
        if bytes > most_unpacked(*length) {
            let problem = format!("{bytes} bytes are too many for an archive of {length}");
            return Err(malformed(path, name, problem));
        }
        let contents = exactly(path, name, &mut file, bytes)?;
        to_the_end(path, name, &mut file)?;
        Ok(contents)
    }
}
