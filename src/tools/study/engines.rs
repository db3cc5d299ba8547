//! Submits the runs of a study to an engine: several at once on this machine, or on a cluster with a shared folder.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;

use super::planned_run::PlannedRun;
use super::queue::{Set, Timed};
use densify_launch::{self as launch, Batch, Engine, Job, Stage, Submission, SubmissionArgs, utf8};
use densify_run::Observer;
use densify_run::failure::Failure;

/// Largest number of hours of a study: a year.
const MOST_HOURS: f64 = 8766.0;

/// The engine that trains the runs of a study.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Engine")]
pub struct EngineArgs {
    /// Train several runs at once on this machine (local), or submit them to a scheduler; by default they are
    /// trained one after another. Run the same command again to collect the results of a scheduler. Times are then
    /// comparable only if the machines are alike and run nothing else
    #[arg(long, value_name = "ENGINE")]
    pub engine: Option<Engine>,
    /// Start only what is expected to end within this time, and say before which runs these are; the same command
    /// continues with the rest. Runs that are compared with each other are started together or not at all
    #[arg(long, value_name = "H", value_parser = hours)]
    pub hours: Option<f64>,
    /// Options of the submission.
    #[command(flatten)]
    pub options: SubmissionArgs,
}

/// Reads a number of hours.
fn hours(text: &str) -> Result<f64, String> {
    let hours = text.parse().ok().filter(|hours| *hours > 0.0 && *hours <= MOST_HOURS);
    hours.ok_or_else(|| format!("`{text}` is not a number of hours; write it as 8 or 0.5"))
}

impl EngineArgs {
    pub(super) fn submission(&self) -> Result<Option<Submission>, Failure> {
        match self.engine {
            Some(engine) => self.options.for_engine(engine).map(Some),
            None => self.options.require_none().map(|()| None),
        }
    }

    /// The time of `--hours`.
    pub(super) fn time(&self) -> Result<Option<Duration>, Failure> {
        let Some(hours) = self.hours else { return Ok(None) };
        self.require_here("--hours")?;
        // From Python, the number has not been parsed.
        self::hours(&hours.to_string()).map_err(Failure::input)?;
        Ok(Some(Duration::from_secs_f64(3600.0 * hours)))
    }

    /// Checks that runs are trained on this machine, for options that need it.
    pub(super) fn require_here(&self, flag: &str) -> Result<(), Failure> {
        if self.engine.is_none_or(|engine| engine == Engine::Local) {
            return Ok(());
        }
        Err(Failure::input(format!(
            "{flag} is for runs on this machine; leave it out, or use --engine local"
        )))
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

/// The runs as tasks of an engine. `all` are the study's runs, whose numbers a scheduler shows.
pub(super) fn jobs(sets: &[Set], all: &[PlannedRun]) -> Result<Vec<(Job, PlannedRun)>, Failure> {
    let job = |(run, seconds): &Timed| {
        let spec = run.spec.clone().describe()?;
        let all_threads = || rayon::current_num_threads().try_into().unwrap_or(1);
        let job = Job {
            name: run.name(),
            index: all.iter().position(|other| other.spec == run.spec).unwrap_or(0),
            memory: run.promised_bytes.unwrap_or(0),
            threads: spec.device.threads.map_or_else(all_threads, |threads| threads.0),
            may_have_fewer_threads: false,
            expected: Duration::try_from_secs_f64(*seconds).ok(),
        };
        Ok((job, run.clone()))
    };
    sets.iter().flat_map(|set| &set.runs).map(job).collect()
}

/// Number of these runs that this machine trains at once.
pub(super) fn at_once(sets: &[Set]) -> Result<usize, Failure> {
    let jobs: Vec<Job> = jobs(sets, &[])?.into_iter().map(|(job, _)| job).collect();
    Ok(launch::slots(&jobs))
}

/// Starts or submits the runs. If they were already submitted, reports the jobs instead. `done` and `count` are numbers
/// of runs of the study.
pub(super) fn submit(
    output: &Path,
    mut jobs: Vec<(Job, PlannedRun)>,
    [done, count]: [usize; 2],
    deadline: Option<Instant>,
    submission: Submission,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let folder = std::path::absolute(output).map_err(Failure::input)?;
    observer.say(format_args!("runs     {done} of {count} done"));
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
    if submission.engine != Engine::Local {
        // Schedulers start the tasks of an array in the order of their numbers.
        jobs.sort_by_key(|(job, _)| job.index);
    }
    let inputs = jobs.iter().map(|(_, run)| run.task_file(&folder)).collect::<Result<_, _>>()?;
    let jobs = jobs.into_iter().map(|(job, _)| job).collect();
    let batch = Batch {
        command: ["study-run", utf8(&folder)?].map(str::to_owned).into(),
        stages: vec![Stage { name: "runs", is_array: true, jobs }],
        inputs,
        status: "the output of that process".to_owned(),
        folder,
        deadline,
    };
    launch::submit(&batch, submission, observer)?;
    if is_scheduled {
        observer.say(format_args!("run the same command again to collect the results"));
    }
    Ok(())
}
