//! The folder of a run: two runs are never mixed, and a run is replaced only as a whole.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use super::OutputError;
use super::atomic::{RUN_FOLDER_DEPTH, TEMPORARY, is_temporary, remove_incomplete};
use super::disk::{Operation, attempt};
use super::tensorboard::PREFIX as EVENTS_PREFIX;

/// Files and folders of a run. Everything else in its folder belongs to the user and is left alone.
const OWNED: [&str; 11] = [
    CHECKPOINTS,
    "config.toml",
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
const MODELS: &str = "point_cloud";
/// Name of the folder of checkpoints in a run's folder.
pub const CHECKPOINTS: &str = "checkpoints";

/// Path of the model of an iteration.
#[must_use]
pub fn model_path(run: &Path, iteration: u32) -> PathBuf {
    run.join(MODELS).join(format!("iteration_{iteration}")).join("point_cloud.ply")
}

/// The iterations whose model a run has saved, in order.
///
/// # Errors
/// [`OutputError::NoRun`] when there is none.
pub fn saved_iterations(run: &Path) -> Result<Vec<u32>, OutputError> {
    let iteration = |name: &OsStr| name.to_str()?.strip_prefix("iteration_")?.parse().ok();
    let entries = fs::read_dir(run.join(MODELS)).into_iter().flatten().flatten();
    let mut saved: Vec<u32> = entries
        .filter_map(|entry| iteration(&entry.file_name()))
        .filter(|&iteration| model_path(run, iteration).is_file())
        .collect();
    saved.sort_unstable();
    if saved.is_empty() {
        return Err(OutputError::NoRun { path: run.to_owned(), missing: "saved model" });
    }
    Ok(saved)
}

/// The folder that a run writes to.
///
/// A new run writes in place. A run that replaces another writes to a hidden folder inside and takes
/// its place in [`finish`](Self::finish); until then the old run is unchanged.
#[derive(Debug)]
pub struct RunFolder {
    target: PathBuf,
    /// Whether this run created the folder.
    is_new: bool,
    staging: Option<TempDir>,
}

impl RunFolder {
    /// Checks, without writing anything, that a run may go to `target`.
    ///
    /// # Errors
    /// [`OutputError::Occupied`] when it holds another run and `overwrite` is not set;
    /// [`OutputError::NotAFolder`]; [`OutputError::Io`].
    pub fn check(target: &Path, overwrite: bool) -> Result<(), OutputError> {
        if !target.is_dir() {
            // A dangling link is in the way, too.
            return match target.symlink_metadata() {
                Ok(_) => Err(OutputError::NotAFolder { path: target.to_owned() }),
                Err(_) => Ok(()),
            };
        }
        if !overwrite && !owned_entries(target)?.is_empty() {
            return Err(OutputError::Occupied { path: target.to_owned() });
        }
        Ok(())
    }

    /// Creates the folder, or prepares to replace the run that is in it.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    pub fn create(target: &Path, overwrite: bool) -> Result<Self, OutputError> {
        Self::check(target, overwrite)?;
        let is_new = !target.exists();
        let fail = |e| OutputError::io("create the folder", target)(e);
        attempt(Operation::Create, target).map_err(fail)?;
        fs::create_dir_all(target).map_err(fail)?;
        let occupied = !owned_entries(target)?.is_empty();
        let staging = occupied
            .then(|| tempfile::Builder::new().prefix(TEMPORARY).tempdir_in(target))
            .transpose()
            .map_err(OutputError::io("create a folder in", target))?;
        Ok(Self { target: target.to_owned(), is_new, staging })
    }

    /// The folder of a run that continues, or that starts again (`anew`) because it has no checkpoint;
    /// then its files are removed. Incomplete files of a killed process are removed in any case.
    ///
    /// # Errors
    /// [`OutputError::NotAFolder`], [`OutputError::Io`].
    pub fn resume(target: &Path, anew: bool) -> Result<Self, OutputError> {
        Self::check(target, true)?;
        if anew {
            remove_owned(target);
        }
        remove_incomplete(target, RUN_FOLDER_DEPTH);
        let is_new = !target.exists();
        fs::create_dir_all(target).map_err(OutputError::io("create the folder", target))?;
        Ok(Self { target: target.to_owned(), is_new, staging: None })
    }

    /// Hidden folders in `target` of runs that are to replace the one there, or were.
    #[must_use]
    pub fn staged(target: &Path) -> Vec<PathBuf> {
        let entries = fs::read_dir(target).into_iter().flatten().flatten();
        let hidden = entries.filter(|entry| is_temporary(&entry.file_name()));
        hidden.map(|entry| entry.path()).filter(|path| path.is_dir()).collect()
    }

    /// The folder to write to.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.staging.as_ref().map_or(&self.target, |staging| staging.path())
    }

    /// Replaces the existing run, if there is one; returns the folder.
    ///
    /// # Errors
    /// [`OutputError::NotReplaced`] with the hidden folder of the new run; the old run stays.
    pub fn finish(self) -> Result<PathBuf, OutputError> {
        let Self { target, staging, .. } = self;
        let Some(staging) = staging else {
            return Ok(target);
        };
        let staging = staging.keep();
        match replace(&target, &staging) {
            Ok(()) => Ok(target),
            Err(source) => Err(OutputError::NotReplaced { staging, source: Box::new(source) }),
        }
    }

    /// Ends a failed run: an existing run stays, and the files of the failed one are kept in the
    /// returned folder.
    #[must_use]
    pub fn abandon(self) -> PathBuf {
        self.staging.map_or(self.target, TempDir::keep)
    }

    /// Ends a run without results: removes its files. An existing run and other files stay.
    pub fn discard(self) {
        // Dropping the staging folder removes it.
        if self.staging.is_none() {
            remove_owned(&self.target);
            if self.is_new {
                // It stays if the user has put something there.
                let _ = fs::remove_dir(&self.target);
            }
        }
    }
}

