//! How far a plan is, from its folders alone, whatever started the tasks.

use std::path::Path;

use super::{Blocks, MERGED_FILE, Task, run_folder};
use densify_train::checkpoint::newest_step;
use densify_train::output::{CONFIG_FILE, is_in_use, model_path, summary_of};

/// How far a task is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Nothing is there.
    Waiting,
    /// A process is at it; the last checkpoint's step.
    Running(u32),
    /// It was stopped, and can go on; the last checkpoint's step.
    Stopped(u32),
    /// It is done.
    Complete,
}

/// The state of each task, in their order.
#[must_use]
pub fn status(folder: &Path, blocks: &Blocks) -> Vec<(Task, State)> {
    blocks.tasks().map(|task| (task, state(folder, blocks, task))).collect()
}

fn state(folder: &Path, blocks: &Blocks, task: Task) -> State {
    if is_complete(folder, blocks, task) {
        return State::Complete;
    }
    if task == Task::Merge {
        return State::Waiting;
    }
    let run = run_folder(folder, blocks, task);
    let step = newest_step(&run).unwrap_or(0);
    if is_in_use(&run) {
        State::Running(step)
    } else if run.join(CONFIG_FILE).exists() {
        State::Stopped(step)
    } else {
        State::Waiting
    }
}

/// Whether a task is done.
pub(super) fn is_complete(folder: &Path, blocks: &Blocks, task: Task) -> bool {
    if task == Task::Merge {
        return folder.join(MERGED_FILE).is_file();
    }
    let run = run_folder(folder, blocks, task);
    let summary = summary_of(&run).ok().flatten();
    let iterations = blocks.iterations(task);
    let is_finished = summary.is_some_and(|it| it.finished && it.iterations >= iterations);
    is_finished && model_path(&run, iterations).is_file()
}
