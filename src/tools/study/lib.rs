//! Studies: many runs of `densify train` in child processes, paired statistics, tables and plots. A journal of finished
//! runs lets an interrupted study continue.
//!
//! A study is a list of planned runs and a report on their outcomes. [`Comparison`] varies the policy and the budget,
//! [`Trade`] the knobs. Prints nothing; messages go to an [`Observer`].

mod compare;
pub mod difference;
mod engines;
mod estimate;
mod journal;
mod limit;
mod outcome;
pub mod panel;
mod planned_run;
mod plot;
mod process;
mod queue;
mod sequential;
mod spread;
mod text_table;
mod trade;
pub mod window;

use std::collections::{BTreeSet, VecDeque};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

pub use compare::{Comparison, Decide, SceneLimit};
pub use engines::{EngineArgs, StudyRun};
pub use trade::Trade;

use densify_core::files::{FileError, write_atomically};
use densify_core::memory::Bytes;
use densify_core::numbers::{counted, duration};
use densify_data::dataset::builtin;
use densify_html::{Document, data_uri_of_file};
use densify_launch::Engine;
use densify_run::failure::Failure;
use densify_run::{MemoryLimit, Observer, Partial, check_interrupt, grant};
use densify_train::output::FolderLock;
use estimate::{Extents, estimate};
use journal::Journal;
pub use limit::Limit;
use outcome::Outcome;
use planned_run::PlannedRun;
use queue::{Set, Timed};

/// A finished study.
#[derive(Debug)]
pub struct Finished {
    /// Summary for the terminal.
    pub summary: String,
    /// File with the tables and pictures.
    pub report: PathBuf,
}

/// A picture file in the output folder.
struct Picture {
    file: String,
    caption: String,
}

/// A study in progress.
struct Study<'a> {
    output: &'a Path,
    name: &'a str,
    engine: &'a EngineArgs,
    observer: &'a dyn Observer,
    journal: Journal,
    extents: Extents,
    /// When the hours are over, if there is a limit.
    deadline: Option<Instant>,
    /// Held from the first run that is trained here, so that no other study trains in the same folder.
    lock: Option<FolderLock>,
}

/// The runs of a study that are done, and those that are not.
#[derive(Default)]
struct Ran {
    outcomes: Vec<Outcome>,
    /// Sets of runs that did not fit into the hours.
    left: Vec<Set>,
}

impl<'a> Study<'a> {
    /// Starts or continues the study with the journal `name`.jsonl in the folder `output`. Hours count from here.
    fn open(
        output: &'a Path,
        name: &'a str,
        engine: &'a EngineArgs,
        observer: &'a dyn Observer,
    ) -> Result<Self, Failure> {
        let journal = Journal::open(&output.join(name).with_extension("jsonl"))?;
        let deadline = engine.time()?.map(|time| Instant::now() + time);
        let extents = Extents::default();
        Ok(Self { output, name, engine, observer, journal, extents, deadline, lock: None })
    }

    /// Trains the runs that are not done yet, one after another or with an engine, and returns all outcomes; `None`
    /// while a scheduler still has unfinished runs. Runs with the same description are trained once, as training is
    /// reproducible.
    fn run(&mut self, runs: &[PlannedRun]) -> Result<Option<Ran>, Failure> {
        let submission = self.engine.submission()?;
        self.collect(runs)?;
        let (mut sets, mut left) = (self.plan(runs)?, Vec::new());
        let is_dry = submission.is_some_and(|submission| submission.dry_run);
        let is_here = submission.is_none_or(|submission| submission.engine == Engine::Local);
        if !is_dry && !sets.is_empty() {
            self.check_folders(&sets)?;
            if is_here {
                self.take_lock()?;
                require_memory(&sets)?;
                (sets, left) = self.divide(sets, submission.is_some())?;
            }
        }
        if let Some(submission) = submission
            && !sets.is_empty()
        {
            let done = runs.iter().filter(|run| self.outcome_of(run).is_some()).count();
            let jobs = engines::jobs(&sets, runs)?;
            let counts = [done, runs.len()];
            let deadline = self.deadline;
            engines::submit(self.output, jobs, counts, deadline, submission, self.observer)?;
            self.collect(runs)?;
            sets.retain(|set| set.runs.iter().any(|(run, _)| self.outcome_of(run).is_none()));
            if !is_here || is_dry {
                if !sets.is_empty() {
                    return Ok(None);
                }
            } else {
                left.append(&mut sets);
            }
        }
        self.train(runs, sets, &mut left)?;
        let outcome = |run: &PlannedRun| {
            let (factor, level) = (run.factor.clone(), run.level.clone());
            Some(Outcome { factor, level, ..self.outcome_of(run)?.clone() })
        };
        let outcomes: Vec<Outcome> = runs.iter().filter_map(outcome).collect();
        Ok(Some(Ran { outcomes, left }))
    }

