//! Tests of run folders: runs that start, end, fail, replace each other, and are interrupted.

use super::*;
use crate::output::lock::LOCK;
use densify_core::files::disk::{Fault, with_fault};

fn write(path: &Path, text: &str) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, text).unwrap();
}

fn entries(folder: &Path) -> Vec<String> {
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
    assert_eq!(entries(root.path()), ["config.toml", "notes.txt"]);
    let error = RunFolder::create(root.path(), false).unwrap_err();
    assert!(matches!(error, FolderError::Occupied { .. }), "{error}");
    assert!(error.to_string().contains("another run"), "{error}");
}

#[test]
fn replacing_affects_only_files_of_runs_and_only_at_the_end() {
    let root = tempfile::tempdir().unwrap();
    for name in ["config.toml", "stats/old.jsonl", "events.out.tfevents.1", "notes.txt"] {
        write(&root.path().join(name), "old");
    }
    let before = entries(root.path());
    let run = RunFolder::create(root.path(), true).unwrap();
    write(&run.path().join("config.toml"), "new");
    write(&run.path().join("point_cloud/iteration_1/point_cloud.ply"), "new");
    assert_eq!(fs::read(root.path().join("config.toml")).unwrap(), b"old");
    run.discard();
    assert_eq!(entries(root.path()), before, "a run that is discarded leaves nothing");

    let run = RunFolder::create(root.path(), true).unwrap();
    write(&run.path().join("config.toml"), "new");
    write(&run.path().join("point_cloud/iteration_1/point_cloud.ply"), "new");
    run.finish().unwrap();
    assert_eq!(entries(root.path()), ["config.toml", "notes.txt", "point_cloud"]);
    assert_eq!(fs::read(root.path().join("config.toml")).unwrap(), b"new");
}

#[test]
fn a_failed_replacement_leaves_the_old_run_unchanged() {
    let root = tempfile::tempdir().unwrap();
    // First, a file of the old run cannot be moved away; then, a file of the new run cannot be moved in.
    for file in ["config.toml", "results.json"] {
        for name in ["config.toml", "cameras.json", "stats/old.jsonl"] {
            write(&root.path().join(name), "old");
        }
        let before = entries(root.path());
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
        assert_eq!(entries(&staging), ["cameras.json", "config.toml", "results.json"]);
        fs::remove_dir_all(staging).unwrap();
        assert_eq!(entries(root.path()), before);
        assert_eq!(fs::read(root.path().join("cameras.json")).unwrap(), b"old");
    }
}

/// If moving fails, and moving back too, the message names the folders of all files, and the next run recovers the
/// files.
#[test]
fn a_stuck_replacement_is_reported_and_recovered() {
    // The operation that fails, the file, the number of times that it succeeds before, the prefix of the folder set
    // aside for the old run, and the run that is in place after recovery.
    for (operation, file, spared, aside, valid) in [
        (Operation::Create, "", 0, None, "old"),
        (Operation::Rename, "", 1, Some(OLD), "old"),
        (Operation::Rename, "", 2, Some(OLD), "old"),
        (Operation::Rename, "", 3, Some(REPLACED), "new"),
        (Operation::Rename, "", 4, Some(REPLACED), "new"),
    ] {
        let root = tempfile::tempdir().unwrap();
        for name in ["cameras.json", "config.toml"] {
            write(&root.path().join(name), "old");
        }
        let run = RunFolder::create(root.path(), true).unwrap();
        for name in ["config.toml", "results.json"] {
            write(&run.path().join(name), "new");
        }
        let fault = Fault { operation, file, spared, kind: std::io::ErrorKind::Other };
        let error = with_fault(Some(fault), || run.finish()).0.unwrap_err().to_string();
        let case = format!("{operation:?} {spared}: {error}");
        let aside_folder = entries(root.path())
            .into_iter()
            .find(|name| aside.is_some_and(|aside| name.starts_with(aside)));
        assert_eq!(aside_folder.is_some(), aside.is_some(), "{case}");
        assert_eq!(error.contains("is unchanged"), aside.is_none(), "{case}");
        assert!(aside_folder.is_none_or(|name| error.contains(&name)), "{case}");
        RunFolder::recover(root.path()).unwrap();
        assert_eq!(fs::read_to_string(root.path().join("config.toml")).unwrap(), valid, "{case}");
        assert_eq!(root.path().join("cameras.json").exists(), valid == "old", "{case}");
    }
}

