//! `densify compare`.

mod cell;
mod contender;
mod crops;
mod difference;
mod plots;
mod table;

use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};

use clap::Args;

use super::console::Console;
use super::flags;
use super::study::{Records, common, labels};
use crate::failure::Failure;
use crate::number;
use crate::output::write_atomically;
use cell::{Cell, Record};
use contender::Contender;

/// Trains a scene with several policies, under the same conditions, and says which did best.
///
/// Every policy runs with every budget and every seed, one run after another. A run that is
/// finished is not run again: call the same command to go on after an interruption. The folder then
/// holds compare.md (tables and pictures), compare.jsonl (a record per run), plots as SVG, and the
/// runs themselves.
///
/// Quality is measured on views held out. Differences are taken between runs of the same scene,
/// budget and seed, against the first policy named, with 95 % bootstrap intervals of their mean. A
/// run whose peak exceeded its budget is marked, and takes no part in the ranking. Where the geometry
/// is known (built-in scenes, and those that `densify scenegen` wrote), the tables also say how well
/// the Gaussians sit on it.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct CompareArgs {
    /// Folders of the scenes, or built-in scenes (scene:NAME)
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    /// Policies, separated by commas; the others are compared with the first. A policy with
    /// parameters of its own is one more: diet:rho=0, or diet:rho=0:split=random
    #[arg(long, value_name = "NAMES", value_delimiter = ',', required = true)]
    policies: Vec<String>,
    /// Budgets in Gaussians, separated by commas; SCENE=ROWS for one scene alone, by its folder's
    /// name, which then takes part with these only
    #[arg(short, long, value_name = "ROWS", value_delimiter = ',', required = true, value_parser = budget)]
    budget: Vec<Budget>,
    /// Runs of each kind, with seeds 0, 1, …
    #[arg(long, value_name = "K", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    seeds: u32,
    /// Length of each run
    #[arg(short, long, value_name = "N", default_value_t = 7_000, value_parser = clap::value_parser!(u32).range(1..))]
    iterations: u32,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR", default_value = "comparison")]
    output: PathBuf,
    /// Options of `densify train` for every run
    #[arg(last = true, value_name = "TRAIN OPTIONS")]
    train: Vec<String>,
}

/// A budget that is asked for.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Budget {
    /// The label of the only scene that it is for.
    scene: Option<String>,
    rows: usize,
}

impl fmt::Display for Budget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.scene {
            Some(scene) => write!(f, "{scene}={}", self.rows),
            None => write!(f, "{}", self.rows),
        }
    }
}

fn budget(text: &str) -> Result<Budget, String> {
    let (scene, rows) = match text.rsplit_once('=') {
        Some((scene, rows)) => (Some(scene.to_owned()), rows),
        None => (None, text),
    };
    Ok(Budget { scene, rows: number::rows(rows)? })
}

const EXAMPLES: &str = "\
Examples:
  densify compare data/garden --policies vanilla,diet --budget 200k
  densify compare data/room data/cup --policies diet,taming,mcmc --budget 15k,30k,60k --seeds 5
  densify compare data/garden --policies vanilla,diet --budget 1M -- -r 4 --sh-degree 2
  densify compare data/room data/cup --policies vanilla,diet --budget room=28k,30k
  densify compare data/garden --policies diet,diet:rho=0,diet:full_depth=0 --budget 200k
  densify compare scene:table scene:thin --policies vanilla,diet --budget 10k --iterations 3000";

/// Options of `densify train` that are the comparison's to set.
const OWN_OPTIONS: [&str; 7] =
    ["scene", "policy", "budget", "seed", "iterations", "output", "test_iterations"];
/// Measurements along each run, for the curves.
const POINTS: u32 = 8;

pub(super) fn run(args: &CompareArgs, console: &Console) -> Result<(), Failure> {
    let cells = cells(args)?;
    let mut records = Records::open(&args.output.join("compare.jsonl"))?;
    for (i, cell) in cells.iter().enumerate() {
        let (number, count) = (i + 1, cells.len());
        if records.of(cell).is_some() {
            console.say(format_args!("[{number}/{count}] {cell}: done before"));
            continue;
        }
        console.say(format_args!("[{number}/{count}] {cell}"));
        records.add(cell.train(&args.output)?)?;
    }
    let records: Vec<&Record> = cells.iter().filter_map(|cell| records.of(cell)).collect();
    let mut text = table::markdown(&records, &args.policies);
    text += "\n## Pictures\n";
    for picture in plots::draw(&args.output, &records, &args.policies)? {
        text += &format!("\n![{}]({})\n", picture.caption, picture.file);
    }
    for picture in crops::draw(&args.output, &records, console)? {
        text += &format!("\n![{}]({})\n\n{}.\n", picture.caption, picture.file, picture.caption);
    }
    let path = args.output.join("compare.md");
    write_atomically(&path, |out| out.write_all(text.as_bytes()))?;
    console.result(table::summary(&records, &args.policies));
    console.result(format_args!("everything in {}", path.display()));
    Ok(())
}

