//! Submits the runs of a study to an engine: several at once on this machine, or on a cluster with a shared folder.

use std::path::{Path, PathBuf};

use clap::Args;

use super::planned_run::PlannedRun;
use densify_launch::{self as launch, Batch, Engine, Job, Stage, Submission, SubmissionArgs, utf8};
use densify_run::failure::Failure;
use densify_run::{Host, Observer, Partial, RunSpec, host_bytes};

/// The engine that trains the runs of a study.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Engine")]
pub struct EngineArgs {
    /// Train several runs at once on this machine (local), or submit them to a scheduler; by default they are
    /// trained one after another. Run the same command again to collect the results of a scheduler. Times are then
    /// comparable only if the machines are alike and run nothing else
    #[arg(long, value_name = "ENGINE")]
    engine: Option<Engine>,
    #[command(flatten)]
    options: SubmissionArgs,
}

impl EngineArgs {
    pub(super) fn submission(&self) -> Result<Option<Submission>, Failure> {
        match self.engine {
            Some(engine) => self.options.for_engine(engine).map(Some),
            None => self.options.require_none().map(|()| None),
        }
    }
}

/// Trains one run of a study; engines call this.
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
    /// Trains the run.
    ///
    /// # Errors
    /// If the description of the run cannot be read, or the run fails.
    pub fn train(&self) -> Result<(), Failure> {
        PlannedRun::read(&self.folder, &self.name)?.train_and_record(&self.folder)
    }
}

/// Starts or submits the runs that are not done. If they were already submitted, reports the jobs instead.
pub(super) fn submit(
    output: &Path,
    runs: &[PlannedRun],
    is_done: impl Fn(&PlannedRun) -> bool,
    submission: Submission,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let folder = std::path::absolute(output).map_err(Failure::input)?;
    let done = runs.iter().filter(|run| is_done(run)).count();
    observer.say(format_args!("runs     {done} of {} done", runs.len()));
    let is_scheduled = !matches!(submission.engine, Engine::Local) && !submission.dry_run;
    if is_scheduled
        && !submission.again
        && let Some(jobs) = launch::submitted_jobs(&folder)
    {
        observer.say(format_args!(
            "already submitted as job {jobs}: run this command again when the job has ended, with \
            --again if it has failed (logs in {})",
            folder.join("logs").display()
        ));
        return Ok(());
    }
    let mut known_memory: Vec<(Partial, u64)> = Vec::new();
    let mut jobs: Vec<Job> = Vec::new();
    let mut submitted: Vec<&Partial> = Vec::new();
    let mut inputs = Vec::new();
    for (index, run) in runs.iter().enumerate() {
        // Runs with the same description are trained once.
        if is_done(run) || submitted.contains(&&run.spec) {
            continue;
        }
        submitted.push(&run.spec);
        inputs.push(run.task_file(&folder)?);
        let spec = run.spec.clone().describe()?;
        let all_threads = || rayon::current_num_threads().try_into().unwrap_or(1);
        jobs.push(Job {
            name: run.name(),
            index,
            memory: promised_bytes(run, &spec, &mut known_memory)?,
            threads: spec.device.threads.map_or_else(all_threads, |threads| threads.0),
            may_have_fewer_threads: false,
        });
    }
    let batch = Batch {
        command: ["study-run", utf8(&folder)?].map(str::to_owned).into(),
        stages: vec![Stage { name: "runs", is_array: true, jobs }],
        inputs,
        status: "the output of that process".to_owned(),
        folder,
    };
    launch::submit(&batch, submission, observer)?;
    if is_scheduled {
        observer.say(format_args!("run the same command again to collect the results"));
    }
    Ok(())
}

/// Upper bound of a run's memory `[bytes]`. It does not depend on the seed, so it is computed once for all seeds.
fn promised_bytes(
    run: &PlannedRun,
    spec: &RunSpec,
    known: &mut Vec<(Partial, u64)>,
) -> Result<u64, Failure> {
    let mut options = run.spec.clone();
    options.remove("seed");
    if let Some((_, bytes)) = known.iter().find(|(other, _)| *other == options) {
        return Ok(*bytes);
    }
    let bytes = host_bytes(spec, Host::default())?;
    known.push((options, bytes));
    Ok(bytes)
}
