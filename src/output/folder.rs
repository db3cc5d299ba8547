//! The folder of a run: two runs are never mixed, and a run is replaced only as a whole.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use super::atomic::{RUN_FOLDER_DEPTH, is_temporary, remove_incomplete};
use super::disk::{Operation, attempt};
use super::lock::FolderLock;
use super::tensorboard::PREFIX as EVENTS_PREFIX;
use super::{CONFIG_FILE, OutputError};

/// Files and folders of a run. Everything else in its folder belongs to the user and is left alone.
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

/// Hidden folder of a run that is to replace another, with a suffix of its own.
const NEW: &str = ".densify-new-";
/// Hidden folder to which the old run goes out of the way; of the same suffix. While it is there, the old
/// run is the one that counts.
const OLD: &str = ".densify-old-";
/// What [`OLD`] is called once all of the old run is in it: from then on the new run counts.
const REPLACED: &str = ".densify-replaced-";

/// The folder that a run writes to, locked against other processes for as long as this value lives.
///
/// A new run writes in place. A run that replaces another writes to a hidden folder inside and takes
/// its place in [`finish`](Self::finish); until then the old run is unchanged.
#[derive(Debug)]
pub struct RunFolder {
    target: PathBuf,
    /// Whether this run created the folder.
    is_new: bool,
    /// Suffix of the hidden folder that is written to.
    staged: Option<String>,
    lock: Rc<FolderLock>,
}

/// Tells whether the folder of a run is still its own.
#[derive(Debug, Clone)]
pub struct Guard(Rc<FolderLock>);

impl Guard {
    /// Fails when the folder was moved or removed, or another process has it.
    ///
    /// # Errors
    /// [`OutputError::Lost`].
    pub fn check(&self) -> Result<(), OutputError> {
        match self.0.holds() {
            true => Ok(()),
            false => Err(OutputError::Lost { path: self.0.folder().to_owned() }),
        }
    }
}

impl RunFolder {
    /// Checks, without writing anything, that a run may go to `target`.
    ///
    /// # Errors
    /// [`OutputError::InUse`] while a process trains there; [`OutputError::Occupied`] when it holds
    /// another run and `overwrite` is not set; [`OutputError::NotAFolder`]; [`OutputError::Io`].
    pub fn check(target: &Path, overwrite: bool) -> Result<(), OutputError> {
        if !target.is_dir() {
            // A dangling link is in the way, too.
            return match target.symlink_metadata() {
                Ok(_) => Err(OutputError::NotAFolder { path: target.to_owned() }),
                Err(_) => Ok(()),
            };
        }
        FolderLock::check(target)?;
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
        let mut folder = Self::lock(target)?;
        // Another process may have trained there since.
        let occupied = !owned_entries(target)?.is_empty();
        if occupied && !overwrite {
            return Err(OutputError::Occupied { path: target.to_owned() });
        }
        if occupied {
            let staging = tempfile::Builder::new().prefix(NEW).tempdir_in(target);
            let staging = staging.map_err(OutputError::io("create a folder in", target))?.keep();
            folder.staged = suffix(&staging, NEW);
        }
        Ok(folder)
    }

    /// The folder of a run that continues, or that starts again (`anew`) because it has no checkpoint;
    /// then its files are removed. Incomplete files of a killed process are removed in any case.
    ///
    /// # Errors
    /// [`OutputError::InUse`], [`OutputError::NotAFolder`], [`OutputError::Io`];
    /// [`OutputError::Occupied`] when a run that starts again would remove models or checkpoints, or
    /// files of something that is no run.
    pub fn resume(target: &Path, anew: bool) -> Result<Self, OutputError> {
        Self::check(target, true)?;
        let folder = Self::lock(target)?;
        if anew {
            // What the caller has seen may have changed until the folder was locked.
            let checkpoints =
                fs::read_dir(target.join(CHECKPOINTS)).into_iter().flatten().flatten();
            let has_checkpoint =
                checkpoints.into_iter().any(|entry| !is_temporary(&entry.file_name()));
            let is_foreign =
                !target.join(CONFIG_FILE).exists() && !owned_entries(target)?.is_empty();
            if is_foreign || has_checkpoint || saved_iterations(target).is_ok() {
                return Err(OutputError::Occupied { path: target.to_owned() });
            }
            // Its description stays until it is replaced: a kill must not lose it.
            remove_owned(target, |name| name != CONFIG_FILE);
        }
        remove_incomplete(target, RUN_FOLDER_DEPTH);
        Ok(folder)
    }

    /// Creates and locks a folder, and ends a replacement in it that was interrupted.
    fn lock(target: &Path) -> Result<Self, OutputError> {
        let is_new = !target.exists();
        let fail = |e| OutputError::io("create the folder", target)(e);
        attempt(Operation::Create, target).map_err(fail)?;
        fs::create_dir_all(target).map_err(fail)?;
        let lock = Rc::new(FolderLock::take(target)?);
        recover(target)?;
        let is_worthless =
            |path: &PathBuf| !path.join(CHECKPOINTS).exists() && saved_iterations(path).is_err();
        remove_all(Self::staged(target).into_iter().filter(is_worthless));
        Ok(Self { target: target.to_owned(), is_new, staged: None, lock })
    }

