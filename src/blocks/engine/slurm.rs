//! Slurm: three jobs, each after the one before has succeeded: the coarse run, an array of blocks, the merge.

use std::fmt::Write as _;
use std::path::Path;

use super::{EngineFile, asked, command_of, mebibytes, quoted};
use crate::blocks::{Blocks, Task};
use crate::failure::Failure;

/// How often a task that was killed begins again by itself.
const RESTARTS: u32 = 5;
const REMEDY: &str =
    "Slurm's programs must be on this machine's PATH; else choose --engine local or hq";

/// The batch scripts of what is not complete, in order.
pub(super) fn files(
    folder: &Path,
    blocks: &Blocks,
    open: &[Task],
) -> Result<Vec<EngineFile>, Failure> {
    let places: Vec<usize> = open
        .iter()
        .filter_map(|task| if let Task::Block(place) = task { Some(*place) } else { None })
        .collect();
    let mut files = Vec::new();
    if open.contains(&Task::Coarse) {
        files.push(script(folder, blocks, "coarse", &[Task::Coarse], None)?);
    }
    if !places.is_empty() {
        let tasks: Vec<Task> = places.iter().copied().map(Task::Block).collect();
        let list: Vec<String> = places.iter().map(usize::to_string).collect();
        files.push(script(folder, blocks, "blocks", &tasks, Some(list.join(",")))?);
    }
    if open.contains(&Task::Merge) {
        files.push(script(folder, blocks, "merge", &[Task::Merge], None)?);
    }
    Ok(files)
}

/// A batch script for some tasks; several are an array of these places.
fn script(
    folder: &Path,
    blocks: &Blocks,
    name: &str,
    tasks: &[Task],
    array: Option<String>,
) -> Result<EngineFile, Failure> {
    let memory = tasks.iter().map(|task| blocks.memory(*task)).max().unwrap_or(0);
    let log = folder.join("logs").join(if array.is_some() { "%x-%a.log" } else { "%x.log" });
    let mut text = format!(
        "#!/bin/bash\n#SBATCH --job-name=densify-{name}\n#SBATCH --cpus-per-task={}\n#SBATCH --mem={}M\n\
         #SBATCH --requeue\n#SBATCH --open-mode=append\n#SBATCH --output=\"{}\"\n",
        if name == "merge" { 1 } else { blocks.threads },
        mebibytes(memory),
        log.display()
    );
    let task = match array {
        Some(places) => {
            let _ = writeln!(text, "#SBATCH --array={places}");
            let names: Vec<&str> = blocks.block.iter().map(|block| &*block.name).collect();
            let _ = writeln!(text, "names=({})", names.join(" "));
            "\"${names[$SLURM_ARRAY_TASK_ID]}\"".to_owned()
        }
        None => blocks.name(tasks[0]).to_owned(),
    };
    let words = command_of(folder, "")?;
    let words: Vec<String> = words[..4].iter().map(|word| quoted(word)).collect();
    let _ = write!(
        text,
        "{} {task}\n\
         code=$?\n\
         # Killed, such as for memory or by its machine: it goes on from its last checkpoint, up to {RESTARTS} times.\n\
         if [ $code -ge 128 ] && [ \"${{SLURM_RESTART_COUNT:-0}}\" -lt {RESTARTS} ]; then\n    \
         scontrol requeue \"$SLURM_JOB_ID\" && sleep 60\n\
         fi\n\
         exit $code\n",
        words.join(" ")
    );
    Ok(EngineFile { path: folder.join("slurm").join(format!("{name}.sh")), text })
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
