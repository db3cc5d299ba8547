//! Slurm: a job for each stage, each after the one before has succeeded; a stage of many tasks is an array.

use std::fmt::Write as _;

use super::{Batch, EngineFile, Job, Stage, asked, mebibytes, quoted};
use densify_run::failure::Failure;

/// How often a task that was killed begins again by itself.
const RESTARTS: u32 = 5;
const REMEDY: &str =
    "Slurm's programs must be on this machine's PATH; else choose --engine local or hq";

/// The batch scripts, in order.
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
        mebibytes(memory),
        log.display()
    );
    let task = if *is_array {
        let places: Vec<String> = jobs.iter().map(|job| job.place.to_string()).collect();
        let _ = writeln!(text, "#SBATCH --array={}", places.join(","));
        let named = |job: &Job| format!("[{}]={}", job.place, quoted(&job.name));
        let names: Vec<String> = jobs.iter().map(named).collect();
        let _ = writeln!(text, "names=({})", names.join(" "));
        "\"${names[$SLURM_ARRAY_TASK_ID]}\"".to_owned()
    } else {
        jobs.iter().map(|job| quoted(&job.name)).collect()
    };
    let words: Vec<String> = batch.words()?.iter().map(|word| quoted(word)).collect();
    let _ = write!(
        text,
        "{} {task}\n\
         code=$?\n\
         # Killed, such as for memory or by its machine: it goes on from where it was, up to {RESTARTS} times.\n\
         if [ $code -ge 128 ] && [ \"${{SLURM_RESTART_COUNT:-0}}\" -lt {RESTARTS} ]; then\n    \
         scontrol requeue \"$SLURM_JOB_ID\" && sleep 60\n\
         fi\n\
         exit $code\n",
        words.join(" ")
    );
    Ok(EngineFile { path: batch.folder.join("slurm").join(format!("{name}.sh")), text })
}

/// Hands the scripts in, each to begin when the one before has succeeded; returns the jobs' numbers.
pub(super) fn hand_in(files: &[EngineFile]) -> Result<Vec<String>, Failure> {
    let mut jobs: Vec<String> = Vec::new();
    for EngineFile { path, .. } in files {
        let path = path.to_string_lossy();
        let after = jobs.last().map(|job| format!("--dependency=afterok:{job}"));
        let mut arguments = vec!["--parsable"];
        arguments.extend(after.as_deref());
        arguments.push(&path);
        let said = asked("sbatch", &arguments, REMEDY).map_err(|failure| match &jobs[..] {
            [] => failure,
            jobs => {
                failure.and(&format!("handed in already: {}; cancel with scancel", jobs.join(", ")))
            }
        })?;
        // A cluster's name may follow.
        jobs.push(said.split(';').next().unwrap_or(&said).to_owned());
    }
    Ok(jobs)
}
