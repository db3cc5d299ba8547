//! A file within the folder or the archive of a dataset, which links may not lead out of.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::DatasetError;
use super::archive::Unpacked;
use densify_core::files;

/// An image file that was found within the folder it may not leave.
#[derive(Debug, Clone)]
pub struct SourceFile {
    /// Where it is, as messages show it.
    pub path: PathBuf,
    /// Where links led when it was checked.
    real: Box<Path>,
    /// The archive that it is in, if any.
    archive: Option<Arc<Unpacked>>,
}

impl SourceFile {
    /// The file at this path, which has been checked.
    ///
    /// # Errors
    /// When it is no longer there.
    pub fn found(path: PathBuf) -> Result<Self, DatasetError> {
        let real = path.canonicalize().map_err(DatasetError::io(&path))?;
        Ok(Self { path, real: real.into(), archive: None })
    }

    /// Stands for pixels that no file holds.
    #[must_use]
    pub fn rendered(path: PathBuf) -> Self {
        Self { path, real: Path::new("").into(), archive: None }
    }

    /// The same, as one of an archive's files, which is named so.
    pub(super) fn of_archive(self, archive: &Arc<Unpacked>) -> Self {
        Self {
            path: archive.shown(&self.path),
            real: self.real,
            archive: Some(Arc::clone(archive)),
        }
    }

    /// Its length `[bytes]`; 0 if it is no longer there.
    pub fn length(&self) -> u64 {
        self.real.metadata().map_or(0, |data| data.len())
    }

    /// Opens it, unless links lead elsewhere by now.
    pub(super) fn open(&self) -> Result<File, DatasetError> {
        if self.archive.is_some() {
            return files::open(&self.real).map_err(DatasetError::io(&self.path));
        }
        let real = self.path.canonicalize().map_err(DatasetError::io(&self.path))?;
        if *real != *self.real {
            let problem = "it has become a link to another file since the run began";
            return Err(DatasetError::malformed(&self.path, "the file", problem, "restore it"));
        }
        files::open(&real).map_err(DatasetError::io(&self.path))
    }
}
