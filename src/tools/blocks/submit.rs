//! The tasks of a plan that are not complete, as an engine starts them.

use std::path::Path;

use super::{Blocks, State, Task, status};
use densify_launch as launch;
use densify_launch::{Batch, Job, Stage, Submission, utf8};
use densify_run::Observer;
use densify_run::failure::Failure;

/// Starts the tasks that are not complete, or hands them in.
///
/// # Errors
/// As [`launch::submit`].
pub fn submit(
    folder: &Path,
    blocks: &Blocks,
    submission: Submission,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let is_open = |(_, state): &(Task, State)| *state != State::Complete;
    let open: Vec<Task> =
        status(folder, blocks).into_iter().filter(is_open).map(|(task, _)| task).collect();
    if open.is_empty() {
        observer.say(format_args!("every task is complete"));
        return Ok(());
    }
    let folder = std::path::absolute(folder).map_err(Failure::input)?;
    let stage = |name, is_array, of: fn(Task) -> bool| {
        let tasks = open.iter().copied().filter(|task| of(*task));
        Stage { name, is_array, jobs: tasks.map(|task| job(blocks, task)).collect() }
    };
    let stages = [
        stage("coarse", false, |task| task == Task::Coarse),
        stage("blocks", true, |task| matches!(task, Task::Block(_))),
        stage("merge", false, |task| task == Task::Merge),
    ];
    let batch = Batch {
        command: ["blocks", "run", utf8(&folder)?].map(str::to_owned).into(),
        stages: stages.into_iter().filter(|stage| !stage.jobs.is_empty()).collect(),
        status: "`densify blocks status`".to_owned(),
        folder,
    };
    launch::submit(&batch, submission, observer)
}

fn job(blocks: &Blocks, task: Task) -> Job {
    Job {
        name: blocks.name(task).to_owned(),
        index: if let Task::Block(index) = task { index } else { 0 },
        memory: blocks.memory(task),
        threads: if task == Task::Merge { 1 } else { blocks.threads },
        may_have_fewer_threads: true,
    }
}