    /// Ends a replacement in `target` that a kill has interrupted, if there is one, so that the folder can
    /// be looked at.
    ///
    /// # Errors
    /// [`OutputError::InUse`], [`OutputError::Io`].
    pub fn settle(target: &Path) -> Result<(), OutputError> {
        if hidden(target, OLD).is_empty() && hidden(target, REPLACED).is_empty() {
            return Ok(());
        }
        let _lock = FolderLock::take(target)?;
        recover(target)
    }

    /// Tells during the run whether the folder is still its own.
    #[must_use]
    pub fn guard(&self) -> Guard {
        Guard(Rc::clone(&self.lock))
    }

    /// Hidden folders in `target` of runs that were to replace the one there and were interrupted.
    #[must_use]
    pub fn staged(target: &Path) -> Vec<PathBuf> {
        let mut staged = hidden(target, NEW);
        staged.retain(|path| FolderLock::check(path).is_ok());
        staged
    }

    /// The folder to write to.
    #[must_use]
    pub fn path(&self) -> PathBuf {
        let staged = |suffix: &String| self.target.join(format!("{NEW}{suffix}"));
        self.staged.as_ref().map_or_else(|| self.target.clone(), staged)
    }

    /// Replaces the existing run, if there is one, and removes earlier ones that were to replace it and
    /// were interrupted; returns the folder.
    ///
    /// # Errors
    /// [`OutputError::NotReplaced`] with the hidden folder of the new run; the old run stays.
    pub fn finish(self) -> Result<PathBuf, OutputError> {
        let Some(suffix) = &self.staged else {
            return Ok(self.target.clone());
        };
        match self.guard().check().and_then(|()| replace(&self.target, suffix)) {
            Ok(()) => {
                remove_all(Self::staged(&self.target));
                Ok(self.target.clone())
            }
            Err(source) => {
                Err(OutputError::NotReplaced { staging: self.path(), source: Box::new(source) })
            }
        }
    }

    /// Ends a failed run: an existing run stays, and the files of the failed one are kept in the
    /// returned folder.
    #[must_use]
    pub fn abandon(self) -> PathBuf {
        self.path()
    }

    /// Ends a run without results: removes its files. An existing run and other files stay.
    pub fn discard(self) {
        let Self { target, is_new, staged, lock } = self;
        match staged {
            Some(suffix) => remove_all([target.join(format!("{NEW}{suffix}"))]),
            None => remove_owned(&target, |_| true),
        }
        drop(lock);
        if is_new {
            // It stays if the user has put something there.
            let _ = fs::remove_dir(&target);
        }
    }
}

/// Replaces the run in `target` by that in the hidden folder of this suffix, or leaves both unchanged.
/// Killed within, it is ended by [`recover`].
fn replace(target: &Path, suffix: &str) -> Result<(), OutputError> {
    let [new, old, replaced] =
        [NEW, OLD, REPLACED].map(|prefix| target.join(format!("{prefix}{suffix}")));
    fs::create_dir(&old).map_err(OutputError::io("create the folder", &old))?;
    let out_of_the_way = move_run(target, &old)
        .and_then(|()| fs::rename(&old, &replaced).map_err(OutputError::io("rename", &old)));
    if let Err(error) = out_of_the_way {
        // What cannot be moved back stays where it is, for `recover`.
        let _ = move_run(&old, target).map(|()| fs::remove_dir(&old));
        return Err(error);
    }
    if let Err(error) = move_run(&new, target) {
        let _ = move_run(target, &new)
            .and_then(|()| move_run(&replaced, target))
            .map(|()| fs::remove_dir(&replaced));
        return Err(error);
    }
    remove_all([new, replaced]);
    Ok(())
}

