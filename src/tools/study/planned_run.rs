//! A run of a study: its name, description and training, and the record of its outcome.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::{Deserialize, Serialize};
use toml::Value;

use super::limit::Limit;
use super::outcome::Outcome;
use super::process;
use densify_core::files::{self, write_atomically};
use densify_data::dataset::{GroundTruth, builtin};
use densify_run::failure::{Failure, OTHER};
use densify_run::{Partial, RunConfig};
use densify_train::output::{
    CONFIG_FILE, geometry_of, model_path, scores_by_view, scores_of, summary_of,
};

/// A run of a study. Engines receive it as a file.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PlannedRun {
    pub(super) scene: PathBuf,
    /// The scene's short name.
    pub(super) label: String,
    /// The factor that is varied, and its level.
    pub(super) factor: String,
    pub(super) level: String,
    /// The runs that this one is compared with, without the seed: the set is started together or not at all.
    pub(super) set: String,
    /// Maximum number of rows; 0 if memory is the limit.
    pub(super) budget: usize,
    /// Memory limit, if that is what is equal for all policies `[bytes]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) memory: Option<u64>,
    pub(super) seed: u32,
    pub(super) iterations: u32,
    /// Upper bound of its host memory `[bytes]`, if the scene was opened.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) promised_bytes: Option<u64>,
    /// Its time by constants, if the scene was opened `[s]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) modelled_seconds: Option<f64>,
    /// Factor and level for the user, such as `vanilla, 9 rows`.
    pub(super) title: String,
    /// Factor and level for the name of the folder.
    pub(super) folder: String,
    /// If true, scores are measured by `densify eval`, which renders without shortcuts, as other viewers do; otherwise
    /// the run's own measurements are used.
    pub(super) scores_without_shortcuts: bool,
    /// Description of the run.
    pub(super) spec: Partial,
}

impl fmt::Display for PlannedRun {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, {}, seed {}", self.label, self.title, self.seed)
    }
}

impl PlannedRun {
    /// A run in which nothing is varied yet, with the options that all runs of the study share.
    pub(super) fn new(
        shared: &Partial,
        (scene, label): (&Path, &str),
        limit: Limit,
        seed: u32,
        iterations: u32,
    ) -> Self {
        let options = [
            ("scene", Value::from(scene.to_string_lossy().into_owned())),
            ("seed", Value::from(seed)),
            ("iterations", Value::from(iterations)),
        ];
        let add = |spec, (name, value)| Partial::option(name, value).over(spec);
        let (budget, memory) = match limit {
            Limit::Rows(rows) => (rows, None),
            Limit::Memory(bytes) => (0, Some(bytes)),
        };
        Self {
            scene: scene.to_owned(),
            label: label.to_owned(),
            budget,
            memory,
            seed,
            iterations,
            spec: limit.option().over(options.into_iter().fold(shared.clone(), add)),
            ..Self::default()
        }
    }

    /// The limit under which the run is compared.
    pub(super) fn limit(&self) -> Limit {
        self.memory.map_or(Limit::Rows(self.budget), Limit::Memory)
    }

    /// Name of the run's folder.
    pub(super) fn name(&self) -> String {
        format!("{}-{}-seed{}", self.label, self.folder, self.seed)
    }

    /// The run's folder in that of the study.
    pub(super) fn folder_in(&self, output: &Path) -> PathBuf {
        output.join("runs").join(self.name())
    }

    /// Trains and evaluates the run, and returns its outcome.
    pub(super) fn train(&self, output: &Path) -> Result<Outcome, Failure> {
        let folder = self.folder_in(output);
        let begin = Instant::now();
        self.train_and_evaluate(&folder).map_err(|failure| {
            failure.and(&format!("this was the run {self}; the same command resumes here"))
        })?;
        let wall_seconds = Some(begin.elapsed().as_secs_f64());
        Ok(Outcome { wall_seconds, ..self.outcome(&folder)? })
    }

    /// Reads the outcome of a run that is complete in its folder, but missing in the journal, which a full disk or a lost
    /// line can cause; `None` if the folder holds no such run.
    pub(super) fn finished(&self, output: &Path) -> Option<Outcome> {
        let folder = self.folder_in(output);
        if self.needs_evaluation(&folder).ok()? {
            return None;
        }
        let summary = summary_of(&folder).ok()??;
        let config = Partial::read(&folder.join(CONFIG_FILE)).ok()?;
        let is_this = summary.finished && self.spec.clone().over(config.clone()) == config;
        let outcome = if is_this { self.outcome(&folder).ok()? } else { return None };
        outcome.is_of(&self.spec).then_some(outcome)
    }

