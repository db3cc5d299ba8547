//! Studies: many runs of `densify train` in processes of their own, a journal that lets an interrupted
//! study go on, paired statistics, tables and plots.
//!
//! A study is a list of descriptions of runs, and a report over their outcomes. [`Comparison`] varies
//! policy and budget, [`Trade`] knobs and their levels. Nothing is printed; an [`Observer`] hears what
//! there is to say.

mod cell;
mod child;
mod columns;
mod compare;
pub mod difference;
mod engines;
mod journal;
pub mod panel;
mod plot;
mod record;
mod trade;
pub mod window;

use std::path::{Path, PathBuf};

pub use compare::Comparison;
pub use engines::{EngineArgs, StudyRun};
pub use trade::Trade;

use cell::Cell;
use densify_core::files::write_atomically;
use densify_data::dataset::builtin;
use densify_html::{Document, data_uri_of_file};
use densify_run::Observer;
use densify_run::failure::Failure;
use journal::Journal;
use record::Outcome;

/// What a finished study leaves.
#[derive(Debug)]
pub struct Finished {
    /// A few lines for the terminal.
    pub summary: String,
    /// The file with tables and pictures.
    pub report: PathBuf,
}

/// A file in the output folder, and what it shows.
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
    /// Begins or goes on, with the journal `name`.jsonl in the folder `output`.
    fn open(output: &'a Path, name: &str, observer: &'a dyn Observer) -> Result<Self, Failure> {
        let journal = Journal::open(&output.join(name).with_extension("jsonl"))?;
        Ok(Self { output, observer, journal })
    }

    /// Makes the runs that are not done yet, one after another or by an engine; returns the outcomes of all,
    /// or `None` where not all are done, as a scheduler has them. Where several cells describe the same run,
    /// it is made once: the seed decides everything.
    fn run(
        &mut self,
        cells: &[Cell],
        engine: &EngineArgs,
    ) -> Result<Option<Vec<Outcome>>, Failure> {
        let submission = engine.submission()?;
        let is_left = self.collect(cells)?;
        if let Some(submission) = submission
            && is_left
        {
            let is_done = |cell: &Cell| self.journal.outcome(&cell.spec).is_some();
            engines::submit(self.output, cells, is_done, submission, self.observer)?;
            if self.collect(cells)? {
                return Ok(None);
            }
        }
        let count = cells.len();
        let mut outcomes = Vec::new();
        for (i, cell) in cells.iter().enumerate() {
            let number = i + 1;
            let before = self.journal.outcome(&cell.spec).cloned();
            let done = if before.is_some() { ": done before" } else { "" };
            self.observer.say(format_args!("[{number}/{count}] {cell}{done}"));
            let outcome = match before {
                Some(outcome) => outcome,
                None => {
                    let outcome = cell.train(self.output)?;
                    self.journal.add(outcome.clone())?;
                    outcome
                }
            };
            let (factor, level) = (cell.factor.clone(), cell.level.clone());
            outcomes.push(Outcome { factor, level, ..outcome });
        }
        Ok(Some(outcomes))
    }

    /// Takes the records of runs that an engine has made into the journal; whether runs are left.
    fn collect(&mut self, cells: &[Cell]) -> Result<bool, Failure> {
        let mut is_left = false;
        for cell in cells {
            if self.journal.outcome(&cell.spec).is_none() {
                match cell.made(self.output) {
                    Some(outcome) => self.journal.add(outcome)?,
                    None => is_left = true,
                }
            }
        }
        Ok(is_left)
    }

    /// Writes the report as `name`.md, and as `name`.html with embedded pictures.
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

/// Distinct values, in the order of their appearance.
fn distinct<T: PartialEq>(values: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut all = Vec::new();
    for value in values {
        if !all.contains(&value) {
            all.push(value);
        }
    }
    all
}

/// A short name for each scene: its folder's, or that of the built-in scene.
fn labels(scenes: &[PathBuf]) -> Result<Vec<String>, Failure> {
    let mut labels = Vec::new();
    for scene in scenes {
        if let Some(name) = builtin::label(scene) {
            labels.push(unless_taken(&labels, name)?);
            continue;
        }
        let whole = std::fs::canonicalize(scene).map_err(|e| {
            Failure::input(format!("{}: {e}; name the scene's folder", scene.display()))
        })?;
        let name = whole.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let name = name.replace(|c: char| !c.is_ascii_alphanumeric() && c != '.', "-");
        labels.push(unless_taken(&labels, name)?);
    }
    Ok(labels)
}

/// The name, if it is none of those that are taken.
fn unless_taken(taken: &[String], name: String) -> Result<String, Failure> {
    if taken.contains(&name) {
        return Err(Failure::input(format!(
            "two scenes are called {name}; take them in two calls, or rename one folder"
        )));
    }
    Ok(name)
}
