//! The study behind `densify trade`: what each knob costs and buys, alone and among others.

mod effects;
mod levels;
mod numerical;
mod plots;
mod report;
mod table;

use std::path::PathBuf;

use clap::Args;

use super::cell::Cell;
use super::child::shared_options;
use super::record::{ImageError, Outcome, Record};
use super::{Finished, Study, labels};
use crate::failure::Failure;
use crate::knobs::{Class, EXACT, preset};
use crate::number;
use crate::run::{DEFAULT_BUDGET, Observer, Partial};
use crate::schedule::REFERENCE_ITERATIONS;
use levels::{Factor, factors};
use numerical::Subject;
use report::Report;

/// Options of a run that are the study's to set.
const OWN_OPTIONS: [&str; 7] =
    ["scene", "budget", "seed", "iterations", "output", "knob", "preset"];

/// The factor of a run in which no knob is changed, which is one with the preset `exact`, and that of a
/// run of the factorial.
const BASE: &str = "";
const FACTORIAL: &str = "factorial";

const EXAMPLES: &str = "\
Examples:
  densify trade scene:room -i 2000 -b 20k
  densify trade data/garden --knobs alpha_min,ssim_every,sh_every --seeds 5 -- -r 4
  densify trade scene:spheres --knobs coarse_until:0.3:0.5 -i 1000 -b 5k -- --policy taming";

/// Measures what each shortcut costs and buys.
///
/// For every knob (`densify knobs`) and each of its levels: how far off the same model's images are,
/// against a renderer in float64; and what training with it arrives at, on views held out, with time
/// by stage and memory at its peak. One knob at a time from the preset `exact`, with the same seeds; then
/// those that stand out together, in a design of twelve runs.
///
/// A run that is finished is not run again: call the same command to go on after an interruption. The
/// folder then holds trade.md (tables and plots), trade.jsonl (a record per line), plots as SVG, and
/// the runs themselves. "Free" is said only of what costs less than can be seen, by all of its
/// intervals.
#[derive(Debug, Clone, Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Trade {
    /// Folders of the scenes, or built-in scenes (scene:NAME)
    #[arg(required = true)]
    pub scenes: Vec<PathBuf>,
    /// Knobs, separated by commas; a knob with levels of its own as alpha_min:1/64:1/32
    /// `[default: all that the policy has]`
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub knobs: Vec<String>,
    /// Runs of each kind, with seeds 0, 1, …
    #[arg(long, value_name = "K", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub seeds: u32,
    /// Length of each run
    #[arg(short, long, value_name = "N", default_value_t = 7_000, value_parser = clap::value_parser!(u32).range(1..))]
    pub iterations: u32,
    /// Most Gaussians of each run
    #[arg(short, long, value_name = "ROWS", default_value_t = DEFAULT_BUDGET, value_parser = number::rows)]
    pub budget: usize,
    /// Leave out the runs in which several knobs are changed together
    #[arg(long)]
    pub no_factorial: bool,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR", default_value = "trade")]
    pub output: PathBuf,
    /// Options of `densify train` for every run
    #[arg(last = true, value_name = "TRAIN OPTIONS")]
    pub train: Vec<String>,
}

impl Trade {
    /// Makes what is not done yet, all runs with the options `train`, and writes tables and plots.
    pub(crate) fn run(&self, train: Partial, observer: &dyn Observer) -> Result<Finished, Failure> {
        let shared = shared_options(train, &OWN_OPTIONS)?;
        let factors = factors(self, &shared, observer)?;
        let cells = self.cells(&factors, &shared)?;
        let mut study = Study::open(&self.output, "trade", observer)?;
        let outcomes = study.run(&cells)?;
        let images = measure_images(&mut study, &cells, &factors)?;
        let mut report = Report::new(self, &factors, outcomes, images);
        let together = if self.no_factorial { Vec::new() } else { report.knobs_that_stand_out() };
        if together.len() > 1 {
            let runs = factorial(&cells, &together);
            observer.say(format_args!("{} knobs stand out; together:", together.len()));
            let outcomes = study.run(&runs)?;
            report.add_factorial(together, outcomes);
        }
        let mut text = table::markdown(&report);
        text += "\n## Plots\n";
        for picture in plots::draw(&self.output, &report)? {
            text += &format!("\n![{}]({})\n", picture.caption, picture.file);
        }
        study.finish("trade", &text, table::summary(&report))
    }

