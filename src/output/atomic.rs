//! Files that are there in full or not at all.

use std::ffi::OsStr;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use super::OutputError;
use super::disk::{Named, Operation, attempt};

/// What the names of files and folders begin with that are not complete yet.
pub(super) const TEMPORARY: &str = ".densify-";

/// Whether a file or folder of this name is one that a writer has not completed.
pub(super) fn is_temporary(name: &OsStr) -> bool {
    name.to_string_lossy().starts_with(TEMPORARY)
}

/// Writes a file under a temporary name in the same folder, syncs it and renames it: whoever looks
/// sees the old content or the new one, whatever happens in between. Creates missing folders.
///
/// # Errors
/// [`OutputError::Io`], also for an error that `write` returns; a file that was there is then
/// unchanged and nothing is left behind.
pub fn write_atomically(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), OutputError> {
    write_atomically_from(path, |out| Ok::<_, Stop<OutputError>>(write(out)?))
}

/// Why a file is not written to its end.
#[derive(Debug)]
pub enum Stop<E> {
    /// It cannot be written.
    Io(io::Error),
    /// What should stand in it cannot be had.
    Source(E),
}

impl<E> From<io::Error> for Stop<E> {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// As [`write_atomically`], of contents that may fail to come.
///
/// # Errors
/// [`OutputError::Io`], and what `write` has in a [`Stop::Source`]; a file that was there is then
/// unchanged and nothing is left behind.
pub fn write_atomically_from<E: From<OutputError>>(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> Result<(), Stop<E>>,
) -> Result<(), E> {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    std::fs::create_dir_all(folder).map_err(OutputError::io("create the folder", folder))?;
    replace(folder, path, write).map_err(|stop| match stop {
        Stop::Io(error) => OutputError::io("write", path)(error).into(),
        Stop::Source(error) => error,
    })
}

fn replace<E>(
    folder: &Path,
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> Result<(), Stop<E>>,
) -> Result<(), Stop<E>> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMPORARY);
    // Temporary files are private by default; a result is as readable as any other new file.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    attempt(Operation::Create, path)?;
    let mut file = builder.tempfile_in(folder)?;
    let mut buffered = BufWriter::with_capacity(1 << 16, Named { file: file.as_file_mut(), path });
    write(&mut buffered)?;
    buffered.flush()?;
    drop(buffered);
    attempt(Operation::Sync, path)?;
    file.as_file().sync_all()?;
    attempt(Operation::Rename, path)?;
    file.persist(path).map_err(io::Error::from)?;
    // The rename lasts once the folder is synced; not every file system can do that.
    #[cfg(unix)]
    let _ = std::fs::File::open(folder).and_then(|folder| folder.sync_all());
    Ok(())
}

/// Folders within folders of a run: `point_cloud/iteration_N`.
pub(super) const DEEPEST: u32 = 2;

/// Removes the files that are not complete, down to folders so deep.
pub(super) fn remove_incomplete(folder: &Path, deeper: u32) {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    for entry in entries {
        let (name, path) = (entry.file_name(), entry.path());
        // Links are not followed: what they lead to is the user's.
        match entry.file_type() {
            Ok(kind) if kind.is_dir() && !is_temporary(&name) && deeper > 0 => {
                remove_incomplete(&path, deeper - 1);
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

    #[test]
    fn what_the_contents_fail_with_comes_back_as_it_is() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a");
        write_atomically(&path, |out| out.write_all(b"old")).unwrap();
        let lost = || OutputError::io("fetch", Path::new("b"))(io::Error::other("lost"));
        let error = write_atomically_from(&path, |out| {
            out.write_all(b"new")?;
            Err(Stop::Source(lost()))
        });
        assert_eq!(error.unwrap_err().to_string(), lost().to_string());
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(names(root.path()), ["a"]);
    }

    #[test]
    fn until_it_is_complete_the_old_file_stands() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a");
        write_atomically(&path, |out| out.write_all(b"old")).unwrap();
        write_atomically(&path, |out| {
            out.write_all(&[b'x'; 1 << 20])?;
            assert_eq!(std::fs::read(&path)?, b"old");
            Ok(())
        })
        .unwrap();
        assert_eq!(std::fs::read(&path).unwrap().len(), 1 << 20);
    }

    #[cfg(unix)]
    #[test]
    fn others_may_read_as_with_any_new_file() {
        use std::os::unix::fs::PermissionsExt;
        let root = tempfile::tempdir().unwrap();
        let (ours, plain) = (root.path().join("ours"), root.path().join("plain"));
        write_atomically(&ours, |out| out.write_all(b"1")).unwrap();
        std::fs::write(&plain, b"1").unwrap();
        let mode = |path| std::fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&ours), mode(&plain));
    }
}
