//! `densify trade`.

mod cell;
mod effects;
mod levels;
mod numerical;
mod plots;
mod report;
mod table;

use std::path::PathBuf;

use clap::Args;

use super::console::Console;
use super::flags;
use super::study::{Records, common, labels};
use crate::failure::Failure;
use crate::knobs::Class;
use crate::number;
use crate::output::write_atomically;
use crate::run::{DEFAULT_BUDGET, Partial};
use cell::{BASE, Cell, FACTORIAL, Outcome, Record, What, settings};
use levels::{Factor, factors};
use numerical::Subject;
use report::Report;

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
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct TradeArgs {
    /// Folders of the scenes, or built-in scenes (scene:NAME)
    #[arg(required = true)]
    pub(super) scenes: Vec<PathBuf>,
    /// Knobs, separated by commas; a knob with levels of its own as alpha_min:1/64:1/32
    /// `[default: all that the policy has]`
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(super) knobs: Vec<String>,
    /// Runs of each kind, with seeds 0, 1, …
    #[arg(long, value_name = "K", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(super) seeds: u32,
    /// Length of each run
    #[arg(short, long, value_name = "N", default_value_t = 7_000, value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) iterations: u32,
    /// Most Gaussians of each run
    #[arg(short, long, value_name = "ROWS", default_value_t = DEFAULT_BUDGET, value_parser = number::rows)]
    pub(super) budget: usize,
    /// Leave out the runs in which several knobs are changed together
    #[arg(long)]
    pub(super) no_factorial: bool,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR", default_value = "trade")]
    pub(super) output: PathBuf,
    /// Options of `densify train` for every run
    #[arg(last = true, value_name = "TRAIN OPTIONS")]
    pub(super) train: Vec<String>,
}

const EXAMPLES: &str = "\
Examples:
  densify trade scene:room -i 2000 -b 20k
  densify trade data/garden --knobs alpha_min,ssim_every,sh_every --seeds 5 -- -r 4
  densify trade scene:spheres --knobs coarse_until:0.3:0.5 -i 1000 -b 5k -- --policy taming";

/// Options of `densify train` that are the study's to set.
const OWN_OPTIONS: [&str; 7] =
    ["scene", "budget", "seed", "iterations", "output", "knob", "preset"];

pub(super) fn run(args: &TradeArgs, console: &Console) -> Result<(), Failure> {
    let train = common(flags::parsed(&args.train, "densify trade ... --")?, &OWN_OPTIONS)?;
    let chosen = factors(args, &train, console)?;
    let cells = cells(args, &chosen, &train)?;
    let mut study =
        Study { args, console, records: Records::open(&args.output.join("trade.jsonl"))? };
    study.train(&cells)?;
    study.look(&cells, &chosen)?;
    let mut report = study.report(&cells, &chosen)?;
    let together = if args.no_factorial { Vec::new() } else { report.that_stand_out() };
    if together.len() > 1 {
        let runs = factorial(&cells, &together);
        console.say(format_args!("{} knobs stand out; together:", together.len()));
        study.train(&runs)?;
        report.add_factorial(together, study.outcomes(&runs));
    }
    let mut text = table::markdown(&report);
    text += "\n## Plots\n";
    for (file, caption) in plots::draw(&args.output, &report)? {
        text += &format!("\n![{caption}]({file})\n");
    }
    let path = args.output.join("trade.md");
    write_atomically(&path, |out| out.write_all(text.as_bytes()))?;
    console.result(table::summary(&report));
    console.result(format_args!("everything in {}", path.display()));
    Ok(())
}

/// A study in progress.
struct Study<'a> {
    args: &'a TradeArgs,
    console: &'a Console,
    records: Records<Record>,
}