/// Replaces the run in `target` by that in `staging`, or leaves both unchanged.
fn replace(target: &Path, staging: &Path) -> Result<(), OutputError> {
    let aside = tempfile::Builder::new()
        .prefix(".densify-old-")
        .tempdir_in(target)
        .map_err(OutputError::io("create a folder in", target))?;
    let moved = move_run(target, aside.path())
        .map_err(|error| (error, false))
        .and_then(|()| move_run(staging, target).map_err(|error| (error, true)));
    let Err((error, half)) = moved else {
        return fs::remove_dir_all(staging).map_err(OutputError::io("remove", staging));
    };
    let back = if half { move_run(target, staging) } else { Ok(()) };
    if back.and_then(|()| move_run(aside.path(), target)).is_err() {
        // Files that cannot be moved back must not be removed with the folder.
        let _ = aside.keep();
    }
    Err(error)
}

/// Moves the files of a run to another folder.
fn move_run(from: &Path, to: &Path) -> Result<(), OutputError> {
    for name in owned_entries(from)? {
        let path = from.join(&name);
        attempt(Operation::Rename, &path)
            .and_then(|()| fs::rename(&path, to.join(&name)))
            .map_err(OutputError::io("move", &path))?;
    }
    Ok(())
}

/// Removes the files of a run, as far as possible.
fn remove_owned(folder: &Path) {
    for name in owned_entries(folder).unwrap_or_default() {
        let path = folder.join(name);
        let _ = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
    }
}

