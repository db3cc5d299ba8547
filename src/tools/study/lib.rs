//! Studies: many runs of `densify train` in child processes, paired statistics, tables and plots. A journal of finished
//! runs lets an interrupted study continue.
//!
//! A study is a list of planned runs and a report on their outcomes. [`Comparison`] varies the policy and the budget,
//! [`Trade`] the knobs. Prints nothing; messages go to an [`Observer`].

mod compare;
pub mod difference;
mod engines;
mod journal;
mod outcome;
pub mod panel;
mod planned_run;
mod plot;
mod process;
mod text_table;
mod trade;
pub mod window;

use std::path::{Path, PathBuf};

pub use compare::{Comparison, SceneBudget};
pub use engines::{EngineArgs, StudyRun};
pub use trade::Trade;

use densify_core::files::write_atomically;
use densify_data::dataset::builtin;
use densify_html::{Document, data_uri_of_file};
use densify_run::failure::Failure;
use densify_run::{Observer, Partial};
use journal::Journal;
use outcome::Outcome;
use planned_run::PlannedRun;

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
    observer: &'a dyn Observer,
    journal: Journal,
}

impl<'a> Study<'a> {
    /// Starts or continues the study with the journal `name`.jsonl in the folder `output`.
    fn open(output: &'a Path, name: &str, observer: &'a dyn Observer) -> Result<Self, Failure> {
        let journal = Journal::open(&output.join(name).with_extension("jsonl"))?;
        Ok(Self { output, observer, journal })
    }

    /// Trains the runs that are not done yet, one after another or with an engine, and returns all outcomes; `None`
    /// while a scheduler still has unfinished runs. Runs with the same description are trained once, as training is
    /// reproducible.
    fn run(
        &mut self,
        runs: &[PlannedRun],
        engine: &EngineArgs,
    ) -> Result<Option<Vec<Outcome>>, Failure> {
        let submission = engine.submission()?;
        let has_unfinished = self.collect(runs)?;
        if let Some(submission) = submission
            && has_unfinished
        {
            let is_done = |run: &PlannedRun| self.journal.outcome(&run.spec).is_some();
            engines::submit(self.output, runs, is_done, submission, self.observer)?;
            if self.collect(runs)? {
                return Ok(None);
            }
        }
        let count = runs.len();
        let mut outcomes = Vec::new();
        for (index, run) in runs.iter().enumerate() {
            let number = index + 1;
            let known = self.journal.outcome(&run.spec).cloned();
            let done = if known.is_some() { ": done before" } else { "" };
            self.observer.say(format_args!("[{number}/{count}] {run}{done}"));
            let outcome = match known {
                Some(outcome) => outcome,
                None => {
                    let outcome = run.train(self.output)?;
                    self.journal.add(outcome.clone())?;
                    outcome
                }
            };
            let (factor, level) = (run.factor.clone(), run.level.clone());
            outcomes.push(Outcome { factor, level, ..outcome });
        }
        Ok(Some(outcomes))
    }

    /// Adds the outcomes of runs that an engine has finished to the journal. Returns true if some runs are unfinished.
    fn collect(&mut self, runs: &[PlannedRun]) -> Result<bool, Failure> {
        let mut has_unfinished = false;
        for run in runs {
            if self.journal.outcome(&run.spec).is_none() {
                match run.recorded(self.output) {
                    Some(outcome) => self.journal.add(outcome)?,
                    None => has_unfinished = true,
                }
            }
        }
        Ok(has_unfinished)
    }

    /// Writes the report as `name`.md and as `name`.html with embedded pictures.
    fn finish(
        &self,
        name: &str,
        document: &Document,
        summary: String,
    ) -> Result<Finished, Failure> {
        let report = self.output.join(name).with_extension("md");
        write_atomically(&report, |out| write!(out, "{document}"))?;
        let page = document.to_html(|file| data_uri_of_file(&self.output.join(file)))?;
        write_atomically(&report.with_extension("html"), |out| out.write_all(page.as_bytes()))?;
        Ok(Finished { summary, report })
    }
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
            "--{} is set by the study itself; leave it out after `--`",
            name.replace('_', "-")
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
