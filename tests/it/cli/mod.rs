//! The program as its users meet it: arguments in, exit code, messages and files out.

mod accumulation;
mod blocks;
#[cfg(unix)]
mod caching;
mod comparing;
mod compressing;
mod configuring;
mod exporting;
mod exposing;
mod faults;
#[cfg(unix)]
mod filling;
mod flying;
mod generated;
mod geometry;
mod hostile;
mod killing;
mod knobs;
mod looking;
mod memory;
mod photographing;
mod reporting;
mod requiring;
mod resuming;
mod same;
mod starting;
mod trading;
mod training;
mod travelling;
mod view;
mod watching;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use densify_policies::registry::PolicyEntry;
use serde_json::Value;
use tempfile::TempDir;

/// What a call of the program did.
#[derive(Debug)]
struct Outcome {
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

impl Outcome {
    /// The same outcome, if the call succeeded.
    #[track_caller]
    fn ok(self) -> Self {
        assert_eq!(self.code, Some(0), "{}{}", self.stdout, self.stderr);
        self
    }

    /// Fails unless the call ended as bad input must: code 2 and one message, with these words.
    #[track_caller]
    fn refused(&self, case: &str, words: &[&str]) {
        let Self { code, stderr, .. } = self;
        assert_eq!(*code, Some(2), "{case}: {self:?}");
        assert!(stderr.starts_with("error: "), "{case}: {stderr}");
        assert_eq!(stderr.matches("error:").count(), 1, "{case}: {stderr}");
        assert!(!stderr.contains("panicked") && !stderr.contains("RUST_"), "{case}: {stderr}");
        for word in words {
            assert!(stderr.contains(word), "{case}: {word:?} is not in: {stderr}");
        }
    }
}

/// Calls the program.
fn densify(arguments: &[&str]) -> Outcome {
    let mut command = Command::new(env!("CARGO_BIN_EXE_densify"));
    // A layer of Mesa's Vulkan complains about the environment on stderr, but for this variable.
    command.args(arguments).env_remove("RUST_LOG").env("NODEVICE_SELECT", "1");
    // The user's cache is left alone; built-in scenes are rendered once for all tests.
    command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
    if !names_an_adapter(arguments) {
        command.envs([WITHOUT_GPU]);
    }
    outcome_of(command)
}

/// The variable with which `--backend auto` finds no GPU: what a test says of a run that names none holds on the
/// processor, which repeats to the byte and whose memory is all the process's.
const WITHOUT_GPU: (&str, &str) = ("WGPU_BACKEND", "noop");

/// Whether a call, or the run that it goes on with, names an adapter, or asks for all.
fn names_an_adapter(arguments: &[&str]) -> bool {
    let names_one = |run: &&str| {
        let config = std::fs::read_to_string(Path::new(run).join("config.toml"));
        config.is_ok_and(|text| text.lines().any(|line| line.starts_with("gpu = ")))
    };
    arguments.iter().any(|word| ["--gpu", "devices", "selftest"].contains(word))
        || arguments.iter().any(names_one)
}

fn outcome_of(mut command: Command) -> Outcome {
    let output = command.output().expect("it starts");
    let text = |bytes| String::from_utf8(bytes).expect("messages are UTF-8");
    Outcome { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) }
}

/// Calls the program where programs are looked for in `path` alone.
#[cfg(unix)]
fn call_with_path(words: &str, path: &str) -> Outcome {
    let mut command = Command::new(env!("CARGO_BIN_EXE_densify"));
    command.args(words.split_whitespace()).envs([WITHOUT_GPU]).env("PATH", path);
    outcome_of(command)
}

/// Puts a program into a folder that does what a shell's `script` says.
#[cfg(unix)]
fn stand_in(folder: &Path, name: &str, script: &str) {
    use std::os::unix::fs::PermissionsExt;

    let path = folder.join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{script}\n")).expect("it is written");
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o755)).expect("it is ours");
}