impl Study<'_> {
    /// Runs what is not done yet.
    fn train(&mut self, cells: &[Cell]) -> Result<(), Failure> {
        let count = cells.len();
        for (i, cell) in cells.iter().enumerate() {
            let number = i + 1;
            if self.records.of(&What::Run(cell.clone())).is_some() {
                self.console.say(format_args!("[{number}/{count}] {cell}: done before"));
                continue;
            }
            self.console.say(format_args!("[{number}/{count}] {cell}"));
            let outcome = cell.train(&self.args.output)?;
            self.records.add(Record::Run(Box::new(outcome)))?;
        }
        Ok(())
    }

    /// Looks at the models of the first seed with every knob that changes images.
    fn look(&mut self, cells: &[Cell], chosen: &[Factor]) -> Result<(), Failure> {
        for cell in cells.iter().filter(|cell| cell.knob == BASE && cell.seed == 0) {
            let base = std::iter::once((String::new(), String::new()));
            let levels = chosen
                .iter()
                .filter(|one| is_in_images(one))
                .flat_map(|one| one.levels.iter().map(|level| (one.name.clone(), level.clone())));
            let todo: Vec<(String, String)> = base
                .chain(levels)
                .filter(|(knob, level)| {
                    let what = What::Image(cell.clone(), knob.clone(), level.clone());
                    self.records.of(&what).is_none()
                })
                .collect();
            if todo.is_empty() {
                continue;
            }
            self.console.say(format_args!("{}: images against float64", cell.label));
            let subject = Subject::of(&cell.folder(&self.args.output), self.console)?;
            for (knob, level) in todo {
                self.records.add(Record::Image(subject.measure(cell, &knob, &level)?))?;
            }
        }
        Ok(())
    }

    /// What came of the runs. Where the same call was another cell's too, it was made once: the seed
    /// decides everything.
    fn outcomes(&self, cells: &[Cell]) -> Vec<Outcome> {
        let of = |cell: &Cell| match self.records.of(&What::Run(cell.clone())) {
            Some(Record::Run(outcome)) => {
                let Cell { knob, level, .. } = cell.clone();
                Some(Outcome { knob, level, ..Outcome::clone(outcome) })
            }
            _ => None,
        };
        cells.iter().filter_map(of).collect()
    }

    fn report(&self, cells: &[Cell], chosen: &[Factor]) -> Result<Report, Failure> {
        let mut images = Vec::new();
        for cell in cells.iter().filter(|cell| cell.knob == BASE && cell.seed == 0) {
            let base = std::iter::once((String::new(), String::new()));
            let levels = chosen
                .iter()
                .flat_map(|one| one.levels.iter().map(|level| (one.name.clone(), level.clone())));
            images.extend(base.chain(levels).filter_map(|(knob, level)| {
                match self.records.of(&What::Image(cell.clone(), knob, level)) {
                    Some(Record::Image(image)) => Some(image.clone()),
                    _ => None,
                }
            }));
        }
        Ok(Report::new(self.args, chosen, self.outcomes(cells), images))
    }
}

/// Whether a knob can change the images of a model.
fn is_in_images(one: &Factor) -> bool {
    one.class != Class::Heuristic
}

/// All runs in which at most one knob is changed, in the order in which they run: seed after seed, so
/// that an interrupted study is a fair one of fewer seeds.
fn cells(args: &TradeArgs, chosen: &[Factor], train: &Partial) -> Result<Vec<Cell>, Failure> {
    let labels = labels(&args.scenes)?;
    let mut cells = Vec::new();
    for seed in 0..args.seeds {
        for (scene, label) in args.scenes.iter().zip(&labels) {
            let base = Cell {
                scene: scene.clone(),
                label: label.clone(),
                knob: BASE.to_owned(),
                level: String::new(),
                settings: Vec::new(),
                seed,
                iterations: args.iterations,
                budget: args.budget,
                train: train.clone(),
            };
            cells.push(base.clone());
            for one in chosen {
                cells.extend(one.levels.iter().map(|level| Cell {
                    knob: one.name.clone(),
                    level: level.clone(),
                    settings: settings(&one.name, level, args.iterations),
                    ..base.clone()
                }));
            }
        }
    }
    Ok(cells)
}

/// The runs of the factorial over these knobs at these levels, with the first seed.
fn factorial(cells: &[Cell], together: &[(String, String)]) -> Vec<Cell> {
    let bases = cells.iter().filter(|cell| cell.knob == BASE && cell.seed == 0);
    let runs = |base: &Cell| -> Vec<Cell> {
        let design = effects::plackett_burman();
        let settings = |run: &[bool]| {
            let high = together.iter().zip(run).filter(|(_, high)| **high);
            high.map(|((knob, level), _)| format!("{knob}={level}")).collect()
        };
        let cell = |(i, run): (usize, &[bool; effects::FACTORS])| Cell {
            knob: FACTORIAL.to_owned(),
            level: (i + 1).to_string(),
            settings: settings(run),
            ..base.clone()
        };
        design.iter().enumerate().map(cell).collect()
    };
    bases.flat_map(runs).collect()
}