    fn outcome_of(&self, run: &PlannedRun) -> Option<&Outcome> {
        self.journal.outcome(&run.spec)
    }

    /// Estimated time of the unfinished runs, one after another `[s]`.
    fn seconds_of(&mut self, runs: &[PlannedRun]) -> Result<f64, Failure> {
        Ok(self.plan(runs)?.iter().map(Set::seconds).sum())
    }

    /// The unfinished runs with their estimated times, in the order of training.
    fn plan(&mut self, runs: &[PlannedRun]) -> Result<Vec<Set>, Failure> {
        let mut timed: Vec<(PlannedRun, f64)> = Vec::new();
        for run in runs {
            let is_known = |(other, _): &(PlannedRun, f64)| other.spec == run.spec;
            if self.outcome_of(run).is_none() && !timed.iter().any(is_known) {
                let mut run = run.clone();
                self.extents.measure(&mut run)?;
                let seconds = estimate(&run, self.journal.outcomes()).seconds;
                timed.push((run, seconds));
            }
        }
        Ok(queue::in_order(timed))
    }

    /// Checks that no run would replace a finished one of another study.
    fn check_folders(&self, sets: &[Set]) -> Result<(), Failure> {
        for (run, _) in sets.iter().flat_map(|set| &set.runs) {
            let other = self.journal.other_run(&run.name(), &run.spec);
            let folder = run.folder_in(self.output);
            let Some(other) = other.filter(|_| folder.exists()) else { continue };
            let spec = run.spec.clone().into_table();
            let names: BTreeSet<&String> = spec.keys().chain(other.spec.keys()).collect();
            let differs =
                |name: &&&String| spec.get(name.as_str()) != other.spec.get(name.as_str());
            let options = names.iter().filter(differs).map(|name| option_word(name));
            return Err(Failure::input(format!(
                "{} has a finished run of another study, with other options ({}); choose another \
                 --output, or move that folder away",
                folder.display(),
                options.collect::<Vec<_>>().join(", ")
            )));
        }
        Ok(())
    }

    /// Locks the folder, so that no other study trains in it at the same time.
    fn take_lock(&mut self) -> Result<(), Failure> {
        if self.lock.is_none() {
            let folder = self.output;
            fs::create_dir_all(folder).map_err(FileError::io("create the folder", folder))?;
            self.lock = Some(FolderLock::take(folder)?);
        }
        Ok(())
    }

