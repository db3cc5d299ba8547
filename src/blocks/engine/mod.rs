//! What starts the tasks of a plan: this machine, or a scheduler, for which files are written and handed in.

mod hq;
mod local;
mod slurm;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde::{Deserialize, Serialize};

use super::{Blocks, State, Task, status, utf8};
use crate::failure::{Failure, OTHER};
use crate::foreign;
use crate::output::{OutputError, write_atomically};
use crate::run::Observer;

/// What starts tasks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Engine {
    /// This machine, as many tasks at once as memory allows
    Local,
    /// Slurm: an array job, with sbatch
    Slurm,
    /// HyperQueue: a job file, with hq
    Hq,
}

/// How tasks are handed in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Submission {
    /// What starts them.
    pub engine: Engine,
    /// Only shows the files of the engine.
    pub dry_run: bool,
    /// Hands in again what was handed in before.
    pub again: bool,
    /// Whether HyperQueue's pool has `mem` as a resource, in bytes.
    pub with_memory: bool,
}

/// A file for a scheduler.
struct EngineFile {
    /// In the folder of the plan.
    path: PathBuf,
    text: String,
}

/// What was handed in, as it stands in the plan's folder.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Submitted {
    engine: Engine,
    jobs: Vec<String>,
}

const SUBMITTED_FILE: &str = "submitted.toml";

/// Starts the tasks that are not complete, or hands them in.
///
/// # Errors
/// When the engine is not there or refuses, the plan was handed in before, and, of tasks that this machine runs, as
/// theirs.
pub fn submit(
    folder: &Path,
    blocks: &Blocks,
    submission: Submission,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let open: Vec<Task> = status(folder, blocks)
        .into_iter()
        .filter(|(_, state)| *state != State::Complete)
        .map(|(task, _)| task)
        .collect();
    if open.is_empty() {
        observer.say(format_args!("every task is complete"));
        return Ok(());
    }
    let folder = &std::path::absolute(folder).map_err(Failure::input)?;
    let files = match submission.engine {
        Engine::Local => Vec::new(),
        Engine::Slurm => slurm::files(folder, blocks, &open)?,
        Engine::Hq => vec![hq::file(folder, blocks, &open, submission.with_memory)?],
    };
    if submission.dry_run {
        for EngineFile { path, text } in &files {
            observer.say(format_args!("# {}\n{text}", path.display()));
        }
        if submission.engine == Engine::Local {
            local::show(folder, blocks, &open, observer)?;
        }
        return Ok(());
    }
    if submission.engine == Engine::Local {
        return local::run(folder, blocks, &open, observer);
    }
    let path = folder.join(SUBMITTED_FILE);
    if let Ok(text) = foreign::read_text(&path, foreign::MAX_OPTIONS)
        && !submission.again
    {
        let before = toml::from_str::<Submitted>(&text).map(|it| it.jobs.join(", "));
        return Err(Failure::input(format!(
            "this plan was handed in before, as job {}; see `densify blocks status`, and give --again to hand in \
             what is not complete once those jobs have ended",
            before.unwrap_or_else(|_| "unknown".to_owned())
        )));
    }
    let logs = folder.join("logs");
    fs::create_dir_all(&logs).map_err(OutputError::io("create the folder", &logs))?;
    for EngineFile { path, text } in &files {
        write_atomically(path, |out| out.write_all(text.as_bytes()))?;
    }
    let jobs = match submission.engine {
        Engine::Local => Vec::new(),
        Engine::Slurm => slurm::hand_in(&files)?,
        Engine::Hq => vec![hq::hand_in(&files[0])?],
    };
    observer.say(format_args!("job      {}", jobs.join(", ")));
    let text = toml::to_string(&Submitted { engine: submission.engine, jobs });
    let text = text.map_err(Failure::input)?;
    write_atomically(&path, |out| out.write_all(text.as_bytes()))?;
    Ok(())
}

/// The program, the plan's folder and a task, as words of a command.
fn command_of(folder: &Path, task: &str) -> Result<[String; 5], Failure> {
    let program = std::env::current_exe().map_err(|error| Failure {
        code: OTHER,
        message: format!("cannot find the program that is running: {error}"),
    })?;
    Ok([utf8(&program)?, "blocks", "run", utf8(folder)?, task].map(str::to_owned))
}

/// What a scheduler's program prints.
fn asked(program: &str, arguments: &[&str], remedy: &str) -> Result<String, Failure> {
    let output = Command::new(program).args(arguments).stdin(Stdio::null()).output();
    let output = output
        .map_err(|error| Failure::input(format!("cannot start `{program}`: {error}; {remedy}")))?;
    let said = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim().to_owned();
    if output.status.success() {
        return Ok(said(&output.stdout));
    }
    Err(Failure::input(format!(
        "`{program} {}` failed: {}",
        arguments.join(" "),
        foreign::lines(&said(&output.stderr))
    )))
}

/// A word for a shell, whatever is in it.
fn quoted(word: &str) -> String {
    format!("'{}'", word.replace('\'', r"'\''"))
}

/// Mebibytes, rounded up.
fn mebibytes(bytes: u64) -> u64 {
    bytes.div_ceil(1 << 20)
}
