//! HyperQueue: one job file with dependencies between tasks.

use serde::Serialize;
use toml::Table;

use super::{Batch, EngineFile, run_scheduler};
use densify_run::failure::Failure;

const REMEDY: &str = "HyperQueue's `hq` must be on this machine's PATH, with a running server; otherwise choose --engine local or slurm";
/// HyperQueue gives up on a task whose worker was lost this many times.
const CRASH_LIMIT: u32 = 5;

#[derive(Serialize)]
struct HqJob {
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

/// Creates the job file.
pub(super) fn file(batch: &Batch, with_memory: bool) -> Result<EngineFile, Failure> {
    let command_line = batch.command_line()?;
    let mut tasks = Vec::new();
    let number = |count| u32::try_from(count).unwrap_or(u32::MAX);
    let mut previous_stage = 0..0;
    for stage in &batch.stages {
        let first = number(tasks.len());
        for (id, job) in (first..).zip(&stage.jobs) {
            let log = |kind: &str| {
                let path = batch.logs().join(format!("{}.{kind}", job.name));
                path.to_string_lossy().into_owned()
            };
            let mut resources = Table::new();
            resources.insert("cpus".into(), i64::from(job.threads).into());
            if with_memory {
                let bytes = i64::try_from(job.memory).unwrap_or(i64::MAX);
                resources.insert("mem".into(), bytes.into());
            }
            tasks.push(JobTask {
                id,
                command: command_line.iter().chain([&job.name]).cloned().collect(),
                stdout: log("out"),
                stderr: log("err"),
                crash_limit: CRASH_LIMIT,
                deps: previous_stage.clone().collect(),
                request: vec![Request { resources }],
            });
        }
        previous_stage = first..number(tasks.len());
    }
    let text = toml::to_string(&HqJob { name: "densify".to_owned(), task: tasks });
    let text = text.map_err(Failure::input)?;
    Ok(EngineFile { stage: 0, path: batch.folder.join("hq").join("job.toml"), text })
}

/// Submits the job and returns its ID.
pub(super) fn submit(file: &EngineFile) -> Result<String, Failure> {
    let path = file.path.to_string_lossy();
    let arguments = ["--output-mode=quiet", "job", "submit-file", &path];
    run_scheduler("hq", &arguments, REMEDY)
}
