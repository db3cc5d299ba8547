//! Replaces one run by another by renaming files within the folder. A replacement interrupted at any time can be
//! completed or undone.

use std::fs;
use std::path::{Path, PathBuf};

use super::{FolderError, attempt, move_run, remove_all};
use densify_core::files::FileError;
use densify_core::files::disk::Operation;

/// Prefix of the hidden folder of a run that will replace another; a unique suffix follows.
pub(super) const NEW: &str = ".densify-new-";
/// Prefix of the hidden folder to which the old run is moved, with the same suffix. While it exists, the old run is the
/// valid one.
pub(super) const OLD: &str = ".densify-old-";
/// The prefix to which [`OLD`] is renamed when all of the old run has been moved; from then on the new run is the valid
/// one.
pub(super) const REPLACED: &str = ".densify-replaced-";

/// Reason why a run could not replace another.
pub(super) struct ReplaceError {
    pub(super) source: FolderError,
    /// Folder with the old run or a part of it, if that could not be moved back either.
    pub(super) aside: Option<PathBuf>,
}

/// Replaces the run in `target` by the one in the hidden folder with this suffix, or leaves both unchanged as far as
/// possible. [`recover`] completes or undoes an interrupted replacement.
pub(super) fn replace(target: &Path, suffix: &str) -> Result<(), ReplaceError> {
    let [new, old, replaced] =
        [NEW, OLD, REPLACED].map(|prefix| target.join(format!("{prefix}{suffix}")));
    // Files that cannot be moved back stay where they are, for `recover`.
    let stuck = |source: FileError, aside: &Path, moved_back: Result<(), FileError>| {
        if moved_back.is_ok() {
            let _ = fs::remove_dir(aside);
        }
        ReplaceError { source: source.into(), aside: moved_back.err().map(|_| aside.to_owned()) }
    };
    let created = attempt(Operation::Create, &old).and_then(|()| fs::create_dir(&old));
    created
        .map_err(FileError::io("create the folder", &old))
        .map_err(|source| ReplaceError { source: source.into(), aside: None })?;
    let rename = || attempt(Operation::Rename, &old).and_then(|()| fs::rename(&old, &replaced));
    move_run(target, &old)
        .and_then(|()| rename().map_err(FileError::io("rename", &old)))
        .map_err(|source| stuck(source, &old, move_run(&old, target)))?;
    move_run(&new, target).map_err(|source| {
        let back = move_run(target, &new).and_then(|()| move_run(&replaced, target));
        stuck(source, &replaced, back)
    })?;
    remove_all([new, replaced]);
    Ok(())
}

/// Ends interrupted replacements: if the old run was being moved away, the replacement is undone; if the new run was
/// being moved in, it is completed.
pub(super) fn recover(target: &Path) -> Result<(), FileError> {
    for old in hidden(target, OLD) {
        move_run(&old, target)?;
        remove_all([old]);
    }
    for replaced in hidden(target, REPLACED) {
        let suffix = suffix(&replaced, REPLACED).unwrap_or_default();
        let new = target.join(format!("{NEW}{suffix}"));
        if new.exists() {
            move_run(&new, target)?;
        }
        remove_all([new, replaced]);
    }
    Ok(())
}

/// Folders in `target` whose names have a prefix.
pub(super) fn hidden(target: &Path, prefix: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(target).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.filter(|path| suffix(path, prefix).is_some() && path.is_dir()).collect()
}

/// The rest of a folder's name after a prefix; `None` if the name does not have the prefix.
pub(super) fn suffix(path: &Path, prefix: &str) -> Option<String> {
    Some(path.file_name()?.to_str()?.strip_prefix(prefix)?.to_owned())
}