/// Ends replacements that a kill has interrupted: one whose old run was still moving out is undone,
/// one whose new run was moving in is completed.
fn recover(target: &Path) -> Result<(), OutputError> {
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
fn hidden(target: &Path, prefix: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(target).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.filter(|path| suffix(path, prefix).is_some() && path.is_dir()).collect()
}

/// What follows the prefix in the name of a folder.
fn suffix(path: &Path, prefix: &str) -> Option<String> {
    Some(path.file_name()?.to_str()?.strip_prefix(prefix)?.to_owned())
}

/// Removes folders, as far as possible.
fn remove_all(folders: impl IntoIterator<Item = PathBuf>) {
    for folder in folders {
        let _ = fs::remove_dir_all(folder);
    }
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

/// Removes those files of a run that are meant, as far as possible.
fn remove_owned(folder: &Path, is_meant: impl Fn(&OsStr) -> bool) {
    let names = owned_entries(folder).unwrap_or_default();
    for name in names.into_iter().filter(|name| is_meant(name)) {
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
    use crate::output::lock::LOCK;

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
        run.discard();
        assert_eq!(tree(root.path()), before, "a run that is discarded leaves nothing");

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
        write(&root.path().join(".densify-new-x/checkpoints/a"), "another run, waiting");
        write(&root.path().join(".densify-new-y/config.toml"), "killed before it had anything");
        drop(RunFolder::resume(root.path(), false).unwrap());
        assert_eq!(tree(root.path()), [".densify-new-x", "config.toml", "point_cloud", "stats"]);
        assert_eq!(tree(&root.path().join("stats")), ["train.jsonl"]);
        assert_eq!(tree(&root.path().join("point_cloud/iteration_1")), ["point_cloud.ply"]);
        assert_eq!(RunFolder::staged(root.path()), [root.path().join(".densify-new-x")]);
        // To start again would remove a model.
        assert!(matches!(RunFolder::resume(root.path(), true), Err(OutputError::Occupied { .. })));
        fs::remove_dir_all(root.path().join("point_cloud")).unwrap();
        drop(RunFolder::resume(root.path(), true).unwrap());
        assert_eq!(tree(root.path()), [".densify-new-x", "config.toml"]);
        // Without a description it is no run.
        fs::rename(root.path().join("config.toml"), root.path().join("stats")).unwrap();
        assert!(matches!(RunFolder::resume(root.path(), true), Err(OutputError::Occupied { .. })));
        fs::rename(root.path().join("stats"), root.path().join("config.toml")).unwrap();
        let run = RunFolder::create(root.path(), true).unwrap();
        write(&run.path().join("config.toml"), "new");
        run.finish().unwrap();
        assert_eq!(tree(root.path()), ["config.toml"]);
    }

    #[test]
    fn a_replacement_that_is_killed_is_ended_by_the_next_run() {
        const OLD_RUN: [&str; 2] = ["cameras.json", "config.toml"];
        const NEW_RUN: [&str; 2] = ["config.toml", "results.json"];
        // What has moved when the kill comes: of the old run, then of the new one.
        for (out, moved_in) in
            [(0, None), (1, None), (2, None), (2, Some(0)), (2, Some(1)), (2, Some(2))]
        {
            let root = tempfile::tempdir().unwrap();
            let aside = if moved_in.is_some() { REPLACED } else { OLD };
            for (number, name) in OLD_RUN.iter().enumerate() {
                let folder = if number < out { format!("{aside}x/") } else { String::new() };
                write(&root.path().join(folder + name), "old");
            }
            for (number, name) in NEW_RUN.iter().enumerate() {
                let is_in = moved_in.is_some_and(|count| number < count);
                let folder = if is_in { String::new() } else { format!("{NEW}x/") };
                write(&root.path().join(folder + name), "new");
            }
            RunFolder::settle(root.path()).unwrap();
            // What was not yet replacing anything goes when the next run begins.
            drop(RunFolder::resume(root.path(), false).unwrap());
            let (names, text) = match moved_in {
                None => (OLD_RUN, "old"),
                Some(_) => (NEW_RUN, "new"),
            };
            assert_eq!(tree(root.path()), names, "{out} out, {moved_in:?} in");
            assert_eq!(fs::read_to_string(root.path().join("config.toml")).unwrap(), text);
        }
    }

    #[test]
    fn a_folder_in_use_is_neither_replaced_nor_resumed() {
        let root = tempfile::tempdir().unwrap();
        let run = RunFolder::create(root.path(), false).unwrap();
        write(&run.path().join("config.toml"), "a");
        let refused = [
            RunFolder::check(root.path(), true),
            RunFolder::create(root.path(), true).map(drop),
            RunFolder::resume(root.path(), false).map(drop),
        ];
        for refused in refused {
            assert!(matches!(refused, Err(OutputError::InUse { .. })), "{refused:?}");
        }
        run.finish().unwrap();
        let replacing = RunFolder::create(root.path(), true).unwrap();
        write(&replacing.path().join("config.toml"), "b");
        assert!(RunFolder::check(root.path(), true).is_err());
        // The lock is tested again at the end.
        fs::remove_file(root.path().join(LOCK)).unwrap();
        assert!(matches!(replacing.finish(), Err(OutputError::NotReplaced { .. })));
        assert_eq!(fs::read(root.path().join("config.toml")).unwrap(), b"a");
    }

    #[cfg(unix)]
    #[test]
    fn a_run_whose_folder_is_moved_knows_it() {
        let root = tempfile::tempdir().unwrap();
        let target = root.path().join("run");
        let run = RunFolder::create(&target, false).unwrap();
        run.guard().check().unwrap();
        fs::rename(&target, root.path().join("moved")).unwrap();
        assert!(matches!(run.guard().check(), Err(OutputError::Lost { .. })));
        let other = RunFolder::create(&target, false).unwrap();
        assert!(run.guard().check().is_err() && other.guard().check().is_ok());
        drop(run);
        other.guard().check().unwrap();
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
