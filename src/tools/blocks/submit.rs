//! Submits the incomplete tasks of a plan.

use std::path::Path;

use super::{BlockPlan, Task, TaskState, status};
use densify_launch as launch;
use densify_launch::{Batch, Job, Stage, Submission, utf8};
use densify_run::Observer;
use densify_run::failure::Failure;

/// Runs the tasks that are not complete, or submits them to a scheduler.
///
/// # Errors
/// Errors of [`launch::submit`].
pub fn submit(
    folder: &Path,
    plan: &BlockPlan,
    submission: Submission,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let incomplete = |(task, state)| (state != TaskState::Complete).then_some(task);
    let incomplete: Vec<Task> = status(folder, plan).into_iter().filter_map(incomplete).collect();
    if incomplete.is_empty() {
        observer.say(format_args!("every task is complete"));
        return Ok(());
    }
    let folder = std::path::absolute(folder).map_err(Failure::input)?;
    let stage = |name, is_array, includes: fn(Task) -> bool| {
        let tasks = incomplete.iter().copied().filter(|task| includes(*task));
        Stage { name, is_array, jobs: tasks.map(|task| job(plan, task)).collect() }
    };
    let stages = [
        stage("coarse", false, |task| task == Task::Coarse),
        stage("blocks", true, |task| matches!(task, Task::Block(_))),
        stage("merge", false, |task| task == Task::Merge),
    ];
    let batch = Batch {
        command: ["blocks", "run", utf8(&folder)?].map(str::to_owned).into(),
        stages: stages.into_iter().filter(|stage| !stage.jobs.is_empty()).collect(),
        inputs: Vec::new(),
        status: "`densify blocks status`".to_owned(),
        deadline: None,
        folder,
    };
    launch::submit(&batch, submission, observer)
}

fn job(plan: &BlockPlan, task: Task) -> Job {
    Job {
        name: plan.name(task).to_owned(),
        index: if let Task::Block(index) = task { index } else { 0 },
        memory: plan.memory(task),
        threads: if task == Task::Merge { 1 } else { plan.threads },
        may_have_fewer_threads: true,
        expected: None,
    }
}
