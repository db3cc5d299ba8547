//! Starts batches of tasks: on this machine, or through the scheduler of a cluster, for which it writes and submits job
//! files. The caller describes the tasks as a [`Batch`] and keeps track of which are complete.

mod hq;
mod local;
mod slurm;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use clap::Args;
use serde::{Deserialize, Serialize};

use densify_core::files;
use densify_core::files::{FileError, write_atomically};
use densify_run::Observer;
use densify_run::failure::{Failure, OTHER};
pub use local::slots;

/// The system that starts tasks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Engine {
    /// This machine, as many tasks at once as memory and cores allow
    Local,
    /// Slurm: an array job, with sbatch
    Slurm,
    /// HyperQueue: a job file, with hq
    Hq,
}

/// An engine and how to submit to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Submission {
    /// The engine that starts the tasks.
    pub engine: Engine,
    /// Print the engine's files and start nothing.
    pub dry_run: bool,
    /// Submit again although the batch was submitted before.
    pub again: bool,
    /// Request memory from HyperQueue, as the resource `mem` in bytes.
    pub with_memory: bool,
}

/// The options, besides `--engine`, of commands that submit tasks.
#[derive(Debug, Clone, Default, Args)]
pub struct SubmissionArgs {
    /// Print the files for the engine, and start nothing
    #[arg(long)]
    dry_run: bool,
    /// Submit incomplete tasks again
    #[arg(long)]
    again: bool,
    /// Also request memory from HyperQueue: its workers must offer the resource `mem`, in bytes, or tasks wait for ever
    #[arg(long)]
    mem_resource: bool,
}

impl SubmissionArgs {
    /// The submission to this engine.
    ///
    /// # Errors
    /// If an option does not apply to the engine.
    pub fn for_engine(&self, engine: Engine) -> Result<Submission, Failure> {
        let Self { dry_run, again, mem_resource: with_memory } = *self;
        if with_memory && engine != Engine::Hq {
            return Err(Failure::input("--mem-resource is for --engine hq; leave it out"));
        }
        Ok(Submission { engine, dry_run, again, with_memory })
    }

    /// Checks that none of these options is given, for commands without `--engine`.
    ///
    /// # Errors
    /// Names the first option that is given.
    pub fn require_none(&self) -> Result<(), Failure> {
        let flag = if self.dry_run {
            "--dry-run"
        } else if self.again {
            "--again"
        } else if self.mem_resource {
            "--mem-resource"
        } else {
            return Ok(());
        };
        Err(Failure::input(format!("{flag} needs --engine; give both, or neither")))
    }
}

/// Tasks in stages. A stage begins when the one before it is done.
#[derive(Debug, Clone)]
pub struct Batch {
    /// Absolute path of the folder for the engine's files and the logs.
    pub folder: PathBuf,
    /// Arguments of this program that start a task; the task's name is appended.
    pub command: Vec<String>,
    /// The stages; none is empty.
    pub stages: Vec<Stage>,
    /// Paths and texts of the files that the tasks read. They are written before the tasks start.
    pub inputs: Vec<(PathBuf, String)>,
    /// How the user can see the progress, for messages.
    pub status: String,
    /// On this machine, tasks that would end later are not started.
    pub deadline: Option<Instant>,
}

/// Independent tasks.
#[derive(Debug, Clone)]
pub struct Stage {
    /// Name of the stage.
    pub name: &'static str,
    /// True if the stage is submitted as an array job, even if only one task is left.
    pub is_array: bool,
    /// Tasks of the stage.
    pub jobs: Vec<Job>,
}

/// A task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Job {
    /// Name of the task.
    pub name: String,
    /// Index in the full stage, including tasks that are done already.
    pub index: usize,
    /// Upper bound of its memory `[bytes]`.
    pub memory: u64,
    /// Processor threads that it uses.
    pub threads: u32,
    /// True if the task accepts a smaller number of threads through `--threads`.
    pub may_have_fewer_threads: bool,
    /// Expected time, if it is known.
    pub expected: Option<Duration>,
}

impl Batch {
    /// Folder of the tasks' logs.
    fn logs(&self) -> PathBuf {
        self.folder.join("logs")
    }

    /// The command line of a task, up to its name.
    fn command_line(&self) -> Result<Vec<String>, Failure> {
        Ok([program()?, self.command.clone()].concat())
    }
}

/// A file for a scheduler.
struct EngineFile {
    /// Index of the stage that the file starts; of the first, if it starts all stages.
    stage: usize,
    path: PathBuf,
    text: String,
}

/// The record of a submission in the batch's folder.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Submitted {
    engine: Engine,
    jobs: Vec<String>,
}

const SUBMITTED_FILE: &str = "submitted.toml";

/// IDs of the jobs submitted from a folder, as text; `None` if there were none.
pub fn submitted_jobs(folder: &Path) -> Option<String> {
    let text = files::read_text(&folder.join(SUBMITTED_FILE), files::MAX_OPTIONS_BYTES).ok()?;
    let jobs = toml::from_str::<Submitted>(&text).map(|record| record.jobs.join(", "));
    Some(jobs.unwrap_or_else(|_| "unknown".to_owned()))
}