#[test]
fn a_resumed_run_has_no_incomplete_files() {
    let root = tempfile::tempdir().unwrap();
    for name in ["config.toml", "stats/train.jsonl", "point_cloud/iteration_1/point_cloud.ply"] {
        write(&root.path().join(name), "old");
    }
    for name in [".densify-1", "stats/.densify-2", "point_cloud/iteration_1/.densify-3"] {
        write(&root.path().join(name), "half");
    }
    write(&root.path().join(".densify-new-x/checkpoints/a"), "another run, waiting");
    write(&root.path().join(".densify-new-y/config.toml"), "killed before it had anything");
    drop(RunFolder::resume(root.path(), false).unwrap());
    assert_eq!(entries(root.path()), [".densify-new-x", "config.toml", "point_cloud", "stats"]);
    assert_eq!(entries(&root.path().join("stats")), ["train.jsonl"]);
    assert_eq!(entries(&root.path().join("point_cloud/iteration_1")), ["point_cloud.ply"]);
    assert_eq!(RunFolder::staged(root.path()), [root.path().join(".densify-new-x")]);
    // A restart is refused while it would remove a model.
    assert!(RunFolder::resume(root.path(), true).unwrap_err().to_string().contains("another run"));
    fs::remove_dir_all(root.path().join("point_cloud")).unwrap();
    drop(RunFolder::resume(root.path(), true).unwrap());
    assert_eq!(entries(root.path()), [".densify-new-x", "config.toml"]);
    // Without a configuration the files do not belong to a run.
    fs::rename(root.path().join("config.toml"), root.path().join("stats")).unwrap();
    assert!(RunFolder::resume(root.path(), true).unwrap_err().to_string().contains("another run"));
    fs::rename(root.path().join("stats"), root.path().join("config.toml")).unwrap();
    let run = RunFolder::create(root.path(), true).unwrap();
    write(&run.path().join("config.toml"), "new");
    run.finish().unwrap();
    assert_eq!(entries(root.path()), ["config.toml"]);
}

#[test]
fn an_interrupted_replacement_is_completed_or_undone_by_the_next_run() {
    const OLD_RUN: [&str; 2] = ["cameras.json", "config.toml"];
    const NEW_RUN: [&str; 2] = ["config.toml", "results.json"];
    // Numbers of files of the old and of the new run that had been moved before the interruption; `None` for the new
    // run if the old run was still being moved.
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
        RunFolder::recover(root.path()).unwrap();
        // A replacement that had not started is discarded when the next run starts.
        drop(RunFolder::resume(root.path(), false).unwrap());
        let (names, text) = match moved_in {
            None => (OLD_RUN, "old"),
            Some(_) => (NEW_RUN, "new"),
        };
        assert_eq!(entries(root.path()), names, "{out} out, {moved_in:?} in");
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
        assert!(refused.unwrap_err().to_string().contains("is in use"));
    }
    run.finish().unwrap();
    let replacing = RunFolder::create(root.path(), true).unwrap();
    write(&replacing.path().join("config.toml"), "b");
    assert!(RunFolder::check(root.path(), true).is_err());
    // The lock is checked again at the end.
    fs::remove_file(root.path().join(LOCK)).unwrap();
    assert!(matches!(replacing.finish(), Err(FolderError::NotReplaced { .. })));
    assert_eq!(fs::read(root.path().join("config.toml")).unwrap(), b"a");
}

#[cfg(unix)]
#[test]
fn a_moved_folder_is_detected() {
    let root = tempfile::tempdir().unwrap();
    let target = root.path().join("run");
    let run = RunFolder::create(&target, false).unwrap();
    run.guard().check().unwrap();
    fs::rename(&target, root.path().join("moved")).unwrap();
    assert!(matches!(run.guard().check(), Err(FolderError::Lost { .. })));
    let other = RunFolder::create(&target, false).unwrap();
    assert!(run.guard().check().is_err() && other.guard().check().is_ok());
    drop(run);
    other.guard().check().unwrap();
}

#[test]
fn an_abandoned_run_and_the_old_one_are_both_kept() {
    let root = tempfile::tempdir().unwrap();
    write(&root.path().join("config.toml"), "old");
    let run = RunFolder::create(root.path(), true).unwrap();
    write(&run.path().join("config.toml"), "new");
    let kept = run.abandon();
    assert_eq!(fs::read(kept.join("config.toml")).unwrap(), b"new");
    assert_eq!(fs::read(root.path().join("config.toml")).unwrap(), b"old");
}

#[test]
fn a_discarded_run_leaves_other_files() {
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
    assert_eq!(entries(&target), ["notes.txt"]);
    write(&target.join("config.toml"), "old");
    discard(true);
    assert_eq!(entries(&target), ["config.toml", "notes.txt"]);
    assert_eq!(fs::read(target.join("config.toml")).unwrap(), b"old");
}

#[test]
fn saved_models_are_found_in_numeric_order() {
    let root = tempfile::tempdir().unwrap();
    assert!(saved_iterations(root.path()).unwrap_err().to_string().contains("no saved model"));
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
    assert!(entries(root.path()).is_empty());
    write(&file, "x");
    let message = RunFolder::check(&file, true).unwrap_err().to_string();
    assert!(message.contains("not a folder"), "{message}");
}
