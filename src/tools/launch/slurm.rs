//! Slurm: one job per stage, which depends on the success of the previous stage. A stage of many tasks is an array job,
//! or several array jobs if the cluster's arrays are too small.

use std::fmt::Write as _;

use super::{Batch, EngineFile, Job, Stage, run_scheduler, shell_quote};
use densify_run::failure::Failure;

/// Maximum number of automatic restarts of a task that was killed.
const RESTARTS: u32 = 5;
/// Slurm's default `MaxArraySize` (slurm.conf(5)).
const DEFAULT_ARRAY_SIZE: usize = 1001;
const REMEDY: &str =
    "Slurm's programs must be on this machine's PATH; otherwise choose --engine local or hq";

/// Creates the batch scripts, in the order of the stages.
pub(super) fn files(batch: &Batch) -> Result<Vec<EngineFile>, Failure> {
    let array_size = max_array_size();
    let mut files = Vec::new();
    for (number, stage) in batch.stages.iter().enumerate() {
        let Stage { name, is_array, jobs } = stage;
        if !is_array {
            files.push(script(batch, number, (*name).to_owned(), None, jobs)?);
            continue;
        }
        for part in jobs.chunk_by(|a, b| a.index / array_size == b.index / array_size) {
            let first = part[0].index / array_size * array_size;
            let name = match first / array_size {
                0 => (*name).to_owned(),
                index => format!("{name}-{}", index + 1),
            };
            files.push(script(batch, number, name, Some(first), part)?);
        }
    }
    Ok(files)
}

/// The cluster's `MaxArraySize`, which every index of an array must be below; Slurm's default if it is unknown.
fn max_array_size() -> usize {
    let config = run_scheduler("scontrol", &["show", "config"], REMEDY).unwrap_or_default();
    let value = config.lines().find_map(|line| line.trim_start().strip_prefix("MaxArraySize"));
    let size = value.and_then(|value| value.trim_start().strip_prefix('=')?.trim().parse().ok());
    size.unwrap_or(DEFAULT_ARRAY_SIZE).max(1)
}

/// The script of a stage, or of the part of its array that begins with task `first`.
fn script(
    batch: &Batch,
    stage: usize,
    name: String,
    first: Option<usize>,
    jobs: &[Job],
) -> Result<EngineFile, Failure> {
    let memory = jobs.iter().map(|job| job.memory).max().unwrap_or(0);
    let threads = jobs.iter().map(|job| job.threads).max().unwrap_or(1);
    let log = batch.logs().join(if first.is_some() { "%x-%a.log" } else { "%x.log" });
    let mut text = format!(
        "#!/bin/bash\n#SBATCH --job-name=densify-{name}\n#SBATCH --cpus-per-task={threads}\n#SBATCH --mem={}M\n\
         #SBATCH --requeue\n#SBATCH --open-mode=append\n#SBATCH --output=\"{}\"\n",
        memory.div_ceil(1 << 20),
        log.display()
    );
    let task = if let Some(first) = first {
        let indices: Vec<String> = jobs.iter().map(|job| (job.index - first).to_string()).collect();
        let _ = writeln!(text, "#SBATCH --array={}", indices.join(","));
        let named = |job: &Job| format!("[{}]={}", job.index - first, shell_quote(&job.name));
        let names: Vec<String> = jobs.iter().map(named).collect();
        let _ = writeln!(text, "names=({})", names.join(" "));
        "\"${names[$SLURM_ARRAY_TASK_ID]}\"".to_owned()
    } else {
        jobs.iter().map(|job| shell_quote(&job.name)).collect()
    };
    let command_line: Vec<String> =
        batch.command_line()?.iter().map(|word| shell_quote(word)).collect();
    let _ = write!(
        text,
        "{} {task}\n\
         code=$?\n\
         # A task that was killed, such as for lack of memory, is resumed, up to {RESTARTS} times.\n\
         if [ $code -ge 128 ] && [ \"${{SLURM_RESTART_COUNT:-0}}\" -lt {RESTARTS} ]; then\n    \
         scontrol requeue \"$SLURM_JOB_ID\" && sleep 60\n\
         fi\n\
         exit $code\n",
        command_line.join(" ")
    );
    Ok(EngineFile { stage, path: batch.folder.join("slurm").join(format!("{name}.sh")), text })
}

/// Submits the scripts, each dependent on those of the previous stage, and adds the job IDs to `jobs`.
pub(super) fn submit(files: &[EngineFile], jobs: &mut Vec<String>) -> Result<(), Failure> {
    let mut dependency = None;
    for stage in files.chunk_by(|a, b| a.stage == b.stage) {
        let before = jobs.len();
        for EngineFile { path, .. } in stage {
            let path = path.to_string_lossy();
            let mut arguments = vec!["--parsable"];
            arguments.extend(dependency.as_deref());
            arguments.push(&path);
            let output =
                run_scheduler("sbatch", &arguments, REMEDY).map_err(|failure| match &jobs[..] {
                    [] => failure,
                    jobs => {
                        let jobs = jobs.join(", ");
                        failure.and(&format!("already submitted: {jobs}; cancel with scancel"))
                    }
                })?;
            // The output is `ID`, or `ID;CLUSTER`.
            jobs.push(output.split(';').next().unwrap_or(&output).to_owned());
        }
        dependency = Some(format!("--dependency=afterok:{}", jobs[before..].join(":")));
    }
    Ok(())
}
