//! One run of a study: how it is called, described and made, and the record of its outcome.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use toml::Value;

use super::child::{Child, has_geometry, in_run, summary};
use super::record::Outcome;
use densify_core::files;
use densify_core::files::write_atomically;
use densify_run::Partial;
use densify_run::failure::{Failure, OTHER};
use densify_train::output::{geometry_of, model_path, scores_of};

/// A run of a study, as it also stands in a file for who is to make it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Cell {
    pub(super) scene: PathBuf,
    /// The scene's short name.
    pub(super) label: String,
    /// What is varied, and at which level.
    pub(super) factor: String,
    pub(super) level: String,
    pub(super) budget: usize,
    pub(super) seed: u32,
    pub(super) iterations: u32,
    /// What factor and level are called to the user, such as `vanilla, 9 rows`.
    pub(super) title: String,
    /// The same for names of folders.
    pub(super) folder: String,
    /// Whether scores are of the model as any viewer would show it, without shortcuts; else they are
    /// those that the run measured itself.
    pub(super) scores_without_shortcuts: bool,
    /// The description of the run.
    #[serde(with = "as_table")]
    pub(super) spec: Partial,
}

mod as_table {
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};
    use toml::Table;

    use densify_run::Partial;

    pub(super) fn serialize<S: Serializer>(spec: &Partial, to: S) -> Result<S::Ok, S::Error> {
        spec.clone().into_table().serialize(to)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Partial, D::Error> {
        Partial::new(Table::deserialize(from)?, "spec").map_err(D::Error::custom)
    }
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, {}, seed {}", self.label, self.title, self.seed)
    }
}

impl Cell {
    /// A run of a study with nothing varied: the options that all runs share, under those that each sets.
    pub(super) fn new(
        shared: &Partial,
        (scene, label): (&Path, &str),
        budget: usize,
        seed: u32,
        iterations: u32,
    ) -> Self {
        let own = [
            ("scene", Value::from(scene.to_string_lossy().into_owned())),
            ("budget", Value::from(i64::try_from(budget).unwrap_or(i64::MAX))),
            ("seed", Value::from(seed)),
            ("iterations", Value::from(iterations)),
        ];
        let lay = |spec: Partial, (name, value)| Partial::option(name, value).over(spec);
        Self {
            scene: scene.to_owned(),
            label: label.to_owned(),
            budget,
            seed,
            iterations,
            spec: own.into_iter().fold(shared.clone(), lay),
            ..Self::default()
        }
    }

    /// Name of the run's folder.
    pub(super) fn run(&self) -> String {
        format!("{}-{}-seed{}", self.label, self.folder, self.seed)
    }

    /// Where the run is, in the folder of the study.
    pub(super) fn path(&self, output: &Path) -> PathBuf {
        output.join("runs").join(self.run())
    }

    /// Trains, measures what was trained, and returns the record.
    pub(super) fn train(&self, output: &Path) -> Result<Outcome, Failure> {
        let folder = self.path(output);
        let child = Child { spec: &self.spec, folder: &folder };
        let measure = || {
            let is_missing = || match has_geometry(&self.scene) {
                true => geometry_of(&folder, self.iterations).map(|found| found.is_none()),
                false => Ok(false),
            };
            let again = self.scores_without_shortcuts || is_missing()?;
            if again { child.measure() } else { Ok(()) }
        };
        let done = child.train().and_then(|()| measure());
        done.map_err(|failure| in_run(self, failure))?;
        self.record(&folder)
    }

    /// Writes what whoever is to make the run needs.
    pub(super) fn write(&self, output: &Path) -> Result<(), Failure> {
        let text = toml::to_string(self).map_err(Failure::input)?;
        write_atomically(&task_file(output, &self.run()), |out| out.write_all(text.as_bytes()))?;
        Ok(())
    }

    /// The run of this name, as it was written.
    pub(super) fn read(output: &Path, name: &str) -> Result<Self, Failure> {
        let path = task_file(output, name);
        let within = |problem: String| Failure::input(format!("{}: {problem}", path.display()));
        let text =
            files::read_text(&path, files::MAX_OPTIONS).map_err(|e| within(e.to_string()))?;
        toml::from_str(&text).map_err(|e| within(e.to_string().trim().to_owned()))
    }

    /// Makes the run, unless that is done, and leaves its record beside its folder.
    pub(super) fn make(&self, output: &Path) -> Result<(), Failure> {
        if self.made(output).is_some() {
            return Ok(());
        }
        let outcome = self.train(output)?;
        let text = serde_json::to_string(&outcome).map_err(Failure::input)?;
        write_atomically(&record_file(output, &self.run()), |out| out.write_all(text.as_bytes()))?;
        Ok(())
    }

    /// The record that [`Self::make`] has left of this very run.
    pub(super) fn made(&self, output: &Path) -> Option<Outcome> {
        let text = files::read_text(&record_file(output, &self.run()), files::MAX_OPTIONS).ok()?;
        let outcome: Outcome = serde_json::from_str(&text).ok()?;
        outcome.is_of(&self.spec).then_some(outcome)
    }

    fn record(&self, folder: &Path) -> Result<Outcome, Failure> {
        let summary = summary(folder)?;
        let iterations = summary.iterations;
        let scores = match self.scores_without_shortcuts {
            true => scores_of(folder, iterations)?,
            false => summary.test.values().next_back().copied(),
        };
        let Some(scores) = scores else {
            let scene = self.scene.display();
            return Err(Failure::input(format!("{scene}: no view is held out to measure")));
        };
        let path = model_path(folder, iterations);
        let model =
            fs::read(&path).map_err(|e| Failure::new(OTHER, format!("{}: {e}", path.display())))?;
        Ok(Outcome {
            densify: summary.densify,
            scene: self.label.clone(),
            factor: self.factor.clone(),
            level: self.level.clone(),
            budget: self.budget,
            seed: self.seed,
            iterations,
            run: self.run(),
            spec: self.spec.clone().into_table(),
            model: crc32c::crc32c(&model),
            psnr: scores.psnr,
            ssim: scores.ssim,
            flip: scores.flip,
            rows: summary.rows,
            peak_rows: summary.peak_rows,
            peak_bytes: summary.peak_bytes,
            ledger_bytes: summary.ledger_bytes,
            seconds: summary.seconds,
            cpu_seconds: summary.cpu_seconds,
            extra_forwards: summary.extra_forwards,
            curve: summary.test.iter().map(|(step, mean)| (*step, mean.psnr)).collect(),
            geometry: geometry_of(folder, iterations)?,
        })
    }
}

/// What whoever is to make a run needs.
fn task_file(output: &Path, name: &str) -> PathBuf {
    output.join("runs").join(format!("{name}.task.toml"))
}

/// The record of a run that an engine has started.
fn record_file(output: &Path, name: &str) -> PathBuf {
    output.join("runs").join(format!("{name}.record.json"))
}
