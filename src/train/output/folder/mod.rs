//! The folder of a run. Files of two runs are never mixed, and a run is only replaced as a whole.

mod replacement;

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use super::lock::FolderLock;
use super::tensorboard::PREFIX as EVENTS_PREFIX;
use super::{CONFIG_FILE, FolderError};
use densify_core::files::FileError;
use densify_core::files::disk::{Operation, attempt};
use densify_core::files::{RUN_FOLDER_DEPTH, is_temporary, remove_incomplete};
use replacement::{NEW, OLD, REPLACED, ReplaceError, hidden, recover, replace, suffix};

/// Files and folders of a run. Everything else in its folder belongs to the user and is not modified.
const OWNED: [&str; 11] = [
    CHECKPOINTS,
    CONFIG_FILE,
    "cameras.json",
    MODELS,
    "stats",
    "results.json",
    "per_view.json",
    "results_train.json",
    "per_view_train.json",
    "geometry.json",
    "geometry_train.json",
];
/// Name of the folder of models in a run's folder.
const MODELS: &str = "point_cloud";
/// Name of the folder of checkpoints in a run's folder.
pub const CHECKPOINTS: &str = "checkpoints";

/// Path of the model of an iteration.
pub fn model_path(run: &Path, iteration: u32) -> PathBuf {
    run.join(MODELS).join(format!("iteration_{iteration}")).join("point_cloud.ply")
}

/// The iterations whose models a run has saved, in ascending order.
///
/// # Errors
/// [`FolderError::NoRun`] if there is none.
pub fn saved_iterations(run: &Path) -> Result<Vec<u32>, FolderError> {
    let iteration = |name: &OsStr| name.to_str()?.strip_prefix("iteration_")?.parse().ok();
    let entries = fs::read_dir(run.join(MODELS)).into_iter().flatten().flatten();
    let mut saved: Vec<u32> = entries
        .filter_map(|entry| iteration(&entry.file_name()))
        .filter(|&iteration| model_path(run, iteration).is_file())
        .collect();
    saved.sort_unstable();
    if saved.is_empty() {
        return Err(FolderError::no_run(run, "saved model"));
    }
    Ok(saved)
}

/// True if a process is training in a folder.
pub fn is_in_use(run: &Path) -> bool {
    FolderLock::check(run).is_err()
}

/// The folder that a run writes to, locked against other processes while this value lives.
///
/// A new run writes in place. A run that replaces another writes to a hidden folder inside it and replaces the old run
/// in [`finish`](Self::finish); until then the old run is unchanged.
#[derive(Debug)]
pub struct RunFolder {
    target: PathBuf,
    /// True if this run created the folder.
    is_new: bool,
    /// Suffix of the hidden folder of a run that replaces another.
    staged: Option<String>,
    lock: Rc<FolderLock>,
}

/// A handle to check during a run that the folder is still locked.
#[derive(Debug, Clone)]
pub struct Guard(Rc<FolderLock>);

impl Guard {
    /// Checks that the folder was not moved, removed or taken by another process.
    ///
    /// # Errors
    /// [`FolderError::Lost`].
    pub fn check(&self) -> Result<(), FolderError> {
        self.0.confirm()
    }
}

impl RunFolder {
    /// Checks, without writing anything, that a run may be written to `target`.
    ///
    /// # Errors
    /// [`FolderError`] if a process is training there, if `target` is not a folder, and if it contains another run and
    /// `overwrite` is not set.
    pub fn check(target: &Path, overwrite: bool) -> Result<(), FolderError> {
        if !target.is_dir() {
            // A dangling link also occupies the name.
            return match target.symlink_metadata() {
                Ok(_) => Err(FolderError::NotAFolder { path: target.to_owned() }),
                Err(_) => Ok(()),
            };
        }
        FolderLock::check(target)?;
        if !overwrite && !owned_entries(target)?.is_empty() {
            return Err(FolderError::occupied(target));
        }
        Ok(())
    }

