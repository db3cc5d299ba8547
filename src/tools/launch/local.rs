//! Runs tasks on this machine, each in its own process, as many at once as memory and cores allow.

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use super::{Batch, Job, Stage};
use densify_core::files::FileError;
use densify_core::memory::Bytes;
use densify_run::Observer;
use densify_run::failure::{Failure, OTHER};
use densify_run::grant;

/// Interval between checks for finished tasks.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
const LOCK_FILE: &str = "local.lock";

/// Number of tasks of a stage to run at once, and number of threads of each.
fn concurrency(jobs: &[Job]) -> (usize, u32) {
    let cores = u32::try_from(rayon::current_num_threads()).unwrap_or(u32::MAX);
    let memory = jobs.iter().map(|job| job.memory).max().unwrap_or(1);
    let threads = jobs.iter().map(|job| job.threads).max().unwrap_or(1).max(1);
    let room = grant(cores as usize).map_or(1, |limit| limit.left / memory.max(1));
    let is_fixed = jobs.iter().any(|job| !job.may_have_fewer_threads);
    let by_cores = if is_fixed { cores / threads } else { cores };
    let most = usize::try_from(room).unwrap_or(usize::MAX).min(by_cores as usize).min(jobs.len());
    let count = most.max(1);
    let share = cores / u32::try_from(count).unwrap_or(u32::MAX);
    (count, if is_fixed { threads } else { share.min(threads).max(1) })
}

/// Number of these tasks that this machine runs at once.
pub fn slots(jobs: &[Job]) -> usize {
    concurrency(jobs).0
}

/// Prints the commands without running them.
pub(super) fn show(batch: &Batch, observer: &dyn Observer) -> Result<(), Failure> {
    let command_line = batch.command_line()?.join(" ");
    for Stage { name, jobs, .. } in &batch.stages {
        let (count, threads) = concurrency(jobs);
        observer.say(format_args!("# {name}: {count} at once, on {threads} threads each"));
        for Job { name, memory, .. } in jobs {
            observer.say(format_args!("{command_line} {name}    # at most {}", Bytes(*memory)));
        }
    }
    Ok(())
}

/// Runs all tasks to completion. After a failure, no further task is started, and the running tasks finish.
///
/// # Errors
/// The first failure of a task.
pub(super) fn run(batch: &Batch, observer: &dyn Observer) -> Result<(), Failure> {
    let _lock = lock(batch)?;
    let logs = batch.logs();
    fs::create_dir_all(&logs).map_err(FileError::io("create the folder", &logs))?;
    batch.stages.iter().try_for_each(|stage| run_stage(batch, &stage.jobs, &logs, observer))
}

fn run_stage(
    batch: &Batch,
    jobs: &[Job],
    logs: &Path,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let (count, threads) = concurrency(jobs);
    let mut waiting = jobs.iter();
    let mut running: Vec<(&str, Child)> = Vec::new();
    let mut failed: Option<Failure> = None;
    loop {
        let mut ended = Vec::new();
        for (index, (name, child)) in running.iter_mut().enumerate() {
            if let Some(status) = child
                .try_wait()
                .map_err(|error| Failure::new(OTHER, format!("cannot wait for a task: {error}")))?
            {
                ended.push(index);
                if status.success() {
                    observer.say(format_args!("ended    {name}"));
                } else {
                    let log = log_path(logs, name);
                    let code = status.code().and_then(|code| u8::try_from(code).ok());
                    let message = format!(
                        "{name} has failed: {}; run the same command again to resume ({})",
                        last_message(&log),
                        log.display()
                    );
                    failed.get_or_insert(Failure::new(code.unwrap_or(OTHER), message));
                }
            }
        }
        for index in ended.into_iter().rev() {
            running.remove(index);
        }
        if let Some(interrupt) = observer.interrupt() {
            // The tasks have received the same signal and stop by themselves.
            let message = format!("stopped by {}; the same command resumes", interrupt.name);
            failed.get_or_insert(Failure::new(interrupt.exit_code, message));
        }
        while failed.is_none() && running.len() < count {
            let Some(next) = waiting.next() else { break };
            if !fits(next, batch.deadline) {
                observer.say(format_args!("left out {}: it would end too late", next.name));
                continue;
            }
            observer.say(format_args!("started  {}", next.name));
            running.push((&next.name, start(batch, next, threads, logs)?));
        }
        if running.is_empty() {
            return failed.map_or(Ok(()), Err);
        }
        sleep(POLL_INTERVAL);
    }
}

