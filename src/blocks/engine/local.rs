//! This machine: every task in a process of its own, as many at once as memory allows.

use std::fs::{self, File, TryLockError};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use super::command_of;
use crate::blocks::{Blocks, Task};
use crate::failure::{Failure, OTHER};
use crate::memory::{Bytes, grant};
use crate::output::OutputError;
use crate::run::Observer;

/// How often it is looked whether a task has ended.
const LOOK: Duration = Duration::from_millis(100);
const LOCK_FILE: &str = "local.lock";

/// How many blocks run at once, and on how many threads each.
fn at_once(blocks: &Blocks, open: &[Task]) -> (usize, u32) {
    let of_blocks = || open.iter().filter(|task| matches!(task, Task::Block(_)));
    let memory = of_blocks().map(|task| blocks.memory(*task)).max().unwrap_or(1);
    let cores = rayon::current_num_threads();
    let room = grant(cores).map_or(1, |limit| limit.left / memory.max(1));
    let most = usize::try_from(room).unwrap_or(usize::MAX).min(cores).min(of_blocks().count());
    let count = most.max(1);
    (count, u32::try_from(cores / count).unwrap_or(u32::MAX).min(blocks.threads).max(1))
}

/// Says what would be started.
pub(super) fn show(
    folder: &Path,
    blocks: &Blocks,
    open: &[Task],
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let (count, threads) = at_once(blocks, open);
    observer.say(format_args!("# blocks at once: {count}, on {threads} threads each"));
    for task in open {
        let memory = Bytes(blocks.memory(*task));
        let words = command_of(folder, blocks.name(*task))?.join(" ");
        observer.say(format_args!("{words}    # at most {memory}"));
    }
    Ok(())
}

/// Runs tasks to their end.
///
/// # Errors
/// When one fails, the first that did; others that were running then have ended, and none is started after it.
pub(super) fn run(
    folder: &Path,
    blocks: &Blocks,
    open: &[Task],
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let _lock = lock(folder)?;
    let logs = folder.join("logs");
    fs::create_dir_all(&logs).map_err(OutputError::io("create the folder", &logs))?;
    let (count, threads) = at_once(blocks, open);
    let mut waiting = open.to_vec();
    waiting.reverse();
    let mut running: Vec<(Task, Child)> = Vec::new();
    let mut failed: Option<Failure> = None;
    loop {
        let mut ended = Vec::new();
        for (place, (task, child)) in running.iter_mut().enumerate() {
            if let Some(status) = child.try_wait().map_err(cannot_wait)? {
                ended.push(place);
                let name = blocks.name(*task);
                if status.success() {
                    observer.say(format_args!("ended    {name}"));
                } else {
                    let log = logs.join(format!("{name}.log"));
                    let code = status.code().and_then(|code| u8::try_from(code).ok());
                    let message = format!(
                        "{name} has failed: {}; submit again to go on from here ({})",
                        last_line(&log),
                        log.display()
                    );
                    failed.get_or_insert(Failure { code: code.unwrap_or(OTHER), message });
                }
            }
        }
        for place in ended.into_iter().rev() {
            running.remove(place);
        }
        if let Some(interrupt) = observer.interrupt() {
            // The same signal has reached the tasks, which end in order.
            let message = format!("stopped by {}; submit again to go on", interrupt.name);
            failed.get_or_insert(Failure { code: interrupt.exit_code, message });
        }
        let may_start = failed.is_none();
        while may_start && running.len() < count {
            let Some(&next) = waiting.last() else { break };
            // Blocks wait for the coarse run, and the merge for all.
            let is_block = |task: Task| matches!(task, Task::Block(_));
            let beside_blocks = is_block(next) && running.iter().all(|it| is_block(it.0));
            if !(running.is_empty() || beside_blocks) {
                break;
            }
            waiting.pop();
            observer.say(format_args!("started  {}", blocks.name(next)));
            running.push((next, started(folder, blocks, next, threads, &logs)?));
        }
        match (running.is_empty(), failed.take()) {
            (true, Some(failure)) => return Err(failure),
            (true, None) if waiting.is_empty() => return Ok(()),
            (_, kept) => failed = kept,
        }
        sleep(LOOK);
    }
}

fn started(
    folder: &Path,
    blocks: &Blocks,
    task: Task,
    threads: u32,
    logs: &Path,
) -> Result<Child, Failure> {
    let name = blocks.name(task);
    let words = command_of(folder, name)?;
    let path = logs.join(format!("{name}.log"));
    let log = File::options().create(true).append(true).open(&path);
    let log = log.map_err(OutputError::io("write", &path))?;
    let copy = log.try_clone().map_err(OutputError::io("write", &path))?;
    let mut command = Command::new(&words[0]);
    command.args(&words[1..]).args(["--threads", &threads.to_string()]);
    command.stdin(Stdio::null()).stdout(log).stderr(copy);
    let child = command.spawn();
    child.map_err(|error| Failure { code: OTHER, message: format!("cannot start {name}: {error}") })
}

/// Held while tasks run here: a plan is not run twice at a time.
fn lock(folder: &Path) -> Result<File, Failure> {
    let path = folder.join(LOCK_FILE);
    let file = File::options().create(true).append(true).open(&path);
    let file = file.map_err(OutputError::io("write", &path))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(Failure::input(format!(
            "another process runs the tasks of {}; see `densify blocks status`",
            folder.display()
        ))),
        Err(TryLockError::Error(error)) => Err(OutputError::io("lock", &path)(error).into()),
    }
}

/// What a task said last.
fn last_line(log: &Path) -> String {
    let text = fs::read_to_string(log).unwrap_or_default();
    let line = text.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("no word");
    line.trim().trim_start_matches("error: ").to_owned()
}

fn cannot_wait(error: std::io::Error) -> Failure {
    Failure { code: OTHER, message: format!("cannot wait for a task: {error}") }
}