    fn train_and_evaluate(&self, folder: &Path) -> Result<(), Failure> {
        process::train(&self.spec, folder)?;
        if self.needs_evaluation(folder)? {
            process::evaluate(&self.spec, folder)?;
        }
        Ok(())
    }

    /// True if training has not measured everything that the study needs.
    fn needs_evaluation(&self, folder: &Path) -> Result<bool, Failure> {
        let has_surface = builtin::name(&self.scene).is_some() || GroundTruth::is_in(&self.scene);
        Ok(self.scores_without_shortcuts
            || has_surface && geometry_of(folder, self.iterations)?.is_none())
    }

    /// The file that describes the run to an engine, and its text.
    pub(super) fn task_file(&self, output: &Path) -> Result<(PathBuf, String), Failure> {
        let text = toml::to_string(self).map_err(Failure::input)?;
        Ok((task_file(output, &self.name()), text))
    }

    /// Reads the run of this name from its file.
    pub(super) fn read(output: &Path, name: &str) -> Result<Self, Failure> {
        let path = task_file(output, name);
        let within = |problem: String| Failure::input(format!("{}: {problem}", path.display()));
        let text =
            files::read_text(&path, files::MAX_OPTIONS_BYTES).map_err(|e| within(e.to_string()))?;
        toml::from_str(&text).map_err(|e| within(e.to_string().trim().to_owned()))
    }

    /// Trains the run unless it is done, and writes its record beside its folder.
    pub(super) fn train_and_record(&self, output: &Path) -> Result<(), Failure> {
        if self.recorded(output).is_some() {
            return Ok(());
        }
        let outcome = self.train(output)?;
        let text = serde_json::to_string(&outcome).map_err(Failure::input)?;
        write_atomically(&record_file(output, &self.name()), |out| out.write_all(text.as_bytes()))?;
        Ok(())
    }

    /// The outcome that [`Self::train_and_record`] has written for the same description.
    pub(super) fn recorded(&self, output: &Path) -> Option<Outcome> {
        let text =
            files::read_text(&record_file(output, &self.name()), files::MAX_OPTIONS_BYTES).ok()?;
        let outcome: Outcome = serde_json::from_str(&text).ok()?;
        outcome.is_of(&self.spec).then_some(outcome)
    }

    /// Reads the outcome from the run's folder.
    fn outcome(&self, folder: &Path) -> Result<Outcome, Failure> {
        let summary = summary_of(folder)?.ok_or_else(|| {
            Failure::new(OTHER, format!("{}: there is no stats/summary.json", folder.display()))
        })?;
        let iterations = summary.iterations;
        let scores = if self.scores_without_shortcuts {
            scores_of(folder, iterations)?
        } else {
            summary.test.values().next_back().copied()
        };
        let Some(scores) = scores else {
            let scene = self.scene.display();
            return Err(Failure::input(format!("{scene}: no view is held out for scoring")));
        };
        let path = model_path(folder, iterations);
        let model =
            fs::read(&path).map_err(|e| Failure::new(OTHER, format!("{}: {e}", path.display())))?;
        Ok(Outcome {
            densify: summary.densify,
            scene: self.label.clone(),
            factor: self.factor.clone(),
            level: self.level.clone(),
            budget: if self.memory.is_some() { summary.budget } else { self.budget },
            memory: self.memory,
            seed: self.seed,
            iterations,
            run: self.name(),
            spec: self.spec.clone().into_table(),
            model: crc32c::crc32c(&model),
            model_bytes: Some(model.len() as u64),
            psnr: scores.psnr,
            ssim: scores.ssim,
            flip: scores.flip,
            lpips: scores.lpips,
            views: scores_by_view(folder, iterations)?,
            rows: summary.rows,
            peak_rows: summary.peak_rows,
            sh_degree: Some(RunConfig::read(folder)?.sh_degree),
            peak_bytes: summary.peak_bytes,
            ledger_bytes: summary.ledger_bytes,
            seconds: summary.seconds,
            wall_seconds: None,
            modelled_seconds: self.modelled_seconds,
            cpu_seconds: summary.cpu_seconds,
            extra_forwards: summary.extra_forwards,
            curve: summary.test.iter().map(|(step, mean)| (*step, mean.psnr)).collect(),
            geometry: geometry_of(folder, iterations)?,
        })
    }
}

/// File with the description of a run for an engine.
fn task_file(output: &Path, name: &str) -> PathBuf {
    output.join("runs").join(format!("{name}.task.toml"))
}

/// File with the outcome of a run that an engine has started.
fn record_file(output: &Path, name: &str) -> PathBuf {
    output.join("runs").join(format!("{name}.record.json"))
}