    /// All runs in which at most one knob is changed, in the order in which they run: seed after seed, so
    /// that an interrupted study is a fair one of fewer seeds.
    fn cells(&self, factors: &[Factor], shared: &Partial) -> Result<Vec<Cell>, Failure> {
        let labels = labels(&self.scenes)?;
        let mut cells = Vec::new();
        for seed in 0..self.seeds {
            for (scene, label) in self.scenes.iter().zip(&labels) {
                let base = Cell::new(shared, (scene, label), self.budget, seed, self.iterations);
                let base = Cell {
                    factor: BASE.to_owned(),
                    title: "exact".to_owned(),
                    folder: "exact".to_owned(),
                    spec: Partial::option("preset", EXACT).over(base.spec.clone()),
                    scores_without_shortcuts: true,
                    ..base
                };
                cells.push(base.clone());
                for factor in factors {
                    cells.extend(factor.levels.iter().map(|level| {
                        let name = &factor.name;
                        let changes = changes(name, level, self.iterations);
                        changed(&base, name, level, format!("{name}={level}"), changes)
                    }));
                }
            }
        }
        Ok(cells)
    }
}

/// The base run with options and knobs changed.
fn changed(
    base: &Cell,
    factor: &str,
    level: &str,
    title: String,
    changes: impl IntoIterator<Item = (String, String)>,
) -> Cell {
    let plain = |c: char| c.is_ascii_alphanumeric() || "._".contains(c);
    let mut spec = base.spec.clone();
    for (name, value) in changes {
        spec = Partial::setting(&name, &value).over(spec);
    }
    Cell {
        factor: factor.to_owned(),
        level: level.to_owned(),
        title,
        folder: format!("{factor}-{level}").replace(|c| !plain(c), "-"),
        spec,
        ..base.clone()
    }
}

/// The options and knobs that a knob at a level stands for, in runs of so many iterations: a preset by its
/// own levels, where iterations are as much fewer than these as they are fewer than those of a run by
/// default.
fn changes(knob: &str, level: &str, iterations: u32) -> Vec<(String, String)> {
    let change = |&(name, value): &(&str, &str)| {
        let value = match (name, value.parse::<u64>()) {
            ("iterations", Ok(own)) => {
                let scaled = own * u64::from(iterations) / u64::from(REFERENCE_ITERATIONS);
                scaled.max(1).to_string()
            }
            _ => value.to_owned(),
        };
        (name.to_owned(), value)
    };
    match (knob, preset(level)) {
        ("preset", Ok(preset)) => preset.levels.iter().map(change).collect(),
        _ => vec![(knob.to_owned(), level.to_owned())],
    }
}

/// The runs of the factorial over these knobs at these levels, with the first seed.
fn factorial(cells: &[Cell], together: &[(String, String)]) -> Vec<Cell> {
    let design = effects::plackett_burman();
    let runs = |base: &Cell| -> Vec<Cell> {
        let run = |(i, run): (usize, &[bool; effects::FACTORS])| {
            let high = together.iter().zip(run).filter(|(_, high)| **high);
            let number = (i + 1).to_string();
            let title = format!("run {number} of the factorial");
            changed(base, FACTORIAL, &number, title, high.map(|(setting, _)| setting.clone()))
        };
        design.iter().enumerate().map(run).collect()
    };
    first_bases(cells).flat_map(runs).collect()
}

/// The unchanged run of every scene at the first seed.
fn first_bases(cells: &[Cell]) -> impl Iterator<Item = &Cell> {
    cells.iter().filter(|cell| cell.factor == BASE && cell.seed == 0)
}

/// How far off images of the models of the first seed are, as they are and with every knob that changes
/// images.
fn measure_images(
    study: &mut Study<'_>,
    cells: &[Cell],
    factors: &[Factor],
) -> Result<Vec<ImageError>, Failure> {
    let in_images = factors.iter().filter(|factor| factor.class != Class::Heuristic);
    let levels: Vec<(&str, &str)> = std::iter::once((BASE, ""))
        .chain(in_images.flat_map(|one| one.levels.iter().map(|level| (&*one.name, &**level))))
        .collect();
    let mut images = Vec::new();
    for cell in first_bases(cells) {
        let mut subject = None;
        for &(knob, level) in &levels {
            if let Some(image) = study.journal.image(&cell.spec, knob, level) {
                images.push(image.clone());
                continue;
            }
            if subject.is_none() {
                study.observer.say(format_args!("{}: images against float64", cell.label));
                subject = Some(Subject::read(&cell.path(study.output), study.observer)?);
            }
            if let Some(subject) = &subject {
                let image = subject.measure(cell, knob, level)?;
                study.journal.add(Record::Image(image.clone()))?;
                images.push(image);
            }
        }
    }
    Ok(images)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_preset_is_set_by_its_levels_and_shortens_runs_in_proportion() {
        let pair = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        assert_eq!(changes("alpha_min", "1/64", 600), [pair("alpha_min", "1/64")]);
        assert_eq!(changes("preset", "fast", 600), [pair("iterations", "300")]);
        assert_eq!(changes("preset", "fast", 1), [pair("iterations", "1")]);
        assert_eq!(changes("preset", "tiny-memory", 600)[0], pair("image_cache", "auto"));
    }
}
