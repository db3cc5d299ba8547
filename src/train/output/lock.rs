//! The lock on the folder of a run, which ensures that only one process trains in it.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};

use super::FolderError;
use densify_core::files::{self, FileError};

/// Name of the locked file, which contains the id of the training process.
pub(super) const LOCK: &str = "densify.lock";

/// Number of attempts if the file is removed by its previous holder while it is being locked.
const TRIES: usize = 10;

/// A lock on a folder, which the system releases when the process ends, even if it is killed.
///
/// Folders are locked only on Unix, whose locks do not prevent reading the file, and only on file systems with locks.
#[derive(Debug)]
pub struct FolderLock {
    path: PathBuf,
    file: Option<File>,
}

impl FolderLock {
    /// Locks a folder.
    ///
    /// # Errors
    /// [`FolderError::InUse`] while another process has the lock; [`FolderError::File`].
    pub fn take(folder: &Path) -> Result<Self, FolderError> {
        let path = folder.join(LOCK);
        if !cfg!(unix) {
            return Ok(Self { path, file: None });
        }
        for _ in 0..TRIES {
            let mut options = OpenOptions::new();
            let options = options.read(true).write(true).create(true).truncate(false);
            let mut file = options.open(&path).map_err(FileError::io("create", &path))?;
            match file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => return Err(in_use(folder, file)),
                // The file system has no locks, like some network file systems.
                Err(TryLockError::Error(_)) => break,
            }
            // The previous holder may have removed the file in the meantime.
            if is_at(&file, &path) {
                let id = std::process::id().to_string();
                // The lock works even if the id cannot be written.
                let _ = file.set_len(0).and_then(|()| file.write_all(id.as_bytes()));
                return Ok(Self { path, file: Some(file) });
            }
        }
        tracing::warn!("{}: the folder cannot be locked against other runs", folder.display());
        Ok(Self { path, file: None })
    }

    /// Checks that no process holds the lock on a folder, without writing anything.
    ///
    /// # Errors
    /// [`FolderError::InUse`].
    pub(super) fn check(folder: &Path) -> Result<(), FolderError> {
        if cfg!(unix)
            && let Ok(file) = files::open(&folder.join(LOCK))
            && matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
        {
            return Err(in_use(folder, file));
        }
        Ok(())
    }

    /// Checks that this process still holds the lock: the folder or the locked file may have been moved or replaced.
    ///
    /// # Errors
    /// [`FolderError::Lost`].
    pub(super) fn confirm(&self) -> Result<(), FolderError> {
        if self.file.as_ref().is_none_or(|file| is_at(file, &self.path)) {
            return Ok(());
        }
        Err(FolderError::Lost { folder: self.path.parent().unwrap_or(&self.path).to_owned() })
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        if self.file.as_ref().is_some_and(|file| is_at(file, &self.path)) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

fn in_use(folder: &Path, mut file: File) -> FolderError {
    let mut id = String::new();
    let read = file.rewind().and_then(|()| Read::take(&mut file, 32).read_to_string(&mut id));
    let process = read.ok().and_then(|_| id.parse::<u32>().ok());
    FolderError::InUse { folder: folder.to_owned(), process }
}

/// True if an open file is the file at a path.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let same =
        |a: std::fs::Metadata, b: std::fs::Metadata| (a.dev(), a.ino()) == (b.dev(), b.ino());
    file.metadata().is_ok_and(|open| path.metadata().is_ok_and(|at_path| same(open, at_path)))
}

#[cfg(not(unix))]
fn is_at(_: &File, _: &Path) -> bool {
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn the_lock_has_one_holder_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        FolderLock::check(path).unwrap();
        let held = FolderLock::take(path).unwrap();
        held.confirm().unwrap();
        let own = std::process::id();
        for refused in [FolderLock::check(path), FolderLock::take(path).map(drop)] {
            let error = refused.unwrap_err();
            assert!(error.to_string().contains(&format!("process {own}")), "{error}");
        }
        drop(held);
        assert_eq!(std::fs::read_dir(path).unwrap().count(), 0);
        // The file of a killed process does not lock the folder.
        std::fs::write(path.join(LOCK), "1").unwrap();
        FolderLock::check(path).unwrap();
        let held = FolderLock::take(path).unwrap();
        // A process that replaces the file gets the lock.
        std::fs::remove_file(path.join(LOCK)).unwrap();
        let other = FolderLock::take(path).unwrap();
        assert!(held.confirm().is_err() && other.confirm().is_ok());
        drop(held);
        other.confirm().unwrap();
    }
}
