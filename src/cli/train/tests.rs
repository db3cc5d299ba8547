//! Tests of what `docs/errors.md` promises for faults of the disk and the device.

use std::io::ErrorKind;
use std::path::PathBuf;

use clap::FromArgMatches;
use tempfile::TempDir;

use super::*;
use densify_core::files::disk::{Fault, Operation, with_fault};
use densify_fixtures::Made;
#[cfg(feature = "gpu")]
use densify_render::{
    AdapterKind,
    gpu::{adapters, with_device_lost_after},
};
#[cfg(feature = "gpu")]
use densify_run::failure::DEVICE;
use densify_run::failure::{INPUT, OTHER};
use densify_train::output::model_path;

const OPERATIONS: [Operation; 5] =
    [Operation::Create, Operation::Write, Operation::Flush, Operation::Sync, Operation::Rename];
/// A full disk, and a broken one.
const KINDS: [ErrorKind; 2] = [ErrorKind::StorageFull, ErrorKind::Other];

struct Case {
    scene: Made,
    root: TempDir,
}

impl Case {
    fn new() -> Self {
        Self { scene: Made::colmap_txt(), root: tempfile::tempdir().unwrap() }
    }

    fn run(&self) -> PathBuf {
        self.root.path().join("run")
    }

    /// Trains for 12 steps with checkpoints after 4, 8 and 12, and with models after 5 and 12.
    fn train(&self, flags: &str) -> Result<(), Failure> {
        let run_folder = self.run();
        let words = ["densify", "train"]
            .into_iter()
            .chain([self.scene.path().to_str().unwrap(), "-o", run_folder.to_str().unwrap()])
            .chain(["--iterations", "12", "--budget", "250", "--sh-degree", "0", "--quiet"])
            .chain(["--save-iterations", "5", "--checkpoint-every", "4", "--test-every", "3"])
            .chain(flags.split_whitespace());
        let matches = crate::command().try_get_matches_from(words).unwrap();
        let matches = matches.subcommand_matches("train").unwrap();
        run(&mut TrainArgs::from_arg_matches(matches).unwrap(), matches, &Console::new(true))
    }

    /// Trains with a fault; returns the exit code and the message. Fails if the fault never occurred.
    fn train_with_fault(
        &self,
        operation: Operation,
        file: &'static str,
        spared: u32,
        kind: ErrorKind,
    ) -> (u8, String) {
        let fault = Fault { operation, file, spared, kind };
        let (done, met) = with_fault(Some(fault), || self.train(""));
        assert!(met > 0, "{fault:?} did not occur");
        self.check_no_temporary_files();
        done.map_or_else(|failure| (failure.code, failure.to_string()), |()| (0, String::new()))
    }

    fn check_no_temporary_files(&self) {
        let mut folders = vec![self.root.path().to_owned()];
        while let Some(folder) = folders.pop() {
            for path in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
                let name = path.file_name().unwrap().to_string_lossy().into_owned();
                assert!(!name.starts_with('.'), "{} is left", path.display());
                if path.is_dir() {
                    folders.push(path);
                }
            }
        }
    }

    fn checkpoints(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.run().join("checkpoints")).into_iter().flatten();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut steps: Vec<String> =
            names.map(|name| name.replace("iteration_", "").replace(".safetensors", "")).collect();
        steps.sort();
        steps
    }

    fn model(&self) -> Vec<u8> {
        std::fs::read(model_path(&self.run(), 12)).unwrap()
    }

    fn remove_run(&self) {
        if self.run().exists() {
            std::fs::remove_dir_all(self.run()).unwrap();
        }
    }
}

#[test]
fn a_run_that_cannot_write_its_first_files_leaves_nothing() {
    let case = Case::new();
    let files = [
        (Operation::Create, "run", 0),
        (Operation::Write, "config.toml", 0),
        (Operation::Sync, "cameras.json", 0),
        (Operation::Create, "stats/train.jsonl", 0),
        (Operation::Create, "stats/events.jsonl", 0),
        (Operation::Write, ".densify", 0),
    ];
    for (operation, file, spared) in files {
        for kind in KINDS {
            let (code, message) = case.train_with_fault(operation, file, spared, kind);
            assert_eq!(code, OTHER, "{message}");
            assert!(message.contains(file) && message.contains("cannot"), "{message}");
            assert!(message.contains(&std::io::Error::from(kind).to_string()), "{message}");
            assert!(!case.run().exists(), "{operation:?} {file}");
        }
    }
}

#[test]
fn a_failed_checkpoint_does_not_harm_the_run() {
    let case = Case::new();
    case.train("").unwrap();
    let expected = case.model();
    assert_eq!(case.checkpoints(), ["12", "8"]);
    for operation in OPERATIONS {
        for (kind, file, left) in [
            (ErrorKind::StorageFull, "iteration_8.safetensors", ["12", "4"]),
            (ErrorKind::Other, "iteration_12.safetensors", ["4", "8"]),
        ] {
            case.remove_run();
            assert_eq!(
                case.train_with_fault(operation, file, 0, kind),
                (0, String::new()),
                "{operation:?}"
            );
            assert_eq!(case.checkpoints(), left, "{operation:?}");
            assert!(case.model() == expected);
        }
    }
    // A checkpoint must reach the disk after the logs that it refers to.
    for log in ["stats/train.jsonl", "stats/events.jsonl", ".densify"] {
        case.remove_run();
        assert_eq!(
            case.train_with_fault(Operation::Sync, log, 0, KINDS[1]),
            (0, String::new()),
            "{log}"
        );
        assert!(case.checkpoints().is_empty(), "{log}");
        assert!(case.model() == expected);
    }
}