/// A file in the output folder, and what it shows.
struct Picture {
    file: String,
    caption: String,
}

/// All runs, in the order in which they run: seed after seed, so that an interrupted comparison is a
/// fair one of fewer seeds.
fn cells(args: &CompareArgs) -> Result<Vec<Cell>, Failure> {
    let train = common(flags::parsed(&args.train, "densify compare ... --")?, &OWN_OPTIONS)?;
    unique(&args.policies, "--policies")?;
    unique(&args.budget, "--budget")?;
    let labels = labels(&args.scenes)?;
    let budgets = budgets(&args.budget, &labels)?;
    let least = budgets.iter().flatten().copied().min().unwrap_or(1);
    for policy in &args.policies {
        Contender::new(policy).check(least, args.iterations)?;
    }
    let mut cells = Vec::new();
    for seed in 0..args.seeds {
        for ((scene, label), budgets) in args.scenes.iter().zip(&labels).zip(&budgets) {
            for &budget in budgets {
                for policy in &args.policies {
                    cells.push(Cell {
                        scene: scene.clone(),
                        label: label.clone(),
                        policy: policy.clone(),
                        budget,
                        seed,
                        iterations: args.iterations,
                        train: train.clone(),
                    });
                }
            }
        }
    }
    Ok(cells)
}

fn unique<T: Ord + std::fmt::Display>(values: &[T], flag: &str) -> Result<(), Failure> {
    let mut seen = BTreeSet::new();
    match values.iter().find(|&value| !seen.insert(value)) {
        Some(twice) => Err(Failure::input(format!("{flag} names {twice} twice"))),
        None => Ok(()),
    }
}

/// The budgets of each scene: its own, or else those for all.
fn budgets(asked: &[Budget], labels: &[String]) -> Result<Vec<Vec<usize>>, Failure> {
    let stranger = asked.iter().find(|b| b.scene.as_ref().is_some_and(|s| !labels.contains(s)));
    if let Some(stranger) = stranger {
        return Err(Failure::input(format!(
            "--budget {stranger} is for none of the scenes; they are called {}",
            labels.join(", ")
        )));
    }
    let of = |scene: Option<&String>| -> Vec<usize> {
        asked.iter().filter(|b| b.scene.as_ref() == scene).map(|b| b.rows).collect()
    };
    let one = |label: &String| {
        let own = of(Some(label));
        let rows = if own.is_empty() { of(None) } else { own };
        if rows.is_empty() {
            return Err(Failure::input(format!(
                "--budget has none for {label}; add {label}=ROWS, or ROWS for all scenes"
            )));
        }
        Ok(rows)
    };
    labels.iter().map(one).collect()
}

/// Distinct values of a property of the records, in the order of their appearance.
fn distinct<'a, T: PartialEq>(records: &[&'a Record], of: impl Fn(&'a Record) -> T) -> Vec<T> {
    let mut values = Vec::new();
    for record in records {
        let value = of(record);
        if !values.contains(&value) {
            values.push(value);
        }
    }
    values
}

/// The budgets of a scene, in the order of their appearance.
fn budgets_of(records: &[&Record], scene: &str) -> Vec<usize> {
    let here: Vec<&Record> = records.iter().filter(|r| r.scene == scene).copied().collect();
    distinct(&here, |r| r.budget)
}

/// Where a cell's run is.
fn run_folder(output: &Path, record: &Record) -> PathBuf {
    output.join("runs").join(&record.run)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_with_budgets_of_its_own_takes_no_others() {
        let labels = ["room".to_owned(), "cup".to_owned()];
        let of = |text: &str| {
            let asked: Result<Vec<Budget>, String> = text.split(',').map(budget).collect();
            budgets(&asked.expect("they parse"), &labels)
        };
        let rows = |text| of(text).map_err(|failure| failure.message);
        assert_eq!(rows("30k"), Ok(vec![vec![30_000]; 2]));
        assert_eq!(rows("30k,room=28k,room=1k"), Ok(vec![vec![28_000, 1_000], vec![30_000]]));
        assert!(rows("room=28k").is_err_and(|m| m.contains("cup=ROWS")));
        assert!(rows("30k,rom=28k").is_err_and(|m| m.contains("rom=28000") && m.contains("room")));
        for text in ["room=", "=", "room=x"] {
            assert!(budget(text).is_err(), "{text}");
        }
    }
}
