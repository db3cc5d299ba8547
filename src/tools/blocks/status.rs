//! Determines the progress of a plan from its folders alone, whatever started the tasks.

use std::path::Path;

use super::{BlockPlan, MERGED_FILE, Task, run_folder};
use densify_train::checkpoint::newest_step;
use densify_train::output::{CONFIG_FILE, is_in_use, model_path, summary_of};

/// The progress of a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TaskState {
    /// Not started.
    Waiting,
    /// In progress, with the iteration of the last checkpoint.
    Running(u32),
    /// Stopped, can be resumed; with the iteration of the last checkpoint.
    Stopped(u32),
    /// Done.
    Complete,
}

/// The state of each task, in the order of [`BlockPlan::tasks`].
pub fn status(folder: &Path, plan: &BlockPlan) -> Vec<(Task, TaskState)> {
    plan.tasks().map(|task| (task, state(folder, plan, task))).collect()
}

fn state(folder: &Path, plan: &BlockPlan, task: Task) -> TaskState {
    if is_complete(folder, plan, task) {
        return TaskState::Complete;
    }
    if task == Task::Merge {
        return TaskState::Waiting;
    }
    let run = run_folder(folder, plan, task);
    let step = newest_step(&run).unwrap_or(0);
    if is_in_use(&run) {
        TaskState::Running(step)
    } else if run.join(CONFIG_FILE).exists() {
        TaskState::Stopped(step)
    } else {
        TaskState::Waiting
    }
}

/// True if a task is done.
pub(super) fn is_complete(folder: &Path, plan: &BlockPlan, task: Task) -> bool {
    if task == Task::Merge {
        return folder.join(MERGED_FILE).is_file();
    }
    let run = run_folder(folder, plan, task);
    let summary = summary_of(&run).ok().flatten();
    let iterations = plan.iterations(task);
    summary.is_some_and(|summary| summary.finished && summary.iterations >= iterations)
        && model_path(&run, iterations).is_file()
}
