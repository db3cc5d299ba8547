//! Writes files atomically: complete or not at all.

use std::ffi::OsStr;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use super::disk::{Operation, WatchedFile, attempt};
use super::{FileError, folder_of};

/// Prefix of the names of temporary files and folders.
const TEMPORARY: &str = ".densify-";

/// Returns whether this is the name of a temporary file or folder.
pub fn is_temporary(name: &OsStr) -> bool {
    name.to_string_lossy().starts_with(TEMPORARY)
}

/// Writes a file under a temporary name in the same folder, syncs it and renames it, so that readers see either
/// the old or the new content, even after a crash. Creates missing folders.
///
/// # Errors
/// [`FileError::Io`], also for an error that `write` returns. An existing file then stays unchanged, and no
/// temporary file remains.
pub fn write_atomically(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), FileError> {
    write_atomically_from(path, |out| Ok::<_, WriteError<FileError>>(write(out)?))
}

/// An error while a file was being written.
#[derive(Debug)]
pub enum WriteError<E> {
    /// The file cannot be written.
    Io(io::Error),
    /// The contents cannot be generated.
    Source(E),
}

impl<E> From<io::Error> for WriteError<E> {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Does the same as [`write_atomically`], for contents whose generation may fail.
///
/// # Errors
/// [`FileError::Io`], and the error in a [`WriteError::Source`]. An existing file then stays unchanged, and no
/// temporary file remains.
pub fn write_atomically_from<E: From<FileError>>(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> Result<(), WriteError<E>>,
) -> Result<(), E> {
    write_checked(path, write, |_| Ok(()))
}

/// Does the same as [`write_atomically_from`], but gives the complete file its name only if `check`, which receives
/// the file's temporary path, accepts it.
///
/// # Errors
/// Those of [`write_atomically_from`] and of `check`.
pub fn write_checked<E: From<FileError>>(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> Result<(), WriteError<E>>,
    check: impl FnOnce(&Path) -> Result<(), E>,
) -> Result<(), E> {
    let folder = folder_of(path);
    std::fs::create_dir_all(folder).map_err(FileError::io("create the folder", folder))?;
    replace(folder, path, write, check).map_err(|error| match error {
        WriteError::Io(error) => FileError::io("write", path)(error).into(),
        WriteError::Source(error) => error,
    })
}

/// Writes and checks a temporary file in `folder`, and renames it to `path`.
fn replace<E>(
    folder: &Path,
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> Result<(), WriteError<E>>,
    check: impl FnOnce(&Path) -> Result<(), E>,
) -> Result<(), WriteError<E>> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMPORARY);
    // Temporary files are private by default; results should be as readable as other new files.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    attempt(Operation::Create, path)?;
    let mut file = builder.tempfile_in(folder)?;
    let mut buffered =
        BufWriter::with_capacity(1 << 16, WatchedFile { file: file.as_file_mut(), path });
    write(&mut buffered)?;
    buffered.flush()?;
    drop(buffered);
    check(file.path()).map_err(WriteError::Source)?;
    attempt(Operation::Sync, path)?;
    file.as_file().sync_all()?;
    attempt(Operation::Rename, path)?;
    file.persist(path).map_err(io::Error::from)?;
    // Syncing the folder makes the rename permanent; not every file system supports it.
    #[cfg(unix)]
    let _ = std::fs::File::open(folder).and_then(|folder| folder.sync_all());
    Ok(())
}

/// Levels of subfolders in a run's folder: two, as in `point_cloud/iteration_N`.
pub const RUN_FOLDER_DEPTH: u32 = 2;

/// Removes temporary files from a folder and from its subfolders down to `depth` levels below it.
pub fn remove_incomplete(folder: &Path, depth: u32) {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    for entry in entries {
        let (name, path) = (entry.file_name(), entry.path());
        // Links are not followed: their targets belong to the user.
        match entry.file_type() {
            Ok(kind) if kind.is_dir() && !is_temporary(&name) && depth > 0 => {
                remove_incomplete(&path, depth - 1);
            }
            Ok(kind) if kind.is_file() && is_temporary(&name) => _ = std::fs::remove_file(&path),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).unwrap();
        entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
    }

    #[test]
    fn a_failed_write_changes_nothing() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("deep/er/file.json");
        write_atomically(&path, |out| out.write_all(b"first")).unwrap();
        let error = write_atomically(&path, |out| {
            out.write_all(&[b'x'; 100_000])?;
            Err(io::Error::other("disk full"))
        });
        let message = error.unwrap_err().to_string();
        assert!(message.contains("file.json") && message.contains("disk full"), "{message}");
        assert_eq!(std::fs::read(&path).unwrap(), b"first");
        assert_eq!(names(path.parent().unwrap()), ["file.json"]);
    }

    #[cfg(unix)]
    #[test]
    fn files_have_the_permissions_of_any_new_file() {
        use std::os::unix::fs::PermissionsExt;
        let root = tempfile::tempdir().unwrap();
        let (ours, plain) = (root.path().join("ours"), root.path().join("plain"));
        write_atomically(&ours, |out| out.write_all(b"1")).unwrap();
        std::fs::write(&plain, b"1").unwrap();
        let mode = |path| std::fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&ours), mode(&plain));
    }
}
