//! The runs of a study as tasks of an engine: several at once here, or on a cluster whose machines share the folder.

use std::path::{Path, PathBuf};

use clap::Args;

use super::cell::Cell;
use densify_launch as launch;
use densify_launch::{Batch, Engine, Job, Stage, Submission, SubmissionArgs, utf8};
use densify_run::failure::Failure;
use densify_run::{Host, Observer, Partial, RunSpec, host_bytes};

/// Who makes the runs of a study.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Engine")]
pub struct EngineArgs {
    /// What makes the runs, instead of one after another: this machine, several at once, or a scheduler, to which
    /// they are handed in; the same command, called again, collects what is done. Then times compare only if the
    /// machines are alike and nothing else runs on them
    #[arg(long, value_name = "ENGINE")]
    engine: Option<Engine>,
    #[command(flatten)]
    more: SubmissionArgs,
}

impl EngineArgs {
    pub(super) fn submission(&self) -> Result<Option<Submission>, Failure> {
        match self.engine {
            Some(engine) => self.more.for_engine(engine).map(Some),
            None => self.more.require_none().map(|()| None),
        }
    }
}

/// Makes one run of a study: engines call this.
#[derive(Debug, Args)]
pub struct StudyRun {
    /// Folder of the study
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Name of the run
    #[arg(value_name = "RUN")]
    name: String,
}

impl StudyRun {
    /// Makes the run.
    ///
    /// # Errors
    /// When the description of the run cannot be read, or the run fails.
    pub fn make(&self) -> Result<(), Failure> {
        Cell::read(&self.folder, &self.name)?.make(&self.folder)
    }
}

/// Starts the runs that are not done, or hands them in; says how far they are where that was done before.
pub(super) fn submit(
    output: &Path,
    cells: &[Cell],
    is_done: impl Fn(&Cell) -> bool,
    submission: Submission,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let folder = std::path::absolute(output).map_err(Failure::input)?;
    let open: Vec<&Cell> = cells.iter().filter(|cell| !is_done(cell)).collect();
    observer.say(format_args!("runs     {} of {} done", cells.len() - open.len(), cells.len()));
    let is_handed_in = !matches!(submission.engine, Engine::Local) && !submission.dry_run;
    if let Some(jobs) =
        launch::submitted_jobs(&folder).filter(|_| is_handed_in && !submission.again)
    {
        observer.say(format_args!(
            "handed in before, as job {jobs}: call again when that has ended, with --again if it has failed (logs in {})",
            folder.join("logs").display()
        ));
        return Ok(());
    }
    let mut memory: Vec<(Partial, u64)> = Vec::new();
    let mut jobs: Vec<Job> = Vec::new();
    let mut described: Vec<&Partial> = Vec::new();
    for (index, cell) in cells.iter().enumerate() {
        // What several cells describe alike is one run.
        if is_done(cell) || described.contains(&&cell.spec) {
            continue;
        }
        described.push(&cell.spec);
        let spec = cell.spec.clone().describe()?;
        if !submission.dry_run {
            cell.write(&folder)?;
        }
        jobs.push(Job {
            name: cell.run(),
            index,
            memory: promised(cell, &spec, &mut memory)?,
            threads: threads(&spec),
            may_have_fewer_threads: false,
        });
    }
    let batch = Batch {
        command: ["study-run", utf8(&folder)?].map(str::to_owned).into(),
        stages: vec![Stage { name: "runs", is_array: true, jobs }],
        status: "what the same command says".to_owned(),
        folder,
    };
    launch::submit(&batch, submission, observer)?;
    if is_handed_in {
        observer.say(format_args!("call the same command again to collect what is done"));
    }
    Ok(())
}

/// What a run takes at most `[bytes]`, which does not depend on its seed.
fn promised(cell: &Cell, spec: &RunSpec, known: &mut Vec<(Partial, u64)>) -> Result<u64, Failure> {
    let mut kind = cell.spec.clone();
    kind.remove("seed");
    if let Some((_, bytes)) = known.iter().find(|(other, _)| *other == kind) {
        return Ok(*bytes);
    }
    let bytes = host_bytes(spec, Host::default())?;
    known.push((kind, bytes));
    Ok(bytes)
}

/// Processor threads of a run: those that were asked for, or all.
fn threads(spec: &RunSpec) -> u32 {
    let own = spec.device.threads.map(|threads| threads.0);
    own.unwrap_or_else(|| rayon::current_num_threads().try_into().unwrap_or(1))
}
