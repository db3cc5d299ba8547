//! Runs pycolmap, stage by stage, each in a process of its own: its crash costs one stage, not densify.

use std::fs::{self, File};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

use serde_json::Value;

use crate::error::PosesError;
use densify_core::files::{self, FileError, write_atomically};
use densify_run::Observer;

/// The program that runs in Python.
const SCRIPT: &str = include_str!("engine.py");
/// Prints the version of pycolmap.
const VERSION: &str = "import pycolmap; print(pycolmap.__version__)";
/// Oldest version whose functions are those that the script calls.
const MIN_MAJOR: u32 = 4;
/// Interval between checks for a signal.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Pythons that are tried if none is named.
const PYTHONS: [&str; 2] = ["python3", "python"];
/// Parts of a stage that are reported.
const PARTS: usize = 4;

/// A Python with pycolmap, and the folder where it works.
#[derive(Debug)]
pub(crate) struct Engine {
    python: PathBuf,
    version: String,
    script: PathBuf,
    log: PathBuf,
}

impl Engine {
    /// Finds pycolmap, and checks its version. Writes nothing.
    ///
    /// # Errors
    /// When no Python has it, or it is too old.
    pub(crate) fn find(python: Option<&Path>, work: &Path) -> Result<Self, PosesError> {
        let candidates: Vec<&Path> =
            python.map_or_else(|| PYTHONS.map(Path::new).to_vec(), |python| vec![python]);
        for python in &candidates {
            let answer = Command::new(python).args(["-c", VERSION]).stdin(Stdio::null()).output();
            let Some(answer) = answer.ok().filter(|answer| answer.status.success()) else {
                continue;
            };
            let text = String::from_utf8_lossy(&answer.stdout);
            let version = files::one_line(text.lines().last().unwrap_or_default().trim());
            let major: u32 =
                version.split('.').next().and_then(|major| major.parse().ok()).unwrap_or(0);
            if major < MIN_MAJOR {
                return Err(PosesError::OldEngine {
                    version,
                    python: python.display().to_string(),
                });
            }
            let [script, log] = ["engine.py", "log.txt"].map(|name| work.join(name));
            return Ok(Self { python: python.to_path_buf(), version, script, log });
        }
        let tried = candidates[0].display().to_string();
        Err(PosesError::NoEngine { tried })
    }

    /// Writes the script into the folder of intermediate results.
    pub(crate) fn install(&self) -> Result<(), PosesError> {
        Ok(write_atomically(&self.script, |out| out.write_all(SCRIPT.as_bytes()))?)
    }

    /// Name and version, for messages and reports.
    pub(crate) fn name(&self) -> String {
        format!("pycolmap {}", self.version)
    }

    /// Runs a stage that writes `result`, unless an earlier call has. `request` has everything that it needs.
    ///
    /// # Errors
    /// When it fails or writes no JSON, or a signal asks to stop.
    pub(crate) fn run(
        &self,
        stage: &str,
        mut request: Value,
        result: &Path,
        observer: &dyn Observer,
    ) -> Result<Value, PosesError> {
        if !result.is_file() {
            let question = result.with_extension("request");
            request["result"] = result.to_string_lossy().into();
            write_atomically(&question, |out| out.write_all(request.to_string().as_bytes()))?;
            let mut command = Command::new(&self.python);
            command.arg("-u").arg(&self.script).arg(stage).arg(&question);
            let threads = request["threads"].to_string();
            command.env("OMP_NUM_THREADS", threads);
            run_logged((command, "pycolmap", stage), &self.log, observer)?;
        }
        let text = fs::read_to_string(result).map_err(FileError::io("read", result))?;
        serde_json::from_str(&text).map_err(|error| {
            let work = files::folder_of(&self.log).to_owned();
            PosesError::Nonsense { file: result.to_owned(), problem: error.to_string(), work }
        })
    }
}

/// Runs a program to its end, appends its output to a log, and reports lines such as `progress pairs 20 400`.
///
/// # Errors
/// When it cannot be started or fails, or a signal asks to stop; it is ended then.
pub(crate) fn run_logged(
    (mut command, program, task): (Command, &str, &str),
    log: &Path,
    observer: &dyn Observer,
) -> Result<(), PosesError> {
    let failed = |how: String, remedy| PosesError::Failed {
        what: format!("{program} ({task})"),
        how,
        log: log.to_owned(),
        remedy,
    };
    let mut lines =
        File::options().create(true).append(true).open(log).map_err(FileError::io("write", log))?;
    let errors = lines.try_clone().map_err(FileError::io("write", log))?;
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(errors);
    let mut child =
        command.spawn().map_err(|error| failed(format!("cannot start: {error}"), RERUN))?;
    let (sender, receiver) = mpsc::channel();
    if let Some(output) = child.stdout.take() {
        std::thread::spawn(move || {
            // Ends when the program does; output that is no text is skipped.
            for line in BufReader::new(output).split(b'\n').map_while(Result::ok) {
                if sender.send(String::from_utf8_lossy(&line).into_owned()).is_err() {
                    break;
                }
            }
        });
    }
    let mut reported = String::new();
    loop {
        match receiver.recv_timeout(POLL_INTERVAL) {
            Ok(line) => match progress(&line) {
                Some(report) if report == reported => {}
                Some(report) => {
                    observer.say(format_args!("{report}"));
                    reported = report;
                }
                // A log that cannot be written is no reason to stop.
                None => _ = writeln!(lines, "{line}"),
            },
            Err(RecvTimeoutError::Disconnected) => break,
            Err(RecvTimeoutError::Timeout) => {}
        }
        if let Some(interrupt) = observer.interrupt() {
            let _ = child.kill();
            let _ = child.wait();
            return Err(PosesError::Stopped(interrupt));
        }
    }
    let status =
        child.wait().map_err(|error| failed(format!("cannot be waited for: {error}"), RERUN))?;
    if status.success() {
        return Ok(());
    }
    if let Some(interrupt) = observer.interrupt() {
        return Err(PosesError::Stopped(interrupt));
    }
    let last = last_line(log);
    Err(failed(format!("{}: {last}", ending(status)), remedy(status, &last)))
}

/// The report of a line `progress WHAT DONE TOTAL`, in quarters.
fn progress(line: &str) -> Option<String> {
    let words: Vec<&str> = line.strip_prefix("progress ")?.split(' ').collect();
    let [what, done, total] = words[..] else { return None };
    let (done, total): (usize, usize) = (done.parse().ok()?, total.parse().ok()?);
    let part = PARTS * done.min(total) / total.max(1);
    Some(format!("{:8} {} %", files::one_line(what), 100 * part / PARTS))
}

const RERUN: &str = "the same command continues where it stopped";

/// How a program ended.
fn ending(status: ExitStatus) -> String {
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&status) {
        return format!("was ended by signal {signal}");
    }
    format!("failed with code {}", status.code().unwrap_or(-1))
}

fn remedy(status: ExitStatus, last: &str) -> &'static str {
    let last = last.to_lowercase();
    if ["no space", "disk is full", "disk i/o", "file too large"]
        .iter()
        .any(|words| last.contains(words))
    {
        return "make room there, and run the same command again: it continues where it stopped";
    }
    if last.contains("memoryerror")
        || last.contains("bad_alloc")
        || ending(status).ends_with("signal 9")
    {
        return "if memory was short, give fewer --threads; the same command continues where it stopped";
    }
    RERUN
}

/// The last line of a program's output.
fn last_line(log: &Path) -> String {
    let bytes = fs::read(log).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let line = text.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("no output");
    files::one_line(line.trim())
}
