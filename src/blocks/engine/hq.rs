//! HyperQueue: one job file, whose tasks know what they wait for.

use std::path::Path;

use serde::Serialize;
use toml::Table;

use super::{EngineFile, asked, command_of};
use crate::blocks::{Blocks, Task};
use crate::failure::Failure;

const REMEDY: &str = "HyperQueue's `hq` must be on this machine's PATH, with a server that runs; else choose --engine local or slurm";
/// A task that has taken its worker down so often is given up.
const CRASH_LIMIT: u32 = 5;

#[derive(Serialize)]
struct Job {
    name: String,
    task: Vec<JobTask>,
}

#[derive(Serialize)]
struct JobTask {
    id: u32,
    command: Vec<String>,
    stdout: String,
    stderr: String,
    crash_limit: u32,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    deps: Vec<u32>,
    request: Vec<Request>,
}

#[derive(Serialize)]
struct Request {
    resources: Table,
}

/// The job file of what is not complete.
pub(super) fn file(
    folder: &Path,
    blocks: &Blocks,
    open: &[Task],
    with_memory: bool,
) -> Result<EngineFile, Failure> {
    let ids: Vec<(u32, Task)> = (0..).zip(open.iter().copied()).collect();
    let tasks = ids.iter().map(|&(id, task)| {
        let name = blocks.name(task);
        let log = |kind: &str| folder.join("logs").join(format!("{name}.{kind}"));
        let [out, error] = ["out", "err"].map(|kind| log(kind).to_string_lossy().into_owned());
        let is_before = |other: Task| match task {
            Task::Coarse => false,
            Task::Block(_) => other == Task::Coarse,
            Task::Merge => matches!(other, Task::Block(_)),
        };
        let before = ids.iter().filter(|(_, other)| is_before(*other)).map(|(id, _)| *id);
        let cpus = if task == Task::Merge { 1 } else { blocks.threads };
        let mut resources = Table::new();
        resources.insert("cpus".into(), i64::from(cpus).into());
        if with_memory {
            let bytes = i64::try_from(blocks.memory(task)).unwrap_or(i64::MAX);
            resources.insert("mem".into(), bytes.into());
        }
        Ok(JobTask {
            id,
            command: command_of(folder, name)?.to_vec(),
            stdout: out,
            stderr: error,
            crash_limit: CRASH_LIMIT,
            deps: before.collect(),
            request: vec![Request { resources }],
        })
    });
    let job = Job { name: "densify".to_owned(), task: tasks.collect::<Result<_, Failure>>()? };
    let text = toml::to_string(&job).map_err(Failure::input)?;
    Ok(EngineFile { path: folder.join("hq").join("job.toml"), text })
}

/// Hands the job in; returns its number.
pub(super) fn hand_in(file: &EngineFile) -> Result<String, Failure> {
    let path = file.path.to_string_lossy();
    let arguments = ["--output-mode=quiet", "job", "submit-file", &path];
    asked("hq", &arguments, REMEDY)
}
