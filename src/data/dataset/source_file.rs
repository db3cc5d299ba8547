//! An image or mask file of a dataset, pinned to the file that was found when the dataset was loaded.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::LoadError;
use super::archive::Unpacked;
use super::exif::Exif;
use densify_core::files;

/// An image file inside the folder or archive of its dataset.
#[derive(Debug, Clone)]
pub struct SourceFile {
    /// Path of the file, as messages show it.
    pub path: PathBuf,
    /// The path without links, as it was when the dataset was loaded.
    real: Box<Path>,
    /// The archive that contains the file, if any.
    archive: Option<Arc<Unpacked>>,
    /// EXIF fields, if they have been read while loading.
    exif: Option<Box<Exif>>,
}

impl SourceFile {
    /// A file whose path has been checked.
    ///
    /// # Errors
    /// When the file no longer exists.
    pub(super) fn existing(path: PathBuf) -> Result<Self, LoadError> {
        let real = path.canonicalize().map_err(LoadError::io(&path))?;
        Ok(Self { path, real: real.into(), archive: None, exif: None })
    }

    /// A placeholder for pixels in memory, which have no EXIF.
    pub(crate) fn rendered(path: PathBuf) -> Self {
        Self { path, real: Path::new("").into(), archive: None, exif: Some(Box::default()) }
    }

    /// Stores EXIF fields that have already been read.
    pub(super) fn with_exif(self, exif: Option<Exif>) -> Self {
        Self { exif: exif.map(Box::new), ..self }
    }

    /// The same file as a part of an archive, whose name messages then show.
    pub(super) fn in_archive(self, archive: &Arc<Unpacked>) -> Self {
        Self {
            path: archive.path_in_archive(&self.path),
            archive: Some(Arc::clone(archive)),
            ..self
        }
    }

    /// Length of the file `[bytes]`; 0 if it no longer exists.
    pub fn length(&self) -> u64 {
        self.real.metadata().map_or(0, |data| data.len())
    }

    /// EXIF fields; read from the file only if they have not been read before.
    pub(super) fn exif(&self) -> Exif {
        match &self.exif {
            Some(exif) => Exif::clone(exif),
            None => self.open().map(Exif::read).unwrap_or_default(),
        }
    }

    /// Opens the file.
    ///
    /// # Errors
    /// When it cannot be opened, or has been replaced with a link to another file.
    pub(super) fn open(&self) -> Result<File, LoadError> {
        if self.archive.is_some() {
            return files::open(&self.real).map_err(LoadError::io(&self.path));
        }
        let real = self.path.canonicalize().map_err(LoadError::io(&self.path))?;
        if *real != *self.real {
            let problem = "it has become a link to another file since the run began";
            return Err(LoadError::malformed(&self.path, "the file", problem, "restore it"));
        }
        files::open(&real).map_err(LoadError::io(&self.path))
    }
}
