//! The lock on the folder of a run: at most one process trains in it, from its first file to its last.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};

use densify_core::files;
use densify_core::files::FileError;

/// Name of the locked file. It holds the number of the process that trains.
pub(super) const LOCK: &str = "densify.lock";

/// How often the file is locked just when its holder removes it, at most.
const TRIES: usize = 10;

/// The lock of a process on a folder; it ends with the process, even by a kill.
///
/// Only Unix has locks that readers of the file need not mind; elsewhere, and on a file system without
/// locks, folders are not guarded.
#[derive(Debug)]
pub(super) struct FolderLock {
    path: PathBuf,
    file: Option<File>,
}

impl FolderLock {
    /// Locks a folder.
    ///
    /// # Errors
    /// [`FileError::Unfit`] while another process has the lock; [`FileError::Io`].
    pub(super) fn take(folder: &Path) -> Result<Self, FileError> {
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
                // Such as a network file system without a lock service.
                Err(TryLockError::Error(_)) => break,
            }
            // The process that had it may have removed the file just before.
            if is_at(&file, &path) {
                let number = std::process::id().to_string();
                // The lock holds without the number, too.
                let _ = file.set_len(0).and_then(|()| file.write_all(number.as_bytes()));
                return Ok(Self { path, file: Some(file) });
            }
        }
        tracing::warn!("{}: the folder cannot be locked against other runs", folder.display());
        Ok(Self { path, file: None })
    }

    /// Fails while a process has the lock on a folder. Writes nothing.
    ///
    /// # Errors
    /// [`FileError::Unfit`].
    pub(super) fn check(folder: &Path) -> Result<(), FileError> {
        if cfg!(unix)
            && let Ok(file) = files::open(&folder.join(LOCK))
            && matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
        {
            return Err(in_use(folder, file));
        }
        Ok(())
    }

    /// Fails when the folder is no longer locked by this process: it, or the file in it, may have been
    /// moved or replaced meanwhile.
    ///
    /// # Errors
    /// [`FileError::Lost`].
    pub(super) fn confirm(&self) -> Result<(), FileError> {
        if self.file.as_ref().is_none_or(|file| is_at(file, &self.path)) {
            return Ok(());
        }
        Err(FileError::Lost { path: self.path.parent().unwrap_or(&self.path).to_owned() })
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        if self.file.as_ref().is_some_and(|file| is_at(file, &self.path)) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

fn in_use(folder: &Path, mut file: File) -> FileError {
    let mut number = String::new();
    let read = file.rewind().and_then(|()| Read::take(&mut file, 32).read_to_string(&mut number));
    let process = read.ok().and_then(|_| number.parse::<u32>().ok());
    let who = process.map_or("another process".to_owned(), |number| format!("process {number}"));
    let folder = folder.display();
    FileError::Unfit(format!(
        "{folder} is in use: {who} is training there; wait for it, stop it, or choose another folder with -o"
    ))
}

/// Whether an open file is the one at a path.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let same =
        |a: std::fs::Metadata, b: std::fs::Metadata| (a.dev(), a.ino()) == (b.dev(), b.ino());
    file.metadata().is_ok_and(|open| path.metadata().is_ok_and(|there| same(open, there)))
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
    fn one_holder_at_a_time_who_is_named_and_leaves_nothing() {
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
        // What a killed process leaves does not lock.
        std::fs::write(path.join(LOCK), "1").unwrap();
        FolderLock::check(path).unwrap();
        let held = FolderLock::take(path).unwrap();
        // Whoever replaces the file has the folder.
        std::fs::remove_file(path.join(LOCK)).unwrap();
        let other = FolderLock::take(path).unwrap();
        assert!(held.confirm().is_err() && other.confirm().is_ok());
        drop(held);
        other.confirm().unwrap();
    }
}