/// True if a task that starts now is expected to end before the deadline.
fn fits(job: &Job, deadline: Option<Instant>) -> bool {
    let end = Instant::now() + job.expected.unwrap_or_default();
    deadline.is_none_or(|deadline| end <= deadline)
}

fn log_path(logs: &Path, name: &str) -> PathBuf {
    logs.join(format!("{name}.log"))
}

fn start(batch: &Batch, job: &Job, threads: u32, logs: &Path) -> Result<Child, Failure> {
    let command_line = batch.command_line()?;
    let path = log_path(logs, &job.name);
    let log = File::options().create(true).append(true).open(&path);
    let log = log.map_err(FileError::io("write", &path))?;
    let copy = log.try_clone().map_err(FileError::io("write", &path))?;
    let mut command = Command::new(&command_line[0]);
    command.args(&command_line[1..]).arg(&job.name);
    if job.may_have_fewer_threads {
        command.args(["--threads", &threads.to_string()]);
    }
    command.stdin(Stdio::null()).stdout(log).stderr(copy);
    let child = command.spawn();
    child.map_err(|error| Failure::new(OTHER, format!("cannot start {}: {error}", job.name)))
}

/// Locks the batch, so that two processes do not run its tasks at the same time.
fn lock(batch: &Batch) -> Result<File, Failure> {
    let path = batch.folder.join(LOCK_FILE);
    let file = File::options().create(true).append(true).open(&path);
    let file = file.map_err(FileError::io("write", &path))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(Failure::input(format!(
            "another process runs the tasks of {}; see {}",
            batch.folder.display(),
            batch.status
        ))),
        Err(TryLockError::Error(error)) => Err(FileError::io("lock", &path)(error).into()),
    }
}

/// The message of the error that ended a task, or else the last line of its output.
fn last_message(log: &Path) -> String {
    let text = fs::read_to_string(log).unwrap_or_default();
    // The log continues that of an earlier attempt.
    let message = text.rsplit_once("error: ").map(|(_, message)| message);
    let lines = message.unwrap_or(&text).lines().map(str::trim).filter(|line| !line.is_empty());
    let lines: Vec<&str> = lines.collect();
    match (message, lines.last()) {
        (_, None) => "no output".to_owned(),
        (Some(_), _) => lines.join(" "),
        (None, Some(last)) => (*last).to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_task_fits_if_it_ends_before_the_deadline() {
        let minutes = |minutes: u64| Duration::from_secs(60 * minutes);
        let deadline = Some(Instant::now() + minutes(10));
        let job = |expected| Job {
            name: String::new(),
            index: 0,
            memory: 1,
            threads: 1,
            may_have_fewer_threads: false,
            expected,
        };
        assert!(fits(&job(Some(minutes(8))), deadline));
        assert!(!fits(&job(Some(minutes(12))), deadline));
        assert!(fits(&job(Some(minutes(12))), None) && fits(&job(None), deadline));
        assert!(!fits(&job(None), Some(Instant::now() - minutes(1))));
    }

    #[test]
    fn the_message_of_the_last_error_is_shown_as_a_whole() {
        let log = std::env::temp_dir().join(format!("densify-launch-{}.log", std::process::id()));
        for (text, expected) in [
            ("", "no output"),
            ("one\ntwo\n\n", "two"),
            ("error: old\nrunning\nerror: bad\nthis was a\n", "bad this was a"),
        ] {
            fs::write(&log, text).unwrap();
            assert_eq!(last_message(&log), expected);
        }
        fs::remove_file(&log).unwrap();
    }
}
