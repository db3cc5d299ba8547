//! What starts tasks that need no human: this machine, or a scheduler that a cluster has, for which files are written and
//! handed in. Who has the tasks describes them as a [`Batch`]; whether they are done is theirs to know.

mod hq;
mod local;
mod slurm;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clap::Args;
use serde::{Deserialize, Serialize};

use densify_core::files;
use densify_core::files::{FileError, write_atomically};
use densify_run::Observer;
use densify_run::failure::{Failure, OTHER};

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

/// The options of commands that hand tasks in, beside `--engine`.
#[derive(Debug, Clone, Default, Args)]
pub struct SubmissionArgs {
    /// Print the files for the engine, and start nothing
    #[arg(long)]
    dry_run: bool,
    /// Hand in again what is not complete
    #[arg(long)]
    again: bool,
    /// Ask HyperQueue for memory too: its workers must offer the resource `mem`, in bytes, else tasks wait for ever
    #[arg(long)]
    mem_resource: bool,
}

impl SubmissionArgs {
    /// What was asked for.
    ///
    /// # Errors
    /// When an option is for another engine than the one given.
    pub fn with(&self, engine: Engine) -> Result<Submission, Failure> {
        let Self { dry_run, again, mem_resource: with_memory } = *self;
        if with_memory && engine != Engine::Hq {
            return Err(Failure::input("--mem-resource is for --engine hq; leave it out"));
        }
        Ok(Submission { engine, dry_run, again, with_memory })
    }

    /// Where no engine is given.
    ///
    /// # Errors
    /// When one of these options is.
    pub fn without(&self) -> Result<(), Failure> {
        let given = [
            (self.dry_run, "--dry-run"),
            (self.again, "--again"),
            (self.mem_resource, "--mem-resource"),
        ];
        match given.into_iter().find(|(is_given, _)| *is_given) {
            Some((_, flag)) => {
                Err(Failure::input(format!("{flag} is for --engine; give both, or none")))
            }
            None => Ok(()),
        }
    }
}

/// Tasks in stages, each to begin when the one before it is done.
#[derive(Debug, Clone)]
pub struct Batch {
    /// Where the files of the engine and the logs are; absolute.
    pub folder: PathBuf,
    /// The words after the program's name that start a task; its own name follows.
    pub command: Vec<String>,
    /// The stages, none of them empty.
    pub stages: Vec<Stage>,
    /// What says how far they are.
    pub status: String,
}

/// Tasks that do not wait for each other.
#[derive(Debug, Clone)]
pub struct Stage {
    /// Its name.
    pub name: &'static str,
    /// Whether it is one of many tasks by its nature, however few are left.
    pub is_array: bool,
    /// Its tasks.
    pub jobs: Vec<Job>,
}

/// A task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Job {
    /// Its name.
    pub name: String,
    /// Its number in its stage, also where others are done.
    pub place: usize,
    /// What it takes at most `[bytes]`.
    pub memory: u64,
    /// Processor threads that it uses.
    pub threads: u32,
    /// Whether it may be told to use fewer, with `--threads`.
    pub may_have_fewer_threads: bool,
}

impl Batch {
    /// The folder of what tasks say.
    fn logs(&self) -> PathBuf {
        self.folder.join("logs")
    }

    /// The program and what starts a task, but its name.
    fn words(&self) -> Result<Vec<String>, Failure> {
        Ok([utf8(&program()?)?.to_owned()]
            .into_iter()
            .chain(self.command.iter().cloned())
            .collect())
    }
}

/// A file for a scheduler.
struct EngineFile {
    path: PathBuf,
    text: String,
}

/// What was handed in, as it stands in the folder.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Submitted {
    engine: Engine,
    jobs: Vec<String>,
}

const SUBMITTED_FILE: &str = "submitted.toml";

/// The jobs that were handed in, of a folder.
#[must_use]
pub fn submitted(folder: &Path) -> Option<String> {
    let text = files::read_text(&folder.join(SUBMITTED_FILE), files::MAX_OPTIONS).ok()?;
    let before = toml::from_str::<Submitted>(&text).map(|it| it.jobs.join(", "));
    Some(before.unwrap_or_else(|_| "unknown".to_owned()))
}

/// Starts tasks here, and waits for their end, or hands them in.
///
/// # Errors
/// When the engine is not there or refuses, they were handed in before, and, of tasks that this machine runs, as
/// theirs.
pub fn submit(
    batch: &Batch,
    submission: Submission,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let files = match submission.engine {
        Engine::Local if submission.dry_run => return local::show(batch, observer),
        Engine::Local => return local::run(batch, observer),
        Engine::Slurm => slurm::files(batch)?,
        Engine::Hq => vec![hq::file(batch, submission.with_memory)?],
    };
    if submission.dry_run {
        for EngineFile { path, text } in &files {
            observer.say(format_args!("# {}\n{text}", path.display()));
        }
        return Ok(());
    }
    if let Some(jobs) = submitted(&batch.folder).filter(|_| !submission.again) {
        return Err(Failure::input(format!(
            "{} was handed in before, as job {jobs}; see {}, and give --again to hand in what is not complete once \
             those jobs have ended",
            batch.folder.display(),
            batch.status
        )));
    }
    let logs = batch.logs();
    fs::create_dir_all(&logs).map_err(FileError::io("create the folder", &logs))?;
    for EngineFile { path, text } in &files {
        write_atomically(path, |out| out.write_all(text.as_bytes()))?;
    }
    let jobs = match submission.engine {
        Engine::Hq => files.iter().map(hq::hand_in).collect::<Result<_, _>>()?,
        _ => slurm::hand_in(&files)?,
    };
    observer.say(format_args!("job      {}", jobs.join(", ")));
    let text = toml::to_string(&Submitted { engine: submission.engine, jobs });
    let text = text.map_err(Failure::input)?;
    write_atomically(&batch.folder.join(SUBMITTED_FILE), |out| out.write_all(text.as_bytes()))?;
    Ok(())
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
        files::lines(&said(&output.stderr))
    )))
}

/// The program that is running, which also does what is handed in.
///
/// # Errors
/// When the system does not say where it is.
pub fn program() -> Result<PathBuf, Failure> {
    std::env::current_exe().map_err(|error| {
        Failure::new(OTHER, format!("cannot find the program that is running: {error}"))
    })
}

/// A path as text, for commands and descriptions.
///
/// # Errors
/// When it is not UTF-8.
pub fn utf8(path: &Path) -> Result<&str, Failure> {
    let wrong = || Failure::input(format!("{}: the name is not UTF-8; rename it", path.display()));
    path.to_str().ok_or_else(wrong)
}

/// A word for a shell, whatever is in it.
fn quoted(word: &str) -> String {
    format!("'{}'", word.replace('\'', r"'\''"))
}

/// Mebibytes, rounded up.
fn mebibytes(bytes: u64) -> u64 {
    bytes.div_ceil(1 << 20)
}