    /// Says how long the runs are going to take, and divides them into those that fit the hours and those that do not.
    ///
    /// # Errors
    /// When nothing fits, and nothing is done that could be reported.
    fn divide(&self, sets: Vec<Set>, has_engine: bool) -> Result<(Vec<Set>, Vec<Set>), Failure> {
        let at_once = if has_engine { engines::at_once(&sets)? } else { 1 };
        let runs = || sets.iter().flat_map(|set| &set.runs);
        let estimates = runs().map(|(run, _)| estimate(run, self.journal.outcomes()));
        let is_measured = estimates.into_iter().all(|estimate| estimate.is_measured);
        let total = queue::total_seconds(&sets, at_once);
        // The first of several that are equal.
        let longest = runs().reduce(|a, b| if b.1 > a.1 { b } else { a });
        self.observer.say(format_args!(
            "estimate {} in {}{}; the longest, {}",
            counted(runs().count(), "run"),
            about(total),
            if is_measured { "" } else { " (rough, until a run is measured)" },
            longest
                .map_or_else(String::new, |(run, seconds)| format!("{run}: {}", about(*seconds)))
        ));
        let Some(deadline) = self.deadline else { return Ok((sets, Vec::new())) };
        let seconds = deadline.saturating_duration_since(Instant::now()).as_secs_f64();
        let shortest = sets.iter().map(Set::seconds).fold(f64::INFINITY, f64::min);
        let (fit, left) = queue::divide(sets, seconds, at_once);
        if fit.is_empty() && self.journal.outcomes().next().is_none() {
            return Err(Failure::input(format!(
                "--hours {}: nothing fits; the shortest set of paired runs takes {}: give at least \
                 --hours {:.2}",
                self.engine.hours.unwrap_or_default(),
                about(shortest),
                // Rounded up, and with a tenth more.
                (110.0 * shortest / 3600.0).ceil() / 100.0
            )));
        }
        let line = |word: &str, sets: &[Set]| {
            if !sets.is_empty() {
                self.observer.say(format_args!("{word:<8} {}", queue::names(sets)));
            }
        };
        line("fits", &fit);
        line("too long", &left);
        Ok((fit, left))
    }

    /// Trains the sets one after another, as long as the hours last; those for which they do not go to `left`.
    fn train(
        &mut self,
        runs: &[PlannedRun],
        sets: Vec<Set>,
        left: &mut Vec<Set>,
    ) -> Result<(), Failure> {
        let count = runs.len();
        let mut number = 0;
        for run in runs.iter().filter(|run| self.outcome_of(run).is_some()) {
            number += 1;
            self.observer.say(format_args!("[{number}/{count}] {run}: done before"));
        }
        let mut waiting: VecDeque<Set> = sets.into();
        while let Some(set) = waiting.pop_front() {
            for at in 0..set.runs.len() {
                check_interrupt(self.observer)?;
                let seconds = |(run, _): &Timed| estimate(run, self.journal.outcomes()).seconds;
                let rest: f64 = set.runs[at..].iter().map(seconds).sum();
                if self.deadline.is_some_and(|deadline| !ends_before(deadline, rest)) {
                    left.push(Set { runs: set.runs[at..].to_vec() });
                    break;
                }
                number += 1;
                let run = &set.runs[at].0;
                let others = waiting.iter().flat_map(|set| &set.runs).map(seconds).sum::<f64>();
                self.observer.say(format_args!(
                    "[{number}/{count}] {run}: {}; {} for all that is left",
                    about(seconds(&set.runs[at])),
                    about(rest + others)
                ));
                let outcome = run.train(self.output)?;
                self.journal.add(outcome)?;
            }
        }
        if !left.is_empty() {
            let seconds = |(run, _): &Timed| estimate(run, self.journal.outcomes()).seconds;
            let total: f64 = left.iter().flat_map(|set| &set.runs).map(seconds).sum();
            self.observer.say(format_args!(
                "left     {} ({}): the same command goes on, with --hours for it",
                queue::names(left),
                about(total)
            ));
        }
        Ok(())
    }

    /// Adds the outcomes of finished runs that are not in the journal: of those that an engine has started, and of those
    /// whose line could not be written.
    fn collect(&mut self, runs: &[PlannedRun]) -> Result<(), Failure> {
        for run in runs {
            if self.outcome_of(run).is_none()
                && let Some(outcome) =
                    run.recorded(self.output).or_else(|| run.finished(self.output))
            {
                self.journal.add(outcome)?;
            }
        }
        Ok(())
    }

