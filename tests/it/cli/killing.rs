//! Killed and interrupted processes: only the steps since the last checkpoint are lost, and the resumed run writes
//! the same files, byte for byte.
//!
//! `DENSIFY_KILLS=200 cargo test --test it killing` kills 200 times instead of 20.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

use super::{WITHOUT_GPU, call, files, model, read, records, resume, scratch, text, train};
use crate::photographs::Photographs;

/// Number of kills without `DENSIFY_KILLS`.
const KILLS: usize = 20;
const ITERATIONS: u32 = 120;
/// A checkpoint at every third step, so that many kills happen while one is written.
const FLAGS: &str = "--budget 360 --checkpoint-every 3 --eval --save-iterations 31,77 \
                     --test-iterations 50 --policy-set diet.grow_every=7";

/// The moment at which a process is killed.
#[derive(Debug, Clone, Copy)]
enum Moment {
    /// The log has this many records.
    Records(usize),
    /// An unfinished file has been seen this many times.
    Writing(u32),
}

impl Moment {
    fn random(rng: &mut ChaCha8Rng) -> Self {
        match rng.random_range(0..4) {
            0 | 1 => Self::Records(rng.random_range(0..ITERATIONS as usize / 10)),
            _ => Self::Writing(rng.random_range(1..30)),
        }
    }

    /// Polls until the moment has come. Returns false if the child ends first.
    fn wait(self, child: &mut Child, run: &Path) -> bool {
        let mut seen = 0;
        while child.try_wait().expect("a child").is_none() {
            let has_come = match self {
                Self::Records(wanted) => lines(&run.join("stats/train.jsonl")) >= wanted,
                Self::Writing(wanted) => {
                    seen += u32::from(is_writing(&run.join("checkpoints")));
                    seen >= wanted
                }
            };
            if has_come {
                return true;
            }
            std::thread::yield_now();
        }
        false
    }
}

fn lines(path: &Path) -> usize {
    std::fs::read(path).unwrap_or_default().iter().filter(|&&byte| byte == b'\n').count()
}

fn is_writing(folder: &Path) -> bool {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.file_name()).any(|name| name.to_string_lossy().starts_with('.'))
}

/// Starts the program with words separated by spaces.
fn spawn(words: &str) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_densify"));
    command.args(words.split_whitespace()).env_remove("RUST_LOG");
    command.envs([WITHOUT_GPU]);
    command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("the program starts")
}

/// The words of a call that trains.
fn arguments(scene: &Photographs, run: &Path, iterations: u32, flags: &str) -> String {
    let (scene, run) = (text(scene.path()), text(run));
    format!("train {scene} -o {run} --sh-degree 1 --quiet --iterations {iterations} {flags}")
}

/// The results that must not depend on interruptions.
fn outcome(run: &Path, iterations: u32) -> (Vec<Vec<u8>>, Vec<Value>) {
    let exact =
        ["stats/events.jsonl", "results.json", "per_view.json"].map(|name| read(&run.join(name)));
    let mut exact = exact.to_vec();
    exact.push(model(run, iterations));
    let mut log = records(&run.join("stats/train.jsonl"));
    for record in &mut log {
        record["seconds"].take();
        record["resident_bytes"].take();
    }
    (exact, log)
}

#[test]
fn a_run_killed_anywhere_resumes_to_the_same_bytes() {
    let kills = std::env::var("DENSIFY_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(KILLS);
    let scene = Photographs::colmap_text();
    let (root, whole) = scratch();
    train(scene.path(), &whole, ITERATIONS, &format!("--quiet {FLAGS}")).ok();
    let expected = outcome(&whole, ITERATIONS);
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let (mut killed, mut during_a_write) = (0, 0);
    for number in 0.. {
        let run = root.path().join(format!("run{number}"));
        // Repeats the same call, like a supervisor.
        let words = arguments(&scene, &run, ITERATIONS, &format!("{FLAGS} --resume"));
        for _ in 0..rng.random_range(1..4) {
            let mut child = spawn(&words);
            let moment = Moment::random(&mut rng);
            if moment.wait(&mut child, &run) {
                child.kill().expect("it can be killed");
                killed += 1;
                during_a_write += usize::from(is_writing(&run.join("checkpoints")));
            }
            let ended = child.wait_with_output().expect("the program ends");
            let stderr = String::from_utf8_lossy(&ended.stderr);
            assert!(stderr.is_empty(), "run {number}, {moment:?}: {stderr}");
        }
        call(&words).ok();
        assert!(outcome(&run, ITERATIONS) == expected, "run {number} of seed 11 differs");
        let left = files(&run);
        let hidden = left.keys().find(|name| name.split('/').any(|part| part.starts_with('.')));
        assert_eq!(hidden, None, "run {number}: an unfinished file is left");
        std::fs::remove_dir_all(&run).expect("the run");
        if killed >= kills {
            break;
        }
    }
    assert!(during_a_write > 0, "no kill hit the writing of a checkpoint");
}

/// Starts a run, sends signals to it and waits for its end. Returns its exit code and message.
#[cfg(unix)]
fn signalled(scene: &Photographs, run: &Path, signals: &[&str]) -> (Option<i32>, String) {
    let mut child = spawn(&arguments(scene, run, LONG, "--budget 360 --checkpoint-every 0"));
    assert!(Moment::Records(3).wait(&mut child, run), "the run has ended by itself");
    let id = child.id();
    // One shell sends all signals, so that hardly any time passes between them.
    let calls: String = signals.iter().map(|signal| format!("kill {signal} {id};")).collect();
    assert!(Command::new("sh").args(["-c", &calls]).status().expect("a shell").success());
    let ended = child.wait_with_output().expect("the program ends");
    (ended.status.code(), String::from_utf8_lossy(&ended.stderr).into_owned())
}

#[cfg(unix)]
const LONG: u32 = 1500;

#[cfg(unix)]
fn checkpoints(run: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(run.join("checkpoints")).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).collect()
}

