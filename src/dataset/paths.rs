//! Paths in data files: untrusted, and never followed out of the dataset's folder.

use std::path::{Path, PathBuf};

use super::error::DatasetError;

/// Longest name accepted from a data file `[bytes]`.
pub(super) const MAX_NAME: usize = 4096;

/// A folder that paths from data files may not leave.
#[derive(Debug, Clone)]
pub(super) struct Root {
    /// As the user wrote it, for messages.
    shown: PathBuf,
    canonical: PathBuf,
}

/// A path in a data file, with its place for error messages.
#[derive(Debug, Clone, Copy)]
pub(super) struct DataPath<'a> {
    pub(super) file: &'a Path,
    pub(super) field: &'a str,
    pub(super) value: &'a str,
}

impl Root {
    pub(super) fn new(folder: &Path) -> Result<Self, DatasetError> {
        let canonical = folder.canonicalize().map_err(DatasetError::io(folder))?;
        if !canonical.is_dir() {
            return Err(DatasetError::io(folder)(std::io::ErrorKind::NotADirectory.into()));
        }
        Ok(Self { shown: folder.to_owned(), canonical })
    }

    pub(super) fn path(&self) -> &Path {
        &self.shown
    }

    /// The full path, after all checks that need no file system. The file need not exist.
    pub(super) fn join(&self, named: DataPath<'_>) -> Result<PathBuf, DatasetError> {
        match lexical_fault(named.value) {
            None => Ok(self.shown.join(relative(named.value))),
            Some(problem) => Err(named.fault(problem)),
        }
    }

    /// As [`join`](Self::join), also refusing links that lead out; `None` if there is no such file.
    pub(super) fn existing(&self, named: DataPath<'_>) -> Result<Option<PathBuf>, DatasetError> {
        let path = self.join(named)?;
        match path.canonicalize() {
            Ok(real) if !real.starts_with(&self.canonical) => {
                Err(named.fault("leads out of the folder through a symbolic link"))
            }
            Ok(real) if real.is_file() => Ok(Some(path)),
            _ => Ok(None),
        }
    }
}

impl DataPath<'_> {
    fn fault(self, problem: &str) -> DatasetError {
        let value: String = self.value.chars().take(200).collect();
        let problem = format!("the path {value:?} {problem}");
        let remedy = "only paths below the dataset's folder are followed (a folder elsewhere can be named with \
                      --images)";
        DatasetError::malformed(self.file, self.field, problem, remedy)
    }
}

/// The path without `./` parts, with `/` as separator: the name of a view.
pub(super) fn relative(value: &str) -> String {
    value.split('/').filter(|part| !part.is_empty() && *part != ".").collect::<Vec<_>>().join("/")
}

/// What is wrong with a path, as far as its text says.
pub(super) fn lexical_fault(value: &str) -> Option<&'static str> {
    // Both separators count: paths may come from another system.
    let parts = || value.split(['/', '\\']);
    if relative(value).is_empty() {
        Some("is empty")
    } else if value.len() > MAX_NAME {
        Some("is longer than 4 KiB")
    } else if value.contains(char::is_control) {
        Some("contains a control character")
    } else if value.starts_with(['/', '\\'])
        || value.as_bytes().get(1) == Some(&b':')
        || value.starts_with("file:")
    {
        Some("is absolute")
    } else if parts().any(|part| part == "..") {
        Some("contains `..`")
    } else {
        None
    }
}
