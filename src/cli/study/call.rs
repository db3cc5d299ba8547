//! Calls of `densify` from `densify`: each run in a process of its own, whose memory is then the run's
//! and nobody else's.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use densify_scenegen::GroundTruth;
use serde_json::Value;

use crate::cli::failure::{Failure, OTHER};
use crate::dataset::builtin;
use crate::output::Mean;

/// A run of `densify train`.
pub(in crate::cli) struct Call<'a> {
    pub(in crate::cli) scene: &'a Path,
    /// All of the call, `train` first, but for the output folder.
    pub(in crate::cli) arguments: Vec<String>,
    /// Those of the arguments that the user gave.
    pub(in crate::cli) options: &'a [String],
    pub(in crate::cli) folder: &'a Path,
}

impl Call<'_> {
    /// Trains.
    ///
    /// # Errors
    /// With the trainer's message and exit code when it fails.
    pub(in crate::cli) fn train(&self) -> Result<(), Failure> {
        let mut call = Command::new(program()?);
        call.args(&self.arguments).arg("--overwrite").arg("--output").arg(self.folder);
        if !self.options.iter().any(|flag| flag.starts_with("--checkpoint-every")) {
            // A run of a study that is interrupted runs again, so that its times are whole.
            call.args(["--checkpoint-every", "0"]);
        }
        wait_for(&mut call)
    }

    /// Measures what was trained, with `densify eval`.
    ///
    /// # Errors
    /// With its message and exit code when it fails.
    pub(in crate::cli) fn measure(&self) -> Result<(), Failure> {
        let mut call = Command::new(program()?);
        call.arg("eval").arg(self.folder).arg("--scene").arg(self.scene);
        call.args(shared_with_eval(self.options));
        wait_for(&mut call)
    }
}

/// How the call of a study's run ends: views are held out, and then come the options that the user
/// gave.
pub(in crate::cli) fn last_arguments(options: &[String]) -> Vec<String> {
    let holds_out = |flag: &String| flag == "--eval" || flag.starts_with("--test-every");
    let own = if options.iter().any(holds_out) { &["--quiet"][..] } else { &["--quiet", "--eval"] };
    own.iter().map(|&flag| flag.to_owned()).chain(options.iter().cloned()).collect()
}

/// A failure within a run of a study.
pub(in crate::cli) fn in_run(run: &impl Display, failure: Failure) -> Failure {
    failure.and(&format!("this was the run {run}; the same command goes on from here"))
}

fn program() -> Result<PathBuf, Failure> {
    std::env::current_exe().map_err(|e| Failure {
        code: OTHER,
        message: format!("cannot find the program that is running: {e}"),
    })
}

fn wait_for(call: &mut Command) -> Result<(), Failure> {
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
    Err(Failure { code: code.unwrap_or(OTHER), message })
}

/// `stats/summary.json` of a run.
pub(in crate::cli) struct Summary {
    path: PathBuf,
    all: Value,
    /// Scores of the views held out, by iteration.
    pub(in crate::cli) tests: BTreeMap<u32, Mean>,
}

impl Summary {
    /// # Errors
    /// When it cannot be read, or lacks the scores.
    pub(in crate::cli) fn read(run: &Path) -> Result<Self, Failure> {
        let path = run.join("stats/summary.json");
        let bad = |problem: String| fault(&path, &problem);
        let text = fs::read(&path).map_err(|e| bad(e.to_string()))?;
        let all: Value = serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))?;
        let tests = serde_json::from_value(all["test"].clone());
        let tests = tests.map_err(|e| bad(format!("`test`: {e}")))?;
        Ok(Self { path, all, tests })
    }

    pub(in crate::cli) fn get(&self, field: &str) -> &Value {
        &self.all[field]
    }

    pub(in crate::cli) fn text(&self, field: &str) -> String {
        self.all[field].as_str().unwrap_or_default().to_owned()
    }

    /// # Errors
    /// When there is no such number.
    pub(in crate::cli) fn number(&self, field: &str) -> Result<f64, Failure> {
        let number = self.all[field].as_f64();
        number.ok_or_else(|| fault(&self.path, &format!("`{field}` is missing")))
    }
}

fn fault(path: &Path, problem: &str) -> Failure {
    Failure { code: OTHER, message: format!("{}: {problem}", path.display()) }
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
pub(in crate::cli) fn has_geometry(scene: &Path) -> bool {
    builtin::name(scene).is_some() || GroundTruth::is_in(scene)
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
