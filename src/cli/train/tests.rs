//! Faults of the disk and of the device have the consequences that `docs/errors.md` promises.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use clap::FromArgMatches;
use tempfile::TempDir;

use super::*;
use densify_core::files::disk::{Fault, Operation, with_fault};
use densify_fixtures::Made;
use densify_render::AdapterKind;
use densify_render::gpu::{adapters, with_device_lost_after};
use densify_run::failure::{DEVICE, INPUT, OTHER};
use densify_train::output::model_path;

const OPERATIONS: [Operation; 5] =
    [Operation::Create, Operation::Write, Operation::Flush, Operation::Sync, Operation::Rename];
/// A full disk and a broken one.
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
        run(&TrainArgs::from_arg_matches(matches).unwrap(), matches, &Console::new(true))
    }

    /// Trains with a fault and returns the result; panics if the fault never occurred.
    fn fault(
        &self,
        operation: Operation,
        file: &'static str,
        spared: u32,
        kind: ErrorKind,
    ) -> (u8, String) {
        let fault = Fault { operation, file, spared, kind };
        let (done, met) = with_fault(Some(fault), || self.train(""));
        assert!(met > 0, "{fault:?} was not met");
        self.nothing_half_written();
        done.map_or_else(|failure| (failure.code, failure.to_string()), |()| (0, String::new()))
    }

    fn nothing_half_written(&self) {
        let mut open = vec![self.root.path().to_owned()];
        while let Some(folder) = open.pop() {
            for path in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
                let name = path.file_name().unwrap().to_string_lossy().into_owned();
                assert!(!name.starts_with('.'), "{} is left", path.display());
                if path.is_dir() {
                    open.push(path);
                }
            }
        }
    }

    fn checkpoints(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.run().join("checkpoints")).into_iter().flatten();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
            .iter()
            .map(|name| name.replace("iteration_", "").replace(".safetensors", ""))
            .collect()
    }

    fn model(&self) -> Vec<u8> {
        std::fs::read(model_path(&self.run(), 12)).unwrap()
    }

    fn clear(&self) {
        if self.run().exists() {
            std::fs::remove_dir_all(self.run()).unwrap();
        }
    }
}

fn is_there(folder: &Path, name: &str) -> bool {
    folder.join(name).exists()
}

#[test]
fn a_run_that_cannot_begin_to_write_leaves_nothing() {
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
            let (code, message) = case.fault(operation, file, spared, kind);
            assert_eq!(code, OTHER, "{message}");
            assert!(message.contains(file) && message.contains("cannot"), "{message}");
            assert!(message.contains(&std::io::Error::from(kind).to_string()), "{message}");
            assert!(!case.run().exists(), "{operation:?} {file}");
        }
    }
}

#[test]
fn a_checkpoint_that_cannot_be_written_costs_nothing_but_itself() {
    let case = Case::new();
    case.train("").unwrap();
    let expected = case.model();
    assert_eq!(case.checkpoints(), ["12", "8"]);
    for operation in OPERATIONS {
        for (kind, step, left) in [
            (ErrorKind::StorageFull, "iteration_8.safetensors", ["12", "4"]),
            (ErrorKind::Other, "iteration_12.safetensors", ["4", "8"]),
        ] {
            case.clear();
            assert_eq!(case.fault(operation, step, 0, kind), (0, String::new()), "{operation:?}");
            assert_eq!(case.checkpoints(), left, "{operation:?}");
            assert!(case.model() == expected);
        }
    }
    // The logs that a checkpoint refers to must be on disk before it.
    for log in ["stats/train.jsonl", "stats/events.jsonl", ".densify"] {
        case.clear();
        assert_eq!(case.fault(Operation::Sync, log, 0, KINDS[1]), (0, String::new()), "{log}");
        assert!(case.checkpoints().is_empty(), "{log}");
        assert!(case.model() == expected);
    }
}

