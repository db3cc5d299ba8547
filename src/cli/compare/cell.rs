//! One run of a comparison, and the record that it leaves.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use densify_scenegen::GroundTruth;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::contender::Contender;
use super::{POINTS, run_folder};
use crate::cli::failure::{Failure, INPUT, OTHER};
use crate::cli::number::grouped;
use crate::dataset::builtin;
use crate::metrics::geometry::Geometry;
use crate::output::{Mean, OutputError, geometry_of, write_atomically};

/// What is run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Cell {
    pub(super) scene: PathBuf,
    pub(super) label: String,
    /// A [`Contender`].
    pub(super) policy: String,
    pub(super) budget: usize,
    pub(super) seed: u32,
    pub(super) iterations: u32,
    /// More options of `densify train`.
    pub(super) train: Vec<String>,
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { label, policy, budget, seed, .. } = self;
        write!(f, "{label}, {policy}, {} rows, seed {seed}", grouped(*budget))
    }
}

/// A line of `compare.jsonl`: what came of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    /// Version of densify.
    pub(super) densify: String,
    pub(super) scene: String,
    pub(super) policy: String,
    pub(super) budget: usize,
    pub(super) seed: u32,
    pub(super) iterations: u32,
    /// Folder of the run, in `runs`.
    pub(super) run: String,
    /// The call, but for the output folder: a run with the same is not run again.
    pub(super) arguments: Vec<String>,
    /// Mean over the views held out `[dB]`.
    pub(super) psnr: f64,
    /// Mean over the views held out.
    pub(super) ssim: f64,
    /// Mean over the views held out: FLIP error.
    pub(super) flip: f64,
    /// Rows at the end.
    pub(super) rows: usize,
    /// Most rows at any instant.
    pub(super) peak_rows: usize,
    /// Largest resident memory of the process.
    pub(super) peak_bytes: Option<u64>,
    /// Wall time of the steps.
    pub(super) seconds: f64,
    /// Processor time of the steps.
    pub(super) cpu_seconds: Option<f64>,
    /// Views rendered for the policy's decisions.
    pub(super) extra_forwards: u64,
    /// (iteration, PSNR) along the run.
    pub(super) curve: Vec<(u32, f64)>,
    /// How the model sits on the surface, where that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) geometry: Option<Geometry>,
}

impl Record {
    /// Whether the budget was kept at every instant.
    pub(super) fn is_bounded(&self) -> bool {
        self.peak_rows <= self.budget
    }
}

impl Cell {
    /// The call of `densify` that runs this cell, but for the output folder.
    fn arguments(&self) -> Vec<String> {
        let tests: Vec<String> =
            (1..POINTS).map(|i| (self.iterations * i / POINTS).max(1).to_string()).collect();
        let mut arguments = vec!["train".to_owned(), self.scene.to_string_lossy().into_owned()];
        arguments.extend(Contender::new(&self.policy).options());
        let mut set = |name: &str, value: String| arguments.extend([name.to_owned(), value]);
        set("--budget", self.budget.to_string());
        set("--seed", self.seed.to_string());
        set("--iterations", self.iterations.to_string());
        set("--test-iterations", tests.join(","));
        arguments.push("--quiet".to_owned());
        if !self.train.iter().any(|flag| flag == "--eval" || flag.starts_with("--test-every")) {
            arguments.push("--eval".to_owned());
        }
        arguments.extend(self.train.iter().cloned());
        arguments
    }

    fn run(&self) -> String {
        let Self { label, policy, budget, seed, .. } = self;
        format!("{label}-{}-{budget}-seed{seed}", Contender::new(policy).folder())
    }

    /// Trains in a process of its own, whose memory is then the run's and nobody else's.
    ///
    /// # Errors
    /// With the trainer's message and exit code when it fails.
    pub(super) fn train(&self, output: &Path) -> Result<Record, Failure> {
        let other = |message: String| Failure { code: OTHER, message };
        let program = std::env::current_exe()
            .map_err(|e| other(format!("cannot find the program that is running: {e}")))?;
        let run = self.run();
        let folder = output.join("runs").join(&run);
        let mut call = Command::new(&program);
        call.args(self.arguments()).arg("--overwrite").arg("--output").arg(&folder);
        if !self.train.iter().any(|flag| flag.starts_with("--checkpoint-every")) {
            // A run of a comparison that is interrupted runs again, so that its times are whole.
            call.args(["--checkpoint-every", "0"]);
        }
        self.wait_for(&mut call)?;
        if has_geometry(&self.scene) {
            // In a process of its own too: the memory of the run stays the run's.
            let mut call = Command::new(&program);
            call.arg("eval").arg(&folder).arg("--scene").arg(&self.scene);
            call.args(shared_with_eval(&self.train));
            self.wait_for(&mut call)?;
        }
        self.record(&folder, run)
    }

    fn wait_for(&self, call: &mut Command) -> Result<(), Failure> {
        let child = call
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .output()
            .map_err(|e| Failure { code: OTHER, message: format!("cannot start a run: {e}") })?;
        if child.status.success() {
            return Ok(());
        }
        let said = String::from_utf8_lossy(&child.stderr);
        let message = said.trim().trim_start_matches("error: ").to_owned();
        let code = child.status.code().and_then(|code| u8::try_from(code).ok());
        Err(Failure { code: code.unwrap_or(OTHER), message }
            .and(&format!("this was the run {self}; the same command goes on from here")))
    }

