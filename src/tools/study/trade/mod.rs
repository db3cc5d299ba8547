//! `densify trade`: the effect of each knob on quality, time and memory.

mod levels;
mod plots;
mod report;
mod results;

use std::path::PathBuf;

use clap::Args;

use super::outcome::Outcome;
use super::planned_run::PlannedRun;
use super::{EngineArgs, Finished, Limit, Ran, Study, labels, shared_options};
use densify_core::numbers;
use densify_run::failure::Failure;
use densify_run::knobs::{EXACT, preset};
use densify_run::{DEFAULT_BUDGET, Observer, Partial};
use densify_train::schedule::REFERENCE_ITERATIONS;
use levels::{Factor, factors};
use results::Results;

/// Options of a run that the study sets itself.
const OWN_OPTIONS: [&str; 8] =
    ["scene", "budget", "seed", "iterations", "output", "knob", "preset", "view"];

/// The factor of a run with the preset `exact`, in which no factor is changed.
const BASE: &str = "";

const EXAMPLES: &str = "\
Examples:
  densify trade scene:room -i 2000 -b 20k
  densify trade data/garden --knobs alpha_min,sh_degree --seeds 5 -- -r 4
  densify trade scene:spheres --knobs alpha_min:1/96:1/48 -i 1000 -b 5k -- --policy taming";

/// Measures what each shortcut costs and gains.
///
/// Trains with every knob (`densify knobs`) at each of its levels, one at a time, and otherwise with
/// the preset `exact` and the same seeds. Reports the quality of held-out views, the time, and the
/// peak memory.
///
/// Finished runs are not repeated: after an interruption, the same command continues. The folder then
/// holds trade.md (tables and plots), trade.html (the same as one file), trade.jsonl (a record per
/// line), plots as SVG, and the runs themselves. With --engine the runs can be trained on a cluster.
#[derive(Debug, Clone, Args)]
#[command(after_help = EXAMPLES)]
pub struct Trade {
    /// Folders of the scenes, or built-in scenes (scene:NAME)
    #[arg(required = true)]
    pub scenes: Vec<PathBuf>,
    /// Knobs or options, separated by commas; with levels as in alpha_min:1/64:1/32 `[default: all knobs that
    /// apply, and some options]`
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub knobs: Vec<String>,
    /// Number of runs at each level, with seeds 0, 1, …
    #[arg(long, value_name = "K", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub seeds: u32,
    /// Length of each run
    #[arg(short, long, value_name = "N", default_value_t = 7_000, value_parser = clap::value_parser!(u32).range(1..))]
    pub iterations: u32,
    /// Maximum number of Gaussians of each run
    #[arg(short, long, value_name = "ROWS", default_value_t = DEFAULT_BUDGET, value_parser = numbers::rows)]
    pub budget: usize,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR", default_value = "trade")]
    pub output: PathBuf,
    /// Options of `densify train` for every run
    #[arg(last = true, value_name = "TRAIN OPTIONS")]
    pub train: Vec<String>,
    /// Where the runs are started.
    #[command(flatten)]
    pub engine: EngineArgs,
}

impl Trade {
    /// Trains the runs that are not done yet, all with the options `train`, and writes tables and plots; `None` while a
    /// scheduler still has unfinished runs.
    pub fn run(
        &self,
        train: Partial,
        observer: &dyn Observer,
    ) -> Result<Option<Finished>, Failure> {
        let shared = shared_options(train, &OWN_OPTIONS)?;
        let factors = factors(self, &shared, observer)?;
        let runs = self.plan_runs(&factors, &shared)?;
        let mut study = Study::open(&self.output, "trade", &self.engine, observer)?;
        let Some(Ran { outcomes, .. }) = study.run(&runs)? else { return Ok(None) };
        let results = Results::new(self, &factors, outcomes);
        let mut document = report::document(&results);
        document.section("Plots");
        for picture in plots::draw(&self.output, &results)? {
            document.picture(picture.file, picture.caption);
        }
        study.finish(&document, report::summary(&results)).map(Some)
    }

    /// All runs in the order of training, each with at most one factor changed: seed after seed, so that an interrupted
    /// study is still fair.
    fn plan_runs(&self, factors: &[Factor], shared: &Partial) -> Result<Vec<PlannedRun>, Failure> {
        let labels = labels(&self.scenes)?;
        let limit = Limit::Rows(self.budget);
        let mut runs = Vec::new();
        for seed in 0..self.seeds {
            for (scene, label) in self.scenes.iter().zip(&labels) {
                let base = PlannedRun::new(shared, (scene, label), limit, seed, self.iterations);
                let base = PlannedRun {
                    factor: BASE.to_owned(),
                    title: "exact".to_owned(),
                    folder: "exact".to_owned(),
                    set: label.clone(),
                    spec: Partial::option("preset", EXACT).over(base.spec.clone()),
                    scores_without_shortcuts: true,
                    ..base
                };
                runs.push(base.clone());
                for factor in factors {
                    let levels = factor.levels.iter();
                    runs.extend(levels.map(|level| with_level(&base, &factor.name, level)));
                }
            }
        }
        Ok(runs)
    }
}

/// The base run with a factor at a level.
fn with_level(base: &PlannedRun, factor: &str, level: &str) -> PlannedRun {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "._".contains(c);
    let mut spec = base.spec.clone();
    for (name, value) in settings(factor, level, base.iterations) {
        spec = Partial::setting(&name, &value).over(spec);
    }
    PlannedRun {
        factor: factor.to_owned(),
        level: level.to_owned(),
        title: format!("{factor}={level}"),
        folder: format!("{factor}-{level}").replace(|c| !is_plain(c), "-"),
        spec,
        ..base.clone()
    }
}

/// The options and knobs that a factor at a level sets. For a preset these are its levels, with its iterations in
/// proportion to those of the study.
fn settings(factor: &str, level: &str, iterations: u32) -> Vec<(String, String)> {
    let setting = |&(name, value): &(&str, &str)| {
        let value = match (name, value.parse::<u64>()) {
            ("iterations", Ok(preset_iterations)) => {
                let scaled =
                    preset_iterations * u64::from(iterations) / u64::from(REFERENCE_ITERATIONS);
                scaled.max(1).to_string()
            }
            _ => value.to_owned(),
        };
        (name.to_owned(), value)
    };
    match (factor, preset(level)) {
        ("preset", Ok(preset)) => preset.levels.iter().map(setting).collect(),
        _ => vec![(factor.to_owned(), level.to_owned())],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_preset_is_set_by_its_levels_and_shortens_runs_in_proportion() {
        let pair = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        assert_eq!(settings("alpha_min", "1/64", 600), [pair("alpha_min", "1/64")]);
        assert_eq!(settings("preset", "fast", 600), [pair("iterations", "300")]);
        assert_eq!(settings("preset", "fast", 1), [pair("iterations", "1")]);
        assert_eq!(settings("preset", "tiny-memory", 600)[0], pair("image_cache", "auto"));
    }
}