    /// Writes the report as Markdown and as HTML, with embedded pictures.
    fn finish(&self, document: &Document, summary: String) -> Result<Finished, Failure> {
        let report = self.output.join(self.name).with_extension("md");
        write_atomically(&report, |out| write!(out, "{document}"))?;
        let page = document.to_html(|file| data_uri_of_file(&self.output.join(file)))?;
        write_atomically(&report.with_extension("html"), |out| out.write_all(page.as_bytes()))?;
        Ok(Finished { summary, report })
    }
}

/// Checks that the system has the memory for every run.
fn require_memory(sets: &[Set]) -> Result<(), Failure> {
    let runs = sets.iter().flat_map(|set| &set.runs).map(|(run, _)| run);
    let Some(largest) = runs.max_by_key(|run| run.promised_bytes) else { return Ok(()) };
    let needed = largest.promised_bytes.unwrap_or(0);
    match grant(rayon::current_num_threads()).filter(|limit| limit.left < needed) {
        Some(MemoryLimit { left, name }) => Err(Failure::input(format!(
            "the run {largest} takes up to {}, but {name} leaves {}; lower the largest --budget, or \
             shrink the images with -r 2 after `--`; no run was started",
            Bytes(needed),
            Bytes(left)
        ))),
        None => Ok(()),
    }
}

/// True if something that takes so long `[s]` ends before the deadline.
fn ends_before(deadline: Instant, seconds: f64) -> bool {
    deadline.saturating_duration_since(Instant::now()).as_secs_f64() >= seconds
}

/// An estimated time for the user, as `about 2 min 5 s`.
fn about(seconds: f64) -> String {
    // A time that is beyond all bounds is shown as a century.
    let seconds = seconds.clamp(0.0, 3.2e9);
    format!("about {}", duration(Duration::from_secs_f64(seconds)))
}

/// The spelling of an option on the command line.
fn option_word(name: &str) -> String {
    format!("--{}", name.replace('_', "-"))
}

/// Standard error of the mean; `None` for fewer than two values.
fn standard_error(values: &[f64]) -> Option<f64> {
    let n = values.len() as f64;
    let mean = difference::mean(values.iter().copied()).filter(|_| values.len() > 1)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    Some((squares / (n - 1.0) / n).sqrt())
}

/// The options that all runs of a study share: those of the user, with test views held out and without checkpoints. An
/// interrupted run starts over, so that its times are complete.
fn shared_options(given: Partial, set_by_study: &[&str]) -> Result<Partial, Failure> {
    if let Some((name, _)) = given.iter().find(|(name, _)| set_by_study.contains(name)) {
        return Err(Failure::input(format!(
            "{} is set by the study itself; leave it out after `--`",
            option_word(name)
        )));
    }
    let mut defaults = Partial::option("checkpoint_every", 0);
    if given.get("test_every").is_none() {
        defaults = Partial::option("eval", true).over(defaults);
    }
    Ok(given.over(defaults))
}

/// Distinct values in the order of their first appearance.
fn distinct<T: PartialEq>(values: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut all = Vec::new();
    for value in values {
        if !all.contains(&value) {
            all.push(value);
        }
    }
    all
}

/// A short name for each scene: that of its folder or of the built-in scene.
fn labels(scenes: &[PathBuf]) -> Result<Vec<String>, Failure> {
    let mut labels = Vec::new();
    for scene in scenes {
        let label = match builtin::label(scene) {
            Some(label) => label,
            None => {
                let path = scene.canonicalize().map_err(|e| {
                    Failure::input(format!("{}: {e}; name the scene's folder", scene.display()))
                })?;
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                name.replace(|c: char| !c.is_ascii_alphanumeric() && c != '.', "-")
            }
        };
        if labels.contains(&label) {
            return Err(Failure::input(format!(
                "two scenes are called {label}; study them separately, or rename one folder"
            )));
        }
        labels.push(label);
    }
    Ok(labels)
}