    /// Creates the folder, or prepares to replace the run that is in it.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    pub fn create(target: &Path, overwrite: bool) -> Result<Self, FolderError> {
        Self::check(target, overwrite)?;
        let mut folder = Self::lock(target)?;
        // Another process may have trained there since the check.
        let occupied = !owned_entries(target)?.is_empty();
        if occupied && !overwrite {
            return Err(FolderError::occupied(target));
        }
        if occupied {
            let staging = tempfile::Builder::new().prefix(NEW).tempdir_in(target);
            let staging = staging.map_err(FileError::io("create a folder in", target))?.keep();
            folder.staged = suffix(&staging, NEW);
        }
        Ok(folder)
    }

    /// Opens the folder of a run that continues, or that starts again because it has no checkpoint. With `restart` the
    /// files of the run are removed; incomplete files of a killed process are removed in any case.
    ///
    /// # Errors
    /// [`FolderError`] if a process is training there, and if a restart would remove models, checkpoints, or files that
    /// do not belong to a run.
    pub fn resume(target: &Path, restart: bool) -> Result<Self, FolderError> {
        Self::check(target, true)?;
        let folder = Self::lock(target)?;
        if restart {
            // The folder may have changed between the caller's checks and the lock.
            let mut checkpoints =
                fs::read_dir(target.join(CHECKPOINTS)).into_iter().flatten().flatten();
            let has_checkpoint = checkpoints.any(|entry| !is_temporary(&entry.file_name()));
            let is_foreign =
                !target.join(CONFIG_FILE).exists() && !owned_entries(target)?.is_empty();
            if is_foreign || has_checkpoint || saved_iterations(target).is_ok() {
                return Err(FolderError::occupied(target));
            }
            // The configuration stays until it is replaced, so that it is not lost if the process is killed.
            remove_owned(target, |name| name != CONFIG_FILE);
        }
        remove_incomplete(target, RUN_FOLDER_DEPTH);
        Ok(folder)
    }

    /// Creates and locks a folder, and completes or undoes an interrupted replacement in it.
    fn lock(target: &Path) -> Result<Self, FolderError> {
        let is_new = !target.exists();
        let fail = |e| FileError::io("create the folder", target)(e);
        attempt(Operation::Create, target).map_err(fail)?;
        fs::create_dir_all(target).map_err(fail)?;
        let lock = Rc::new(FolderLock::take(target)?);
        recover(target)?;
        let is_empty =
            |path: &PathBuf| !path.join(CHECKPOINTS).exists() && saved_iterations(path).is_err();
        remove_all(Self::staged(target).into_iter().filter(is_empty));
        Ok(Self { target: target.to_owned(), is_new, staged: None, lock })
    }

    /// Completes or undoes an interrupted replacement in `target`, if there is one, so that the folder can be read.
    ///
    /// # Errors
    /// [`FolderError::InUse`], [`FolderError::File`].
    pub fn recover(target: &Path) -> Result<(), FolderError> {
        if hidden(target, OLD).is_empty() && hidden(target, REPLACED).is_empty() {
            return Ok(());
        }
        let _lock = FolderLock::take(target)?;
        Ok(recover(target)?)
    }

    /// A handle to check during the run that the folder is still locked.
    pub fn guard(&self) -> Guard {
        Guard(Rc::clone(&self.lock))
    }

    /// Hidden folders in `target` of interrupted runs that would have replaced the run there.
    pub fn staged(target: &Path) -> Vec<PathBuf> {
        let mut staged = hidden(target, NEW);
        staged.retain(|path| FolderLock::check(path).is_ok());
        staged
    }

    /// The folder to write to.
    pub fn path(&self) -> PathBuf {
        let staged = |suffix: &String| self.target.join(format!("{NEW}{suffix}"));
        self.staged.as_ref().map_or_else(|| self.target.clone(), staged)
    }

    /// Replaces the existing run, if there is one, and removes interrupted runs that would have replaced it; returns
    /// the folder.
    ///
    /// # Errors
    /// [`FolderError::NotReplaced`] with the hidden folder of the new run; the old run stays.
    pub fn finish(self) -> Result<PathBuf, FolderError> {
        let Some(suffix) = &self.staged else {
            return Ok(self.target.clone());
        };
        let confirmed = self.lock.confirm().map_err(|source| ReplaceError { source, aside: None });
        match confirmed.and_then(|()| replace(&self.target, suffix)) {
            Ok(()) => {
                remove_all(Self::staged(&self.target));
                Ok(self.target.clone())
            }
            Err(ReplaceError { source, aside }) => {
                let source = Box::new(source);
                Err(FolderError::NotReplaced { staging: self.path(), aside, source })
            }
        }
    }

    /// Ends a failed run, whose files stay in the returned folder. An existing run stays, too.
    pub fn abandon(self) -> PathBuf {
        self.path()
    }

    /// Ends a run without results by removing its files. An existing run and other files stay.
    pub fn discard(self) {
        let Self { target, is_new, staged, lock } = self;
        match staged {
            Some(suffix) => remove_all([target.join(format!("{NEW}{suffix}"))]),
            None => remove_owned(&target, |_| true),
        }
        drop(lock);
        if is_new {
            // This fails if the user has added files, which then stay.
            let _ = fs::remove_dir(&target);
        }
    }
}

/// Removes folders, ignoring errors.
fn remove_all(folders: impl IntoIterator<Item = PathBuf>) {
    for folder in folders {
        let _ = fs::remove_dir_all(folder);
    }
}

/// Moves the files of a run to another folder.
fn move_run(from: &Path, to: &Path) -> Result<(), FileError> {
    for name in owned_entries(from)? {
        let path = from.join(&name);
        attempt(Operation::Rename, &path)
            .and_then(|()| fs::rename(&path, to.join(&name)))
            .map_err(FileError::io("move", &path))?;
    }
    Ok(())
}

/// Removes the files of a run that match a condition, ignoring errors.
fn remove_owned(folder: &Path, is_removed: impl Fn(&OsStr) -> bool) {
    let names = owned_entries(folder).unwrap_or_default();
    for name in names.into_iter().filter(|name| is_removed(name)) {
        let path = folder.join(name);
        let _ = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
    }
}

/// Names of the files and folders of a run in `folder`.
fn owned_entries(folder: &Path) -> Result<Vec<std::ffi::OsString>, FileError> {
    let mut owned = Vec::new();
    for entry in fs::read_dir(folder).map_err(FileError::io("read the folder", folder))? {
        let name = entry.map_err(FileError::io("read the folder", folder))?.file_name();
        if is_owned(&name) {
            owned.push(name);
        }
    }
    Ok(owned)
}

fn is_owned(name: &OsStr) -> bool {
    let name = name.to_string_lossy();
    OWNED.contains(&&*name) || name.starts_with(EVENTS_PREFIX)
}

#[cfg(test)]
mod tests;
