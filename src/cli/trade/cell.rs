//! What a study of the trade does: runs, and looks at what they trained. Each leaves a record.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use crate::cli::study::{Call, Entry, Summary, in_run};
use crate::failure::{Failure, OTHER};
use crate::knobs::{EXACT, preset};
use crate::metrics::geometry::Geometry;
use crate::output::{Mean, geometry_of, model_path, scores_of};
use crate::run::Partial;
use crate::schedule::REFERENCE_ITERATIONS;

/// The knob of a run in which none is changed, which is one with the preset `exact`, and that of a run
/// of the factorial.
pub(super) const BASE: &str = "";
pub(super) const FACTORIAL: &str = "factorial";

/// A run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Cell {
    pub(super) scene: PathBuf,
    pub(super) label: String,
    /// The knob that is changed, [`BASE`] or [`FACTORIAL`].
    pub(super) knob: String,
    /// Its value, or the number of the factorial's run.
    pub(super) level: String,
    /// Every knob that is changed, as `NAME=VALUE`.
    pub(super) settings: Vec<String>,
    pub(super) seed: u32,
    pub(super) iterations: u32,
    pub(super) budget: usize,
    /// Options that all runs share.
    pub(super) train: Partial,
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { label, knob, level, seed, .. } = self;
        let what = match &**knob {
            BASE => "exact".to_owned(),
            FACTORIAL => format!("run {level} of the factorial"),
            knob => format!("{knob}={level}"),
        };
        write!(f, "{label}, {what}, seed {seed}")
    }
}

/// Something that is done once.
pub(super) enum What {
    /// A run.
    Run(Cell),
    /// How far off the images of a run's model are with a knob at a level: run, knob, level.
    Image(Cell, String, String),
}

/// A line of `trade.jsonl`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub(super) enum Record {
    Run(Box<Outcome>),
    Image(Numerical),
}

/// What came of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Outcome {
    /// Version of densify.
    pub(super) densify: String,
    pub(super) scene: String,
    pub(super) knob: String,
    pub(super) level: String,
    pub(super) seed: u32,
    /// Folder of the run, in `runs`.
    pub(super) run: String,
    /// The run's description: one with the same is not run again.
    pub(super) spec: Table,
    /// Checksum of the model's file: equal models have equal ones.
    pub(super) model: u32,
    /// Mean over the views held out, rendered without any shortcut `[dB]`.
    pub(super) psnr: f64,
    pub(super) ssim: f64,
    pub(super) flip: f64,
    /// Rows at the end.
    pub(super) rows: usize,
    /// Largest resident memory of the process.
    pub(super) peak_bytes: Option<u64>,
    /// What was promised.
    pub(super) ledger_bytes: u64,
    /// Wall time of the steps.
    pub(super) seconds: f64,
    /// Processor time of the steps.
    pub(super) cpu_seconds: Option<f64>,
    /// Wall time by stage.
    pub(super) stage_seconds: BTreeMap<String, f64>,
    /// How the model sits on the surface, where that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) geometry: Option<Geometry>,
}

/// How far images are off with a knob at a level.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Numerical {
    /// Version of densify.
    pub(super) densify: String,
    pub(super) scene: String,
    pub(super) knob: String,
    pub(super) level: String,
    /// The description of the run that made the model.
    pub(super) spec: Table,
    /// Against the float64 renderer with the standard rules: alpha from 1/255, transmittance to 1e-4
    /// `[dB]`.
    pub(super) standard: f64,
    /// Against the float64 renderer that blends everything `[dB]`.
    pub(super) everything: f64,
    /// Largest error of a channel against the standard rules, in 0..=1.
    pub(super) worst: f64,
}

impl Entry for Record {
    type Of = What;

    fn is_of(&self, what: &What) -> bool {
        let version = env!("CARGO_PKG_VERSION");
        match (self, what) {
            (Self::Run(run), What::Run(cell)) => run.spec == cell.spec() && run.densify == version,
            (Self::Image(image), What::Image(cell, knob, level)) => {
                (&image.knob, &image.level) == (knob, level)
                    && image.spec == cell.spec()
                    && image.densify == version
            }
            _ => false,
        }
    }
}