    fn record(&self, folder: &Path, run: String) -> Result<Record, Failure> {
        let path = folder.join("stats/summary.json");
        let bad = |problem: String| Failure {
            code: OTHER,
            message: format!("{}: {problem}", path.display()),
        };
        let text = fs::read(&path).map_err(|e| bad(e.to_string()))?;
        let summary: Value = serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))?;
        let number = |field: &str| {
            summary[field].as_f64().ok_or_else(|| bad(format!("`{field}` is missing")))
        };
        let tests: BTreeMap<u32, Mean> = serde_json::from_value(summary["test"].clone())
            .map_err(|e| bad(format!("`test`: {e}")))?;
        let Some((_, &Mean { psnr, ssim, flip })) = tests.last_key_value() else {
            return Err(Failure {
                code: INPUT,
                message: format!("{}: no view is held out to measure", self.scene.display()),
            });
        };
        Ok(Record {
            densify: summary["densify"].as_str().unwrap_or_default().to_owned(),
            scene: self.label.clone(),
            policy: self.policy.clone(),
            budget: self.budget,
            seed: self.seed,
            iterations: self.iterations,
            run,
            arguments: self.arguments(),
            psnr,
            ssim,
            flip,
            rows: number("rows")? as usize,
            peak_rows: number("peak_rows")? as usize,
            peak_bytes: summary["peak_bytes"].as_u64(),
            seconds: number("seconds")?,
            cpu_seconds: summary["cpu_seconds"].as_f64(),
            extra_forwards: number("extra_forwards")? as u64,
            curve: tests.into_iter().map(|(step, mean)| (step, mean.psnr)).collect(),
            geometry: geometry_of(folder, self.iterations)?,
        })
    }
}

/// Options of `densify train` that `densify eval` has too, and that say where and on what to compute.
const SHARED: [&str; 3] = ["--threads", "--backend", "--gpu"];

/// Those of the options of a run that its measurement takes as well.
fn shared_with_eval(train: &[String]) -> Vec<&String> {
    let mut shared = Vec::new();
    let mut words = train.iter();
    while let Some(word) = words.next() {
        let (flag, with_value) = word.split_once('=').map_or((&**word, false), |(f, _)| (f, true));
        if SHARED.contains(&flag) {
            shared.push(word);
            shared.extend((!with_value).then(|| words.next()).flatten());
        }
    }
    shared
}

/// Whether the surface of a scene is known.
fn has_geometry(scene: &Path) -> bool {
    builtin::name(scene).is_some() || GroundTruth::is_in(scene)
}

/// The records in `compare.jsonl`.
pub(super) struct Records {
    path: PathBuf,
    all: Vec<Record>,
}

impl Records {
    /// Reads what is there. A last line that was cut off is not: its run runs again.
    ///
    /// # Errors
    /// When a line is no record.
    pub(super) fn open(path: &Path) -> Result<Self, Failure> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(e) => return Err(Failure::input(format!("{}: {e}", path.display()))),
        };
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        let mut all = Vec::new();
        for (i, line) in whole.lines().enumerate() {
            all.push(serde_json::from_str(line).map_err(|e| {
                Failure::input(format!(
                    "{}, line {}: {e}; delete the line, and its run runs again",
                    path.display(),
                    i + 1
                ))
            })?);
        }
        Ok(Self { path: path.to_owned(), all })
    }

    /// The record of a cell whose run is finished.
    pub(super) fn of(&self, cell: &Cell) -> Option<&Record> {
        let arguments = cell.arguments();
        let version = env!("CARGO_PKG_VERSION");
        self.all.iter().rev().find(|r| r.arguments == arguments && r.densify == version)
    }

    /// Adds a record and writes them all.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(super) fn add(&mut self, record: Record) -> Result<(), OutputError> {
        self.all.push(record);
        let text = self.all.iter().map(|r| serde_json::to_string(r).map(|line| line + "\n"));
        write_atomically(&self.path, |out| {
            for line in text {
                out.write_all(line.map_err(std::io::Error::other)?.as_bytes())?;
            }
            Ok(())
        })
    }
}

/// (iteration, value) of a field of the run's log; nothing where it has none.
pub(super) fn over_time(output: &Path, record: &Record, field: &str) -> Vec<(u32, f64)> {
    let path = run_folder(output, record).join("stats/train.jsonl");
    let text = fs::read_to_string(path).unwrap_or_default();
    let steps = text.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let point = |step: Value| {
        let iteration = u32::try_from(step["step"].as_u64()?).ok()?;
        Some((iteration, step[field].as_f64()?))
    };
    steps.filter_map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_and_their_measurements_use_the_same_device() {
        let words =
            |text: &str| -> Vec<String> { text.split_whitespace().map(str::to_owned).collect() };
        for (train, shared) in [
            ("", ""),
            ("--threads 1 -r 4 --backend gpu", "--threads 1 --backend gpu"),
            ("--near=0.1 --gpu=lavapipe --threads=2", "--gpu=lavapipe --threads=2"),
            ("--sh-degree 2 --backend", "--backend"),
        ] {
            assert_eq!(shared_with_eval(&words(train)), words(shared).iter().collect::<Vec<_>>());
        }
    }
}