#[cfg(unix)]
#[test]
fn a_signal_saves_a_checkpoint_and_the_run_can_be_resumed() {
    let scene = Photographs::colmap_text();
    let (root, whole) = scratch();
    train(scene.path(), &whole, LONG, "--quiet --budget 360 --checkpoint-every 0").ok();
    for (signal, name, code) in [("-INT", "SIGINT", 130), ("-TERM", "SIGTERM", 143)] {
        let run = root.path().join(name);
        let (ended, stderr) = signalled(&scene, &run, &[signal]);
        assert_eq!(ended, Some(code), "{stderr}");
        let kept = checkpoints(&run);
        assert_eq!(kept.len(), 1, "{kept:?}");
        let stopped = format!("error: stopped by {name} after step ");
        for words in [&stopped, text(&kept[0]), "--resume"] {
            assert!(stderr.contains(words), "{words:?} is not in {stderr}");
        }
        let summary = super::json(&run.join("stats/summary.json"));
        let done = summary["iterations"].as_u64().expect("a number");
        assert!(summary["finished"] == false && (30..1500).contains(&done), "{summary}");
        assert!(text(&kept[0]).ends_with(&format!("iteration_{done}.safetensors")));
        resume(scene.path(), &run, "--quiet").ok();
        assert!(model(&run, LONG) == model(&whole, LONG), "{name}");
        assert!(read(&run.join("stats/events.jsonl")) == read(&whole.join("stats/events.jsonl")));
    }
}

#[cfg(unix)]
#[test]
fn a_run_ends_when_its_folder_is_moved() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    let flags = "--budget 360 --checkpoint-every 20";
    let mut child = spawn(&arguments(&scene, &run, 100_000, flags));
    assert!(Moment::Records(3).wait(&mut child, &run), "the run has ended by itself");
    std::fs::rename(&run, root.path().join("moved")).expect("a moved folder");
    let ended = child.wait_with_output().expect("the program ends");
    let stderr = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert_eq!(ended.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("was moved, removed or taken by another process"), "{stderr}");
    assert!(!run.exists(), "something was written");
}

#[cfg(unix)]
#[test]
fn a_run_in_progress_is_neither_resumed_nor_replaced() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let mut child = spawn(&arguments(&scene, &run, 100_000, "--budget 360"));
    assert!(Moment::Records(3).wait(&mut child, &run), "the run has ended by itself");
    let process = format!("is in use: process {} is training there", child.id());
    for flags in ["", "--overwrite --policy mcmc", "--resume"] {
        train(scene.path(), &run, 5, flags).refused(flags, &[&process]);
    }
    child.kill().expect("it can be killed");
    child.wait().expect("the program ends");
    // A process killed while it replaces a run leaves files behind; the next complete run removes them.
    let mut child = spawn(&arguments(&scene, &run, 100_000, "--budget 360 --overwrite"));
    let is_staged = || {
        let staged = densify::train::output::RunFolder::staged(&run);
        staged.iter().any(|path| path.join("stats/train.jsonl").exists())
    };
    while !is_staged() {
        assert!(child.try_wait().expect("a child").is_none(), "the run has ended by itself");
    }
    train(scene.path(), &run, 5, "--overwrite").refused("replacing", &["is in use: process"]);
    child.kill().expect("it can be killed");
    child.wait().expect("the program ends");
    train(scene.path(), &run, 5, "--budget 360 --overwrite").ok();
    let left = files(&run);
    let hidden = left.keys().find(|name| name.starts_with('.') || name.ends_with(".lock"));
    assert_eq!(hidden, None);
    assert_eq!(records(&run.join("stats/train.jsonl")).len(), 1);
}

#[cfg(unix)]
#[test]
fn a_second_signal_ends_the_run_at_once() {
    let scene = Photographs::colmap_text();
    // On a busy machine the first signal may take effect before the second arrives, so several attempts are made.
    let at_once = (0..20).any(|_| {
        let (_root, run) = scratch();
        let (ended, stderr) = signalled(&scene, &run, &["-INT", "-TERM"]);
        assert!(matches!(ended, Some(130 | 143)), "{ended:?}: {stderr}");
        stderr.is_empty()
    });
    assert!(at_once, "no second signal ended a run at once");
}
