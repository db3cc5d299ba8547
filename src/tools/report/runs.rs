//! Reads the folders of runs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::ReportOptions;
use densify_run::failure::Failure;
use densify_run::finished::{is_model, iteration_so_far, names_of};
use densify_run::{Observer, Reductions, RunConfig};
use densify_train::evaluate::Mean;
use densify_train::metrics::geometry::Geometry;
use densify_train::output::{
    StepRecord, Summary, all_scores, events_of, geometry_of, psnr_by_view, steps_of, summary_of,
};
use densify_train::trainer::EditEvent;

/// The contents of a run's folder.
pub(super) struct RunRecord {
    pub(super) folder: PathBuf,
    /// The folder's name, with parent folders where needed to make it unique.
    pub(super) name: String,
    pub(super) config: RunConfig,
    /// Iteration of the model in the report.
    pub(super) iteration: u32,
    /// True while the run is in training.
    pub(super) is_training: bool,
    /// The summary written at the end; `None` during training, when the file may be left from an earlier stop.
    pub(super) summary: Option<Summary>,
    pub(super) steps: Vec<StepRecord>,
    pub(super) events: Vec<EditEvent>,
    /// The automatic reductions, once the run has ended.
    pub(super) reductions: Option<Reductions>,
    /// Mean scores of the test views by iteration.
    pub(super) scores: BTreeMap<u32, Mean>,
    /// PSNR of the model in the report for each test view, by the view's name `[dB]`.
    pub(super) by_view: BTreeMap<String, f64>,
    pub(super) geometry: Option<Geometry>,
}

impl RunRecord {
    /// Reads all runs in the given order.
    pub(super) fn read_all(
        options: &ReportOptions<'_>,
        observer: &dyn Observer,
    ) -> Result<Vec<Self>, Failure> {
        let mut canonical: Vec<PathBuf> = Vec::new();
        for run in options.runs {
            let place = run.canonicalize().unwrap_or_else(|_| run.clone());
            if canonical.contains(&place) {
                let run = run.display();
                return Err(Failure::input(format!("{run} is named twice; name it once")));
            }
            canonical.push(place);
        }
        let names = names_of(&canonical.iter().map(PathBuf::as_path).collect::<Vec<_>>());
        let named = options.runs.iter().zip(names);
        named.map(|(run, name)| Self::read(run, name, options.iteration, observer)).collect()
    }

    fn read(
        folder: &Path,
        name: String,
        iteration: Option<u32>,
        observer: &dyn Observer,
    ) -> Result<Self, Failure> {
        if is_model(folder) {
            let folder = folder.display();
            return Err(Failure::input(format!(
                "{folder} is a model, and a report is about runs: name the folder that `densify train` wrote"
            )));
        }
        let config = RunConfig::read(folder)?;
        let (iteration, is_training) = iteration_so_far(folder, iteration, observer)?;
        Ok(Self {
            folder: folder.to_owned(),
            name,
            config,
            iteration,
            is_training,
            summary: if is_training { None } else { summary_of(folder)? },
            steps: steps_of(folder)?,
            events: events_of(folder)?,
            reductions: if is_training { None } else { Reductions::read(folder)? },
            scores: all_scores(folder)?,
            by_view: psnr_by_view(folder, iteration)?,
            geometry: geometry_of(folder, iteration)?,
        })
    }

    /// The scores of the model in the report, if it was evaluated.
    pub(super) fn score(&self) -> Option<Mean> {
        self.scores.get(&self.iteration).copied()
    }

    /// Number of Gaussians at the end, or so far.
    pub(super) fn rows(&self) -> Option<usize> {
        let so_far = self.steps.last().map(|step| step.rows);
        self.summary.as_ref().map(|summary| summary.rows).or(so_far)
    }

    /// Peak resident memory `[bytes]`, if known.
    pub(super) fn peak_bytes(&self) -> Option<u64> {
        let so_far = self.steps.iter().filter_map(|step| step.resident_bytes).max();
        self.summary.as_ref().and_then(|summary| summary.peak_bytes).or(so_far)
    }

    /// Wall time of all steps `[s]`, if known.
    pub(super) fn seconds(&self) -> Option<f64> {
        let so_far = self.steps.last().map(|step| step.seconds);
        self.summary.as_ref().map(|summary| summary.seconds).or(so_far)
    }
}
