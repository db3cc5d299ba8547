//! What the folder of a run says.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::Wanted;
use densify_run::failure::Failure;
use densify_run::finished::{is_model, iteration_so_far, names_of};
use densify_run::{Observer, Reductions, RunConfig};
use densify_train::evaluate::Mean;
use densify_train::metrics::geometry::Geometry;
use densify_train::output::{
    StepRecord, Summary, all_scores, events_of, geometry_of, psnr_by_view, steps_of, summary_of,
};
use densify_train::trainer::EditEvent;

/// A run, as its folder tells it.
pub(super) struct Told {
    pub(super) folder: PathBuf,
    /// The folder's name, with as much of what is above as tells it from others.
    pub(super) name: String,
    pub(super) config: RunConfig,
    /// Of the model that is shown.
    pub(super) iteration: u32,
    /// Whether it is being trained.
    pub(super) trains: bool,
    /// What it says at its end; not while it trains, as it may be that of an earlier stop.
    pub(super) summary: Option<Summary>,
    pub(super) steps: Vec<StepRecord>,
    pub(super) events: Vec<EditEvent>,
    /// What was left out automatically, once the run has ended.
    pub(super) reductions: Option<Reductions>,
    /// Mean scores on the test views by iteration.
    pub(super) scores: BTreeMap<u32, Mean>,
    /// PSNR of the test views with this model, by name `[dB]`.
    pub(super) by_view: BTreeMap<String, f64>,
    pub(super) geometry: Option<Geometry>,
}

impl Told {
    /// Reads all runs, in the order in which they are named.
    pub(super) fn read_all(
        wanted: &Wanted<'_>,
        observer: &dyn Observer,
    ) -> Result<Vec<Self>, Failure> {
        let mut whole: Vec<PathBuf> = Vec::new();
        for run in wanted.runs {
            let place = run.canonicalize().unwrap_or_else(|_| run.clone());
            if whole.contains(&place) {
                let run = run.display();
                return Err(Failure::input(format!("{run} is named twice; name it once")));
            }
            whole.push(place);
        }
        let names = names_of(&whole.iter().map(PathBuf::as_path).collect::<Vec<_>>());
        let told = wanted.runs.iter().zip(names);
        told.map(|(run, name)| Self::read(run, name, wanted.iteration, observer)).collect()
    }

    fn read(
        folder: &Path,
        name: String,
        asked: Option<u32>,
        observer: &dyn Observer,
    ) -> Result<Self, Failure> {
        if is_model(folder) {
            let folder = folder.display();
            return Err(Failure::input(format!(
                "{folder} is a model; a report is of a run: name the folder that `densify train` wrote"
            )));
        }
        let config = RunConfig::read(folder)?;
        let (iteration, trains) = iteration_so_far(folder, asked, observer)?;
        Ok(Self {
            folder: folder.to_owned(),
            name,
            config,
            iteration,
            trains,
            summary: if trains { None } else { summary_of(folder)? },
            steps: steps_of(folder)?,
            events: events_of(folder)?,
            reductions: if trains { None } else { Reductions::read(folder)? },
            scores: all_scores(folder)?,
            by_view: psnr_by_view(folder, iteration)?,
            geometry: geometry_of(folder, iteration)?,
        })
    }

    /// The scores of the model that is shown, where it was measured.
    pub(super) fn score(&self) -> Option<Mean> {
        self.scores.get(&self.iteration).copied()
    }

    /// Rows at the end, as far as it has come.
    pub(super) fn rows(&self) -> Option<usize> {
        let so_far = self.steps.last().map(|step| step.rows);
        self.summary.as_ref().map(|summary| summary.rows).or(so_far)
    }

    /// Most resident memory `[bytes]`, as far as is known.
    pub(super) fn peak_bytes(&self) -> Option<u64> {
        let so_far = self.steps.iter().filter_map(|step| step.resident_bytes).max();
        self.summary.as_ref().and_then(|summary| summary.peak_bytes).or(so_far)
    }

    /// Wall time of all steps `[s]`.
    pub(super) fn seconds(&self) -> Option<f64> {
        let so_far = self.steps.last().map(|step| step.seconds);
        self.summary.as_ref().map(|summary| summary.seconds).or(so_far)
    }
}