/// Runs the tasks on this machine and waits for them, or submits them to a scheduler.
///
/// # Errors
/// If the scheduler is not available or refuses, the batch was submitted before, or a task on this machine fails.
pub fn submit(
    batch: &Batch,
    submission: Submission,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let files = match submission.engine {
        Engine::Local if submission.dry_run => return local::show(batch, observer),
        Engine::Local => {
            for (path, text) in &batch.inputs {
                write_atomically(path, |out| out.write_all(text.as_bytes()))?;
            }
            return local::run(batch, observer);
        }
        Engine::Slurm => slurm::files(batch)?,
        Engine::Hq => vec![hq::file(batch, submission.with_memory)?],
    };
    if submission.dry_run {
        for EngineFile { path, text, .. } in &files {
            observer.say(format_args!("# {}\n{text}", path.display()));
        }
        return Ok(());
    }
    if let Some(jobs) = submitted_jobs(&batch.folder).filter(|_| !submission.again) {
        return Err(Failure::input(format!(
            "{} was already submitted, as job {jobs}; see {}; when those jobs have ended, submit \
             incomplete tasks with --again",
            batch.folder.display(),
            batch.status
        )));
    }
    let logs = batch.logs();
    fs::create_dir_all(&logs).map_err(FileError::io("create the folder", &logs))?;
    let (mut written, mut jobs) = (vec![logs.clone()], Vec::new());
    let mut write_and_submit = || -> Result<(), Failure> {
        let inputs = batch.inputs.iter().map(|(path, text)| (path, text));
        for (path, text) in inputs.chain(files.iter().map(|file| (&file.path, &file.text))) {
            if !path.exists() {
                written.push(path.clone());
            }
            write_atomically(path, |out| out.write_all(text.as_bytes()))?;
        }
        match submission.engine {
            Engine::Hq => {
                files.iter().try_for_each(|file| hq::submit(file).map(|job| jobs.push(job)))
            }
            _ => slurm::submit(&files, &mut jobs),
        }
    };
    let submitted = write_and_submit();
    if submitted.is_err() && jobs.is_empty() {
        remove_written(&written, &batch.folder);
    }
    submitted?;
    observer.say(format_args!("job      {}", jobs.join(", ")));
    let text = toml::to_string(&Submitted { engine: submission.engine, jobs });
    let text = text.map_err(Failure::input)?;
    write_atomically(&batch.folder.join(SUBMITTED_FILE), |out| out.write_all(text.as_bytes()))?;
    Ok(())
}

/// Removes files and empty folders, and the folders above them up to `root` that are then empty.
fn remove_written(paths: &[PathBuf], root: &Path) {
    for path in paths {
        // A folder that is not empty stays, as does what cannot be removed.
        let _ = if path.is_dir() { fs::remove_dir(path) } else { fs::remove_file(path) };
        let mut folders = path.ancestors().skip(1).take_while(|folder| folder.starts_with(root));
        while folders.next().is_some_and(|folder| fs::remove_dir(folder).is_ok()) {}
    }
}

/// Runs a program of a scheduler and returns its output.
fn run_scheduler(program: &str, arguments: &[&str], remedy: &str) -> Result<String, Failure> {
    let output = Command::new(program).args(arguments).stdin(Stdio::null()).output();
    let output = output
        .map_err(|error| Failure::input(format!("cannot start `{program}`: {error}; {remedy}")))?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim().to_owned();
    if output.status.success() {
        return Ok(text(&output.stdout));
    }
    Err(Failure::input(format!(
        "`{program} {}` failed: {}",
        arguments.join(" "),
        files::multi_line(&text(&output.stderr))
    )))
}

/// The words that start this program, if they are not the path of the process's own.
static PROGRAM: OnceLock<Vec<String>> = OnceLock::new();

/// Sets the words that start this program in another process, for a library within another program: `python -m densify`.
/// Only the first call has an effect.
pub fn set_program(words: Vec<String>) {
    let _ = PROGRAM.set(words);
}

/// The words that start this program, which also executes submitted tasks.
///
/// # Errors
/// If the system does not report the program, or its path is not UTF-8.
pub fn program() -> Result<Vec<String>, Failure> {
    if let Some(words) = PROGRAM.get().filter(|words| !words.is_empty()) {
        return Ok(words.clone());
    }
    let path = std::env::current_exe().map_err(|error| {
        Failure::new(OTHER, format!("cannot find the program that is running: {error}"))
    })?;
    Ok(vec![utf8(&path)?.to_owned()])
}

/// The command that starts this program.
///
/// # Errors
/// As [`program`].
pub fn program_command() -> Result<Command, Failure> {
    let words = program()?;
    let mut command = Command::new(&words[0]);
    command.args(&words[1..]);
    Ok(command)
}

/// A path as text, for commands and run descriptions.
///
/// # Errors
/// If it is not UTF-8.
pub fn utf8(path: &Path) -> Result<&str, Failure> {
    let wrong = || Failure::input(format!("{}: the name is not UTF-8; rename it", path.display()));
    path.to_str().ok_or_else(wrong)
}

/// Quotes a word for a POSIX shell.
fn shell_quote(word: &str) -> String {
    format!("'{}'", word.replace('\'', r"'\''"))
}