/// Names of the files of a run in `folder`.
fn owned_entries(folder: &Path) -> Result<Vec<std::ffi::OsString>, OutputError> {
    let mut owned = Vec::new();
    for entry in fs::read_dir(folder).map_err(OutputError::io("read the folder", folder))? {
        let name = entry.map_err(OutputError::io("read the folder", folder))?.file_name();
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
mod tests {
    use super::*;
    use crate::output::disk::{Fault, with_fault};

    fn write(path: &Path, text: &str) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    fn tree(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(folder)
            .unwrap()
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_new_run_writes_in_place_beside_foreign_files() {
        let root = tempfile::tempdir().unwrap();
        write(&root.path().join("notes.txt"), "mine");
        let run = RunFolder::create(root.path(), false).unwrap();
        assert_eq!(run.path(), root.path());
        write(&run.path().join("config.toml"), "a");
        assert_eq!(run.finish().unwrap(), root.path());
        assert_eq!(tree(root.path()), ["config.toml", "notes.txt"]);
        let message = RunFolder::create(root.path(), false).unwrap_err().to_string();
        assert!(message.contains("another run") && message.contains("--overwrite"), "{message}");
    }

    #[test]
    fn replacing_touches_only_what_a_run_owns_and_only_at_the_end() {
        let root = tempfile::tempdir().unwrap();
        for name in ["config.toml", "stats/old.jsonl", "events.out.tfevents.1", "notes.txt"] {
            write(&root.path().join(name), "old");
        }
        let before = tree(root.path());
        let run = RunFolder::create(root.path(), true).unwrap();
        write(&run.path().join("config.toml"), "new");
        write(&run.path().join("point_cloud/iteration_1/point_cloud.ply"), "new");
        assert_eq!(fs::read(root.path().join("config.toml")).unwrap(), b"old");
        drop(run);
        assert_eq!(tree(root.path()), before, "a run that is dropped leaves nothing");

        let run = RunFolder::create(root.path(), true).unwrap();
        write(&run.path().join("config.toml"), "new");
        write(&run.path().join("point_cloud/iteration_1/point_cloud.ply"), "new");
        run.finish().unwrap();
        assert_eq!(tree(root.path()), ["config.toml", "notes.txt", "point_cloud"]);
        assert_eq!(fs::read(root.path().join("config.toml")).unwrap(), b"new");
    }

    #[test]
    fn a_run_that_cannot_take_its_place_leaves_the_old_one_there() {
        let root = tempfile::tempdir().unwrap();
        // The first cannot go out of the way, the second cannot come in.
        for file in ["config.toml", "results.json"] {
            for name in ["config.toml", "cameras.json", "stats/old.jsonl"] {
                write(&root.path().join(name), "old");
            }
            let before = tree(root.path());
            let run = RunFolder::create(root.path(), true).unwrap();
            for name in ["config.toml", "cameras.json", "results.json"] {
                write(&run.path().join(name), "new");
            }
            let fault = Fault {
                operation: Operation::Rename,
                file,
                spared: 0,
                kind: std::io::ErrorKind::Other,
            };
            let staging = run.path().to_owned();
            let error = with_fault(Some(fault), || run.finish()).0.unwrap_err().to_string();
            assert!(error.contains(file) && error.contains(&*staging.to_string_lossy()), "{error}");
            assert_eq!(tree(&staging), ["cameras.json", "config.toml", "results.json"]);
            fs::remove_dir_all(staging).unwrap();
            assert_eq!(tree(root.path()), before);
            assert_eq!(fs::read(root.path().join("cameras.json")).unwrap(), b"old");
        }
    }

    #[test]
    fn a_run_that_goes_on_finds_nothing_half_written() {
        let root = tempfile::tempdir().unwrap();
        for name in ["config.toml", "stats/train.jsonl", "point_cloud/iteration_1/point_cloud.ply"]
        {
            write(&root.path().join(name), "old");
        }
        for name in [".densify-1", "stats/.densify-2", "point_cloud/iteration_1/.densify-3"] {
            write(&root.path().join(name), "half");
        }
        write(&root.path().join(".densify-x/checkpoints/a"), "another run, waiting");
        RunFolder::resume(root.path(), false).unwrap();
        assert_eq!(tree(root.path()), [".densify-x", "config.toml", "point_cloud", "stats"]);
        assert_eq!(tree(&root.path().join("stats")), ["train.jsonl"]);
        assert_eq!(tree(&root.path().join("point_cloud/iteration_1")), ["point_cloud.ply"]);
        assert_eq!(RunFolder::staged(root.path()), [root.path().join(".densify-x")]);
        RunFolder::resume(root.path(), true).unwrap();
        assert_eq!(tree(root.path()), [".densify-x"]);
    }

    #[test]
    fn an_abandoned_run_is_kept_beside_the_old_one() {
        let root = tempfile::tempdir().unwrap();
        write(&root.path().join("config.toml"), "old");
        let run = RunFolder::create(root.path(), true).unwrap();
        write(&run.path().join("config.toml"), "new");
        let kept = run.abandon();
        assert_eq!(fs::read(kept.join("config.toml")).unwrap(), b"new");
        assert_eq!(fs::read(root.path().join("config.toml")).unwrap(), b"old");
    }

    #[test]
    fn a_discarded_run_leaves_what_was_there() {
        let root = tempfile::tempdir().unwrap();
        let target = root.path().join("run");
        let discard = |overwrite| {
            let run = RunFolder::create(&target, overwrite).unwrap();
            write(&run.path().join("config.toml"), "new");
            write(&run.path().join("stats/train.jsonl"), "new");
            run.discard();
        };
        discard(false);
        assert!(!target.exists());
        write(&target.join("notes.txt"), "mine");
        discard(false);
        assert_eq!(tree(&target), ["notes.txt"]);
        write(&target.join("config.toml"), "old");
        discard(true);
        assert_eq!(tree(&target), ["config.toml", "notes.txt"]);
        assert_eq!(fs::read(target.join("config.toml")).unwrap(), b"old");
    }

    #[test]
    fn saved_models_are_found_in_numeric_order() {
        let root = tempfile::tempdir().unwrap();
        assert!(matches!(saved_iterations(root.path()), Err(OutputError::NoRun { .. })));
        for iteration in [1_000, 30, 200] {
            write(&model_path(root.path(), iteration), "ply");
        }
        fs::create_dir_all(root.path().join("point_cloud/iteration_7")).unwrap();
        fs::create_dir_all(root.path().join("point_cloud/iteration_x")).unwrap();
        assert_eq!(saved_iterations(root.path()).unwrap(), [30, 200, 1_000]);
    }

    #[test]
    fn checking_writes_nothing() {
        let root = tempfile::tempdir().unwrap();
        let (absent, file) = (root.path().join("a/b"), root.path().join("file"));
        RunFolder::check(&absent, false).unwrap();
        assert!(tree(root.path()).is_empty());
        write(&file, "x");
        let message = RunFolder::check(&file, true).unwrap_err().to_string();
        assert!(message.contains("not a folder"), "{message}");
    }
}