/// Does what Slurm does with the script of an array: runs it for a place.
#[cfg(unix)]
fn run_place(script: &Path, place: &str) {
    let mut bash = Command::new("bash");
    let done = bash.arg(script).envs([WITHOUT_GPU]).env("SLURM_ARRAY_TASK_ID", place).output();
    let done = done.expect("it starts");
    assert!(done.status.success(), "{} {place}: {done:?}", script.display());
}

/// Calls the program with words separated by spaces.
fn call(words: &str) -> Outcome {
    densify(&words.split_whitespace().collect::<Vec<_>>())
}

/// A short run. `flags` must not repeat the fixed ones.
fn train(scene: &Path, output: &Path, iterations: u32, flags: &str) -> Outcome {
    let fixed = format!("--sh-degree 1 --iterations {iterations}");
    call(&format!("train {} -o {} {fixed} {flags}", text(scene), text(output)))
}

/// Goes on with a run.
fn resume(scene: &Path, run: &Path, flags: &str) -> Outcome {
    call(&format!("train {} -o {} --resume {flags}", text(scene), text(run)))
}

/// Flags that make a policy act often in a run of some dozen steps. Intervals do not shrink with
/// the run, so that a policy would do little.
fn often(policy: &PolicyEntry) -> String {
    let intervals = policy.parameters().into_iter().filter_map(|(name, default)| {
        let default =
            default.as_integer().filter(|&steps| steps > 0 && name.ends_with("_every"))?;
        Some(format!("--policy-set {}.{name}={} ", policy.name, (default / 100).max(5)))
    });
    intervals.collect()
}

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary paths are UTF-8")
}

/// A place for the output of a test.
fn scratch() -> (TempDir, PathBuf) {
    let root = tempfile::tempdir().expect("a temporary folder");
    let run = root.path().join("run");
    (root, run)
}

fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The Gaussians of a file.
fn gaussians(file: &Path) -> densify::core::gaussians::Gaussians {
    densify::data::models::read_model(file).expect("a model").gaussians
}

/// Writes a model as PLY.
fn write_ply(model: &densify::core::gaussians::Gaussians, file: &Path) {
    let mut bytes = Vec::new();
    densify::data::models::PLY.write(model, &mut bytes).expect("it is written");
    std::fs::write(file, bytes).expect("it is written");
}

fn read_text(path: &Path) -> String {
    String::from_utf8(read(path)).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The options of a run as it has them.
fn config(run: &Path) -> toml::Table {
    read_text(&run.join("config.toml")).parse().expect("config.toml is TOML")
}

fn count(value: &Value, key: &str) -> u64 {
    value[key].as_u64().unwrap_or_else(|| panic!("no count {key} in {value}"))
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&read(path)).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The records of a log.
fn records(path: &Path) -> Vec<Value> {
    let text = read_text(path);
    assert!(text.is_empty() || text.ends_with('\n'), "{}: its last line is cut", path.display());
    let line = |line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{line}: {e}"));
    text.lines().map(line).collect()
}

/// All files below a folder with their contents, by path from there.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(here) = open.pop() {
        let entries =
            std::fs::read_dir(&here).unwrap_or_else(|e| panic!("{}: {e}", here.display()));
        for path in entries.map(|entry| entry.expect("a folder's entry").path()) {
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(folder).expect("found below it");
                found.insert(text(name).replace('\\', "/"), read(&path));
            }
        }
    }
    found
}

/// Copies a run into another folder as a process leaves it that is killed before its last checkpoint:
/// without what it wrote after the last iteration.
fn copy_unfinished(run: &Path, to: &Path, iterations: u32) {
    let last = format!("iteration_{iterations}");
    for (name, bytes) in files(run).into_iter().filter(|(name, _)| !name.contains(&last)) {
        let path = to.join(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        std::fs::write(path, bytes).expect("a copy");
    }
}

/// The model that a run saved after its last iteration.
fn model(run: &Path, iterations: u32) -> Vec<u8> {
    read(&densify::train::output::model_path(run, iterations))
}