#[test]
fn what_stops_a_run_leaves_what_it_goes_on_from() {
    let case = Case::new();
    case.train("").unwrap();
    let expected = case.model();
    let faults: [(&[Operation], &str, u32, &[&str]); 7] = [
        (&OPERATIONS, "iteration_12/point_cloud.ply", 0, &["4", "8"]),
        (&OPERATIONS, "iteration_5/point_cloud.ply", 0, &["4"]),
        (&OPERATIONS, "results.json", 0, &["4", "8"]),
        (&OPERATIONS, "stats/summary.json", 0, &["12", "8"]),
        (&[Operation::Write], "stats/train.jsonl", 0, &["4", "8"]),
        // The first is the file's head, the others the records of step 10 and the scores of step 12.
        (&[Operation::Write], ".densify", 1, &["4", "8"]),
        (&[Operation::Write], ".densify", 2, &["4", "8"]),
    ];
    for (operations, file, spared, left) in faults {
        for (&operation, kind) in operations.iter().zip(KINDS.iter().copied().cycle()) {
            case.clear();
            let (code, message) = case.fault(operation, file, spared, kind);
            let what = format!("{operation:?} {file}: {message}");
            assert_eq!(code, OTHER, "{what}");
            let system = std::io::Error::from(kind).to_string();
            for words in [file, "cannot write", &system, "was written until then is in"] {
                assert!(message.contains(words), "{words:?} is not in: {what}");
            }
            assert_eq!(case.checkpoints(), left, "{what}");
            case.train("--resume").unwrap_or_else(|e| panic!("{what}: {e}"));
            assert!(case.model() == expected, "{what}");
            assert!(is_there(&case.run(), "stats/summary.json"), "{what}");
        }
    }
}

/// The adapters that are software drivers.
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

#[test]
fn a_device_that_is_lost_leaves_what_the_run_goes_on_from() {
    for driver in software_drivers() {
        let case = Case::new();
        let name = driver.split(' ').next().unwrap();
        let on_gpu = format!("--backend gpu --gpu {name} --deterministic");
        case.train(&on_gpu).unwrap();
        let expected = case.model();
        let (mut before, mut after) = (0, 0);
        for checks in [1, 40, 80, 120, 160, 240] {
            case.clear();
            let (done, lost) = with_device_lost_after(checks, || case.train(&on_gpu));
            if !lost {
                assert!(done.is_ok() && after > 0, "{driver}: {checks} checks are too many");
                continue;
            }
            let Err(failure) = done else {
                // Lost while the last checkpoint was written: everything else is there by then.
                assert!(case.model() == expected, "{driver}: {checks}");
                continue;
            };
            let (code, message) = (failure.code, failure.to_string());
            let what = format!("{driver}, {checks} checks: {message}");
            assert_eq!(code, DEVICE, "{what}");
            assert!(message.contains("was lost") && message.contains(&driver), "{what}");
            case.nothing_half_written();
            let kept = case.checkpoints();
            match kept.last() {
                None => before += 1,
                Some(step) => {
                    after += 1;
                    let words = format!("iteration_{step}.safetensors; go on with: ");
                    assert!(message.contains(&words), "{what}");
                    case.train("--resume").unwrap_or_else(|e| panic!("{what}: {e}"));
                    assert!(case.model() == expected, "{what}");
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
    case.clear();
    with_fault(None, || case.train("")).0.unwrap();
    assert!(case.model() == expected);
    assert!(std::fs::read(case.run().join("stats/events.jsonl")).unwrap() == events);
    std::fs::remove_file(case.run().join("checkpoints/iteration_12.safetensors")).unwrap();
    case.train("--resume").unwrap();
    assert!(case.model() == expected, "a checkpoint written byte by byte");
}

#[test]
fn input_faults_have_code_2_and_write_nothing() {
    let case = Case::new();
    std::fs::write(case.run(), "a file").unwrap();
    for flags in ["", "--overwrite", "--resume"] {
        let failure = case.train(flags).unwrap_err();
        assert_eq!(failure.code, INPUT, "{failure}");
        assert!(failure.to_string().contains("is not a folder"), "{failure}");
    }
    assert_eq!(std::fs::read(case.run()).unwrap(), b"a file");
}