/// A knob at a level as `NAME=VALUE`, in runs of so many iterations: a preset by its own levels, where
/// iterations are as much fewer than these as they are fewer than those of a run by default.
pub(super) fn settings(knob: &str, level: &str, iterations: u32) -> Vec<String> {
    let setting = |&(name, value): &(&str, &str)| match (name, value.parse::<u64>()) {
        ("iterations", Ok(own)) => {
            let scaled = own * u64::from(iterations) / u64::from(REFERENCE_ITERATIONS);
            format!("{name}={}", scaled.max(1))
        }
        _ => format!("{name}={value}"),
    };
    match (knob, preset(level)) {
        ("preset", Ok(preset)) => preset.levels.iter().map(setting).collect(),
        _ => vec![format!("{knob}={level}")],
    }
}

impl Cell {
    /// The description of the run: that of `exact` with what is changed.
    pub(super) fn spec(&self) -> Table {
        let own = [
            ("scene", Value::from(self.scene.to_string_lossy().into_owned())),
            ("budget", Value::from(i64::try_from(self.budget).unwrap_or(i64::MAX))),
            ("seed", Value::from(self.seed)),
            ("iterations", Value::from(self.iterations)),
            ("preset", Value::from(EXACT)),
        ];
        let own = own.into_iter().fold(self.train.clone(), |spec, (name, value)| {
            Partial::option(name, value).over(spec)
        });
        let changed = self.settings.iter().filter_map(|setting| setting.split_once('='));
        let spec =
            changed.fold(own, |spec, (name, value)| Partial::setting(name, value).over(spec));
        spec.into_table()
    }

    /// Name of the run's folder.
    pub(super) fn run(&self) -> String {
        let Self { label, knob, level, seed, .. } = self;
        let plain = |c: char| if c.is_ascii_alphanumeric() || "._".contains(c) { c } else { '-' };
        let what = if knob.is_empty() { "exact".to_owned() } else { format!("{knob}-{level}") };
        let what: String = what.chars().map(plain).collect();
        format!("{label}-{what}-seed{seed}")
    }

    pub(super) fn folder(&self, output: &Path) -> PathBuf {
        output.join("runs").join(self.run())
    }

    /// Trains, and measures what was trained by the renderer without shortcuts, as any viewer would
    /// show it.
    ///
    /// # Errors
    /// With the trainer's message and exit code when it fails.
    pub(super) fn train(&self, output: &Path) -> Result<Outcome, Failure> {
        let folder = self.folder(output);
        let spec = self.spec();
        let call = Call { spec: &spec, folder: &folder };
        call.train().and_then(|()| call.measure()).map_err(|failure| in_run(self, failure))?;
        let summary = Summary::read(&folder)?;
        let iterations = summary.number("iterations")? as u32;
        let path = model_path(&folder, iterations);
        let model = fs::read(&path)
            .map_err(|e| Failure { code: OTHER, message: format!("{}: {e}", path.display()) })?;
        let Some(Mean { psnr, ssim, flip }) = scores_of(&folder, iterations)? else {
            return Err(Failure::input(format!(
                "{}: no view is held out to measure",
                self.scene.display()
            )));
        };
        let stages = summary.get("stage_seconds").clone();
        Ok(Outcome {
            densify: summary.text("densify"),
            scene: self.label.clone(),
            knob: self.knob.clone(),
            level: self.level.clone(),
            seed: self.seed,
            run: self.run(),
            spec: self.spec(),
            model: crc32c::crc32c(&model),
            psnr,
            ssim,
            flip,
            rows: summary.number("rows")? as usize,
            peak_bytes: summary.get("peak_bytes").as_u64(),
            ledger_bytes: summary.number("ledger_bytes")? as u64,
            seconds: summary.number("seconds")?,
            cpu_seconds: summary.get("cpu_seconds").as_f64(),
            stage_seconds: serde_json::from_value(stages).unwrap_or_default(),
            geometry: geometry_of(&folder, iterations)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_preset_is_set_by_its_levels_and_shortens_runs_in_proportion() {
        assert_eq!(settings("alpha_min", "1/64", 600), ["alpha_min=1/64"]);
        assert_eq!(settings("preset", "fast", 600), ["iterations=300"]);
        assert_eq!(settings("preset", "fast", 1), ["iterations=1"]);
        assert_eq!(settings("preset", "tiny-memory", 600)[0], "image_cache=0");
    }
}
