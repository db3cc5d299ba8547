//! Slurm: one job per stage, dependent on the success of the stage before; an array job for a stage of many tasks.

use std::fmt::Write as _;

use super::{Batch, EngineFile, Job, Stage, run_scheduler, shell_quote};
use densify_run::failure::Failure;

/// Maximum number of automatic restarts of a task that was killed.
const RESTARTS: u32 = 5;
const REMEDY: &str =
    "Slurm's programs must be on this machine's PATH; otherwise choose --engine local or hq";

/// Creates the batch scripts, in the order of the stages.
pub(super) fn files(batch: &Batch) -> Result<Vec<EngineFile>, Failure> {
    batch.stages.iter().map(|stage| script(batch, stage)).collect()
}

fn script(batch: &Batch, Stage { name, is_array, jobs }: &Stage) -> Result<EngineFile, Failure> {
    let memory = jobs.iter().map(|job| job.memory).max().unwrap_or(0);
    let threads = jobs.iter().map(|job| job.threads).max().unwrap_or(1);
    let log = batch.logs().join(if *is_array { "%x-%a.log" } else { "%x.log" });
    let mut text = format!(
        "#!/bin/bash\n#SBATCH --job-name=densify-{name}\n#SBATCH --cpus-per-task={threads}\n#SBATCH --mem={}M\n\
         #SBATCH --requeue\n#SBATCH --open-mode=append\n#SBATCH --output=\"{}\"\n",
        memory.div_ceil(1 << 20),
        log.display()
    );
    let task = if *is_array {
        let indices: Vec<String> = jobs.iter().map(|job| job.index.to_string()).collect();
        let _ = writeln!(text, "#SBATCH --array={}", indices.join(","));
        let named = |job: &Job| format!("[{}]={}", job.index, shell_quote(&job.name));
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
    Ok(EngineFile { path: batch.folder.join("slurm").join(format!("{name}.sh")), text })
}

/// Submits the scripts, each dependent on the one before, and returns the job IDs.
pub(super) fn submit(files: &[EngineFile]) -> Result<Vec<String>, Failure> {
    let mut jobs: Vec<String> = Vec::new();
    for EngineFile { path, .. } in files {
        let path = path.to_string_lossy();
        let after = jobs.last().map(|job| format!("--dependency=afterok:{job}"));
        let mut arguments = vec!["--parsable"];
        arguments.extend(after.as_deref());
        arguments.push(&path);
        let output =
            run_scheduler("sbatch", &arguments, REMEDY).map_err(|failure| match &jobs[..] {
                [] => failure,
                jobs => failure
                    .and(&format!("already submitted: {}; cancel with scancel", jobs.join(", "))),
            })?;
        // The output is `ID`, or `ID;CLUSTER`.
        jobs.push(output.split(';').next().unwrap_or(&output).to_owned());
    }
    Ok(jobs)
}