#[test]
fn a_run_stopped_by_the_disk_can_be_resumed() {
    let case = Case::new();
    case.train("").unwrap();
    let expected = case.model();
    let faults: [(&[Operation], &str, u32, &[&str]); 7] = [
        (&OPERATIONS, "iteration_12/point_cloud.ply", 0, &["4", "8"]),
        (&OPERATIONS, "iteration_5/point_cloud.ply", 0, &["4"]),
        (&OPERATIONS, "results.json", 0, &["4", "8"]),
        (&OPERATIONS, "stats/summary.json", 0, &["12", "8"]),
        (&[Operation::Write], "stats/train.jsonl", 0, &["4", "8"]),
        // The TensorBoard file: its first write is the header; the others are the record of step 10 and the scores of
        // step 12.
        (&[Operation::Write], ".densify", 1, &["4", "8"]),
        (&[Operation::Write], ".densify", 2, &["4", "8"]),
    ];
    for (operations, file, spared, left) in faults {
        for (&operation, kind) in operations.iter().zip(KINDS.iter().copied().cycle()) {
            case.remove_run();
            let (code, message) = case.train_with_fault(operation, file, spared, kind);
            let context = format!("{operation:?} {file}: {message}");
            assert_eq!(code, OTHER, "{context}");
            let system = std::io::Error::from(kind).to_string();
            for words in [file, "cannot write", &system, "files written so far are in"] {
                assert!(message.contains(words), "{words:?} is not in: {context}");
            }
            assert_eq!(case.checkpoints(), left, "{context}");
            case.train("--resume").unwrap_or_else(|e| panic!("{context}: {e}"));
            assert!(case.model() == expected, "{context}");
            assert!(case.run().join("stats/summary.json").exists(), "{context}");
        }
    }
}

/// Names of the software drivers, which every machine that runs the GPU tests has.
#[cfg(feature = "gpu")]
#[expect(clippy::print_stderr, reason = "a skipped test must say so")]
fn software_drivers() -> Vec<String> {
    let names: Vec<String> = adapters()
        .into_iter()
        .filter(|adapter| adapter.kind == AdapterKind::Software && adapter.missing.is_empty())
        .map(|adapter| adapter.name)
        .collect();
    if names.is_empty() {
        let needed = std::env::var_os("DENSIFY_REQUIRE_GPU").is_some();
        assert!(!needed, "DENSIFY_REQUIRE_GPU is set, but there is no software driver");
        eprintln!("skipped: there is no software driver whose device could be lost");
    }
    names
}

#[cfg(feature = "gpu")]
#[test]
fn a_run_stopped_by_a_lost_device_can_be_resumed() {
    for driver in software_drivers() {
        let case = Case::new();
        let name = driver.split(' ').next().unwrap();
        let on_gpu = format!("--backend gpu --gpu {name} --deterministic");
        case.train(&on_gpu).unwrap();
        let expected = case.model();
        let (mut before, mut after) = (0, 0);
        for checks in [1, 40, 80, 120, 160, 240] {
            case.remove_run();
            let (done, lost) = with_device_lost_after(checks, || case.train(&on_gpu));
            if !lost {
                assert!(done.is_ok() && after > 0, "{driver}: {checks} checks are too many");
                continue;
            }
            let Err(failure) = done else {
                // Lost while the last checkpoint was written, after all other files.
                assert!(case.model() == expected, "{driver}: {checks}");
                continue;
            };
            let (code, message) = (failure.code, failure.to_string());
            let context = format!("{driver}, {checks} checks: {message}");
            assert_eq!(code, DEVICE, "{context}");
            assert!(message.contains("was lost") && message.contains(&driver), "{context}");
            case.check_no_temporary_files();
            let kept = case.checkpoints();
            match kept.last() {
                None => before += 1,
                Some(step) => {
                    after += 1;
                    let words = format!("iteration_{step}.safetensors; continue with: ");
                    assert!(message.contains(&words), "{context}");
                    case.train("--resume").unwrap_or_else(|e| panic!("{context}: {e}"));
                    assert!(case.model() == expected, "{context}");
                }
            }
        }
        assert!(before > 0 && after > 0, "{driver}: {before} before a checkpoint, {after} after");
    }
}

#[test]
fn short_writes_are_continued() {
    let case = Case::new();
    case.train("").unwrap();
    let expected = case.model();
    let events = std::fs::read(case.run().join("stats/events.jsonl")).unwrap();
    case.remove_run();
    // Without a fault, `with_fault` makes every write accept a single byte.
    with_fault(None, || case.train("")).0.unwrap();
    assert!(case.model() == expected);
    assert!(std::fs::read(case.run().join("stats/events.jsonl")).unwrap() == events);
    std::fs::remove_file(case.run().join("checkpoints/iteration_12.safetensors")).unwrap();
    case.train("--resume").unwrap();
    assert!(case.model() == expected, "a checkpoint written byte by byte");
}

#[test]
fn a_file_in_place_of_the_run_folder_is_refused_and_kept() {
    let case = Case::new();
    std::fs::write(case.run(), "a file").unwrap();
    for flags in ["", "--overwrite", "--resume"] {
        let failure = case.train(flags).unwrap_err();
        assert_eq!(failure.code, INPUT, "{failure}");
        assert!(failure.to_string().contains("is not a folder"), "{failure}");
    }
    assert_eq!(std::fs::read(case.run()).unwrap(), b"a file");
}
