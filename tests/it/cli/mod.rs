//! End-to-end tests of the program: arguments in, exit code, messages and files out.

mod accumulation;
mod antialiasing;
mod automatic_sizes;
mod blocks;
#[cfg(unix)]
mod caching;
mod camera_paths;
mod cleaning;
mod comparing;
mod compressing;
mod configuring;
mod depth_maps;
mod exporting;
mod exposing;
mod faults;
#[cfg(unix)]
mod full_disk;
mod generated;
mod geometry;
mod hostile;
mod init_and_freeze;
mod inspecting;
mod killing;
mod knobs;
mod live_page;
mod long_studies;
mod memory;
mod meshing;
mod model_formats;
mod neutral_options;
mod photographing;
#[cfg(unix)]
mod posing;
mod refining_poses;
mod remote;
mod reporting;
mod resuming;
mod trading;
mod training;
mod view_server;
mod vignetting;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use densify_policies::registry::PolicyEntry;
use serde_json::Value;
use tempfile::TempDir;

/// The result of calling the program.
#[derive(Debug)]
struct Outcome {
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

impl Outcome {
    /// Returns the outcome after checking that the call succeeded.
    #[track_caller]
    fn ok(self) -> Self {
        assert_eq!(self.code, Some(0), "{}{}", self.stdout, self.stderr);
        self
    }

    /// Checks that the call was refused: exit code 2 and one message that contains the given words.
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
    // Without this variable, a Vulkan layer of Mesa prints warnings to stderr.
    command.args(arguments).env_remove("RUST_LOG").env("NODEVICE_SELECT", "1");
    // Tests share a cache of built-in scenes and do not touch the user's.
    command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
    if !names_an_adapter(arguments) {
        command.envs([WITHOUT_GPU]);
    }
    outcome_of(command)
}

/// Hides GPUs from `--backend auto`. Tests that name no GPU rely on the CPU backend, which is reproducible byte for byte
/// and uses no memory outside the process.
const WITHOUT_GPU: (&str, &str) = ("WGPU_BACKEND", "noop");

/// True if the call, or the run that it resumes, names an adapter, or if the command lists them.
fn names_an_adapter(arguments: &[&str]) -> bool {
    let names_one = |run: &&str| {
        let config = std::fs::read_to_string(Path::new(run).join("config.toml"));
        config.is_ok_and(|text| text.lines().any(|line| line.starts_with("gpu = ")))
    };
    arguments.iter().any(|word| ["--gpu", "devices", "selftest"].contains(word))
        || arguments.iter().any(names_one)
}

fn outcome_of(mut command: Command) -> Outcome {
    let output = command.output().expect("the program starts");
    let text = |bytes| String::from_utf8(bytes).expect("messages are UTF-8");
    Outcome { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) }
}

/// Writes a small scene whose points have tracks, with these options.
fn spheres(folder: &Path, options: &str) {
    let size = "--size 64 --test 2 --points 1500 --samples 1";
    call(&format!("scenegen --preset spheres {size} -o {} {options}", text(folder))).ok();
}

/// Calls the program with a different `PATH`.
#[cfg(unix)]
fn call_with_path(words: &str, path: &str) -> Outcome {
    let mut command = Command::new(env!("CARGO_BIN_EXE_densify"));
    command.args(words.split_whitespace()).envs([WITHOUT_GPU]).env("PATH", path);
    outcome_of(command)
}

/// Creates an executable shell script in place of another program.
#[cfg(unix)]
fn write_program(folder: &Path, name: &str, script: &str) {
    use std::os::unix::fs::PermissionsExt;

    let path = folder.join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{script}\n")).expect("a written file");
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o755)).expect("changed permissions");
}

/// Runs one task of an array script, like Slurm.
#[cfg(unix)]
fn run_array_task(script: &Path, index: &str) {
    let mut bash = Command::new("bash");
    let output = bash.arg(script).envs([WITHOUT_GPU]).env("SLURM_ARRAY_TASK_ID", index).output();
    let output = output.expect("the program starts");
    assert!(output.status.success(), "{} {index}: {output:?}", script.display());
}

/// Calls the program with arguments separated by spaces.
fn call(words: &str) -> Outcome {
    densify(&words.split_whitespace().collect::<Vec<_>>())
}

/// Trains a short run. `flags` must not repeat the fixed ones.
fn train(scene: &Path, output: &Path, iterations: u32, flags: &str) -> Outcome {
    let fixed = format!("--sh-degree 1 --iterations {iterations}");
    call(&format!("train {} -o {} {fixed} {flags}", text(scene), text(output)))
}

/// Resumes a run.
fn resume(scene: &Path, run: &Path, flags: &str) -> Outcome {
    call(&format!("train {} -o {} --resume {flags}", text(scene), text(run)))
}

/// Flags that make a policy edit often. Default intervals do not shrink below 100 steps, so it would hardly edit in a
/// short run.
fn frequent_edits(policy: &PolicyEntry) -> String {
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

/// A temporary folder and a path in it for the output of a run.
fn scratch() -> (TempDir, PathBuf) {
    let root = tempfile::tempdir().expect("a temporary folder");
    let run = root.path().join("run");
    (root, run)
}

fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Reads the Gaussians of a model file.
fn gaussians(file: &Path) -> densify::core::gaussians::Gaussians {
    densify::data::models::read_model(file).expect("a model").gaussians
}

/// Writes a model as PLY.
fn write_ply(model: &densify::core::gaussians::Gaussians, file: &Path) {
    let mut bytes = Vec::new();
    densify::data::models::PLY.write(model, &mut bytes).expect("a written file");
    std::fs::write(file, bytes).expect("a written file");
}

fn read_text(path: &Path) -> String {
    String::from_utf8(read(path)).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The options that a run has recorded.
fn config(run: &Path) -> toml::Table {
    read_text(&run.join("config.toml")).parse().expect("config.toml is TOML")
}

fn count(value: &Value, key: &str) -> u64 {
    value[key].as_u64().unwrap_or_else(|| panic!("no count {key} in {value}"))
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&read(path)).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The records of a JSON Lines file.
fn records(path: &Path) -> Vec<Value> {
    let text = read_text(path);
    assert!(
        text.is_empty() || text.ends_with('\n'),
        "{}: the last line is incomplete",
        path.display()
    );
    let line = |line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{line}: {e}"));
    text.lines().map(line).collect()
}

/// The contents of all files below a folder, by relative path.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(here) = folders.pop() {
        let entries =
            std::fs::read_dir(&here).unwrap_or_else(|e| panic!("{}: {e}", here.display()));
        for path in entries.map(|entry| entry.expect("a folder's entry").path()) {
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).expect("a path below the folder");
                found.insert(text(name).replace('\\', "/"), read(&path));
            }
        }
    }
    found
}

/// Copies a run without the files written after the last iteration, as if the process had been killed before its last
/// checkpoint.
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
