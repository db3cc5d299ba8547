//! How a run takes the place of another: by renaming within the folder, so that a kill at any moment leaves
//! enough to end or undo it.

use std::fs;
use std::path::{Path, PathBuf};

use super::{attempt, move_run, remove_all};
use densify_core::files::FileError;
use densify_core::files::disk::Operation;

/// Hidden folder of a run that is to replace another, with a suffix of its own.
pub(super) const NEW: &str = ".densify-new-";
/// Hidden folder to which the old run goes out of the way; of the same suffix. While it is there, the old
/// run is the one that counts.
pub(super) const OLD: &str = ".densify-old-";
/// What [`OLD`] is called once all of the old run is in it: from then on the new run counts.
pub(super) const REPLACED: &str = ".densify-replaced-";

/// Why a run could not take the place of another.
pub(super) struct Stuck {
    pub(super) source: FileError,
    /// Where (part of) the old run lies, if it could not be moved back either.
    pub(super) aside: Option<PathBuf>,
}

/// Replaces the run in `target` by that in the hidden folder of this suffix, or leaves both unchanged as
/// far as possible. Killed or stuck within, it is ended by [`recover`].
pub(super) fn replace(target: &Path, suffix: &str) -> Result<(), Stuck> {
    let [new, old, replaced] =
        [NEW, OLD, REPLACED].map(|prefix| target.join(format!("{prefix}{suffix}")));
    // What cannot be moved back stays where it is, for `recover`.
    let stuck = |source, aside: &Path, moved_back: Result<(), FileError>| {
        if moved_back.is_ok() {
            let _ = fs::remove_dir(aside);
        }
        Stuck { source, aside: moved_back.err().map(|_| aside.to_owned()) }
    };
    let created = attempt(Operation::Create, &old).and_then(|()| fs::create_dir(&old));
    created
        .map_err(FileError::io("create the folder", &old))
        .map_err(|source| Stuck { source, aside: None })?;
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

/// Ends replacements that a kill has interrupted: one whose old run was still moving out is undone,
/// one whose new run was moving in is completed.
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

/// Folders in `target` whose names begin so.
pub(super) fn hidden(target: &Path, prefix: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(target).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.filter(|path| suffix(path, prefix).is_some() && path.is_dir()).collect()
}

/// What follows the prefix in the name of a folder.
pub(super) fn suffix(path: &Path, prefix: &str) -> Option<String> {
    Some(path.file_name()?.to_str()?.strip_prefix(prefix)?.to_owned())
}
