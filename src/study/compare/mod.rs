//! The study behind `densify compare`: policies under equal conditions, at several budgets.

mod contender;
mod crops;
mod plots;
mod report;

use std::collections::BTreeSet;
use std::fmt;
use std::path::PathBuf;

use toml::Value;

use super::cell::{Cell, run_options};
use super::child::shared_options;
use super::difference::Difference;
use super::record::Outcome;
use super::{Finished, Study, distinct, labels};
use crate::failure::Failure;
use crate::number::{self, grouped};
use crate::run::{Observer, Partial};
use contender::Contender;

/// Options of a run that are the comparison's to set.
const OWN_OPTIONS: [&str; 7] =
    ["scene", "policy", "budget", "seed", "iterations", "output", "test_iterations"];
/// Measurements along each run, for the curves.
const POINTS: u32 = 8;

/// A comparison of policies: each with every budget and every seed.
#[derive(Debug, Clone)]
pub struct Comparison {
    /// Folders of the scenes, or built-in scenes.
    pub scenes: Vec<PathBuf>,
    /// Policies, as `NAME` or `NAME:PARAMETER=VALUE`; the others are compared with the first.
    pub policies: Vec<String>,
    /// Budgets of the scenes.
    pub budgets: Vec<SceneBudget>,
    /// Runs of each kind, with seeds from 0.
    pub seeds: u32,
    /// Length of each run.
    pub iterations: u32,
    /// Folder for the results.
    pub output: PathBuf,
    /// Options of every run.
    pub train: Partial,
}

/// A budget for all scenes, or for one.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct SceneBudget {
    /// The label of the only scene that it is for.
    pub scene: Option<String>,
    /// Most Gaussians.
    pub rows: usize,
}

impl fmt::Display for SceneBudget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.scene {
            Some(scene) => write!(f, "{scene}={}", self.rows),
            None => write!(f, "{}", self.rows),
        }
    }
}

impl SceneBudget {
    /// Reads `ROWS`, or `SCENE=ROWS` with the label of a scene.
    ///
    /// # Errors
    /// When there is no such number of rows.
    pub fn parse(text: &str) -> Result<Self, String> {
        let (scene, rows) = match text.rsplit_once('=') {
            Some((scene, rows)) => (Some(scene.to_owned()), rows),
            None => (None, text),
        };
        Ok(Self { scene, rows: number::rows(rows)? })
    }
}

impl Comparison {
    /// Makes the runs that are not done yet, and writes tables and pictures.
    ///
    /// # Errors
    /// When the comparison makes no sense, a run fails, or the folder cannot be written.
    pub fn run(&self, observer: &dyn Observer) -> Result<Finished, Failure> {
        let cells = self.cells()?;
        let mut study = Study::open(&self.output, "compare", observer)?;
        let outcomes = study.run(&cells)?;
        let mut text = report::markdown(&outcomes, &self.policies);
        text += "\n## Pictures\n";
        for picture in plots::draw(&self.output, &outcomes, &self.policies)? {
            text += &format!("\n![{}]({})\n", picture.caption, picture.file);
        }
        for picture in crops::draw(&self.output, &outcomes, observer)? {
            let caption = picture.caption;
            text += &format!("\n![{caption}]({})\n\n{caption}.\n", picture.file);
        }
        study.finish("compare", &text, report::summary(&outcomes, &self.policies))
    }

    /// All runs, in the order in which they run: seed after seed, so that an interrupted comparison is a
    /// fair one of fewer seeds.
    fn cells(&self) -> Result<Vec<Cell>, Failure> {
        let shared = shared_options(self.train.clone(), &OWN_OPTIONS)?;
        unique(&self.policies, "--policies")?;
        unique(&self.budgets, "--budget")?;
        let labels = labels(&self.scenes)?;
        let budgets = budgets(&self.budgets, &labels)?;
        let least = budgets.iter().flatten().copied().min().unwrap_or(1);
        let contenders: Vec<Contender<'_>> =
            self.policies.iter().map(|policy| Contender::new(policy)).collect();
        for contender in &contenders {
            contender.check(least, self.iterations)?;
        }
        let tests = (1..POINTS).map(|i| i64::from((self.iterations * i / POINTS).max(1)));
        let shared = Partial::option("test_iterations", tests.map(Value::from).collect::<Vec<_>>())
            .over(shared);
        let mut cells = Vec::new();
        for seed in 0..self.seeds {
            for ((scene, label), budgets) in self.scenes.iter().zip(&labels).zip(&budgets) {
                for &budget in budgets {
                    let options = run_options(&shared, scene, budget, seed, self.iterations);
                    cells.extend(self.policies.iter().zip(&contenders).map(
                        |(policy, contender)| Cell {
                            scene: scene.clone(),
                            label: label.clone(),
                            factor: policy.clone(),
                            level: budget.to_string(),
                            budget,
                            seed,
                            iterations: self.iterations,
                            title: format!("{policy}, {} rows", grouped(budget)),
                            folder: format!("{}-{budget}", contender.folder()),
                            spec: contender.options().over(options.clone()),
                            scores_without_shortcuts: false,
                        },
                    ));
                }
            }
        }
        Ok(cells)
    }
}

fn unique<T: Ord + std::fmt::Display>(values: &[T], flag: &str) -> Result<(), Failure> {
    let mut seen = BTreeSet::new();
    match values.iter().find(|&value| !seen.insert(value)) {
        Some(twice) => Err(Failure::input(format!("{flag} names {twice} twice"))),
        None => Ok(()),
    }
}

/// The budgets of each scene: its own, or else those for all.
fn budgets(asked: &[SceneBudget], labels: &[String]) -> Result<Vec<Vec<usize>>, Failure> {
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

/// The outcomes of a scene at a budget.
fn at<'a>(outcomes: &'a [Outcome], scene: &str, budget: usize) -> Vec<&'a Outcome> {
    outcomes.iter().filter(|run| run.scene == scene && run.budget == budget).collect()
}

/// The scenes with their budgets, in the order of their appearance.
fn scenes_and_budgets(outcomes: &[Outcome]) -> Vec<(&str, usize)> {
    let runs: Vec<(&str, usize)> = outcomes.iter().map(|run| (&*run.scene, run.budget)).collect();
    let scenes = distinct(runs.iter().map(|(scene, _)| *scene));
    let of_scene =
        |scene: &str| distinct(runs.iter().copied().filter(|(other, _)| *other == scene));
    scenes.into_iter().flat_map(of_scene).collect()
}

/// Differences of the policy's outcomes from those of `base` with the same scene, budget and seed. `None`
/// where there is no pair. Runs that broke their budget make no pair.
fn difference<'a>(
    outcomes: impl Iterator<Item = &'a Outcome> + Clone,
    policy: &str,
    base: &str,
    score: impl Fn(&Outcome) -> f64,
) -> Option<Difference> {
    let runs = |policy: &str| {
        let policy = policy.to_owned();
        outcomes.clone().filter(move |r| r.factor == policy && r.kept_its_budget())
    };
    let pairs = runs(policy).filter_map(|run| {
        let key = |r: &'a Outcome| (&r.scene, r.budget, r.seed);
        let other = runs(base).find(|other| key(other) == key(run))?;
        Some(score(run) - score(other))
    });
    Difference::new(&pairs.collect::<Vec<f64>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_with_budgets_of_its_own_takes_no_others() {
        let labels = ["room".to_owned(), "cup".to_owned()];
        let of = |text: &str| {
            let asked: Result<Vec<SceneBudget>, String> =
                text.split(',').map(SceneBudget::parse).collect();
            budgets(&asked.expect("they parse"), &labels)
        };
        let rows = |text| of(text).map_err(|failure| failure.message);
        assert_eq!(rows("30k"), Ok(vec![vec![30_000]; 2]));
        assert_eq!(rows("30k,room=28k,room=1k"), Ok(vec![vec![28_000, 1_000], vec![30_000]]));
        assert!(rows("room=28k").is_err_and(|m| m.contains("cup=ROWS")));
        assert!(rows("30k,rom=28k").is_err_and(|m| m.contains("rom=28000") && m.contains("room")));
        for text in ["room=", "=", "room=x"] {
            assert!(SceneBudget::parse(text).is_err(), "{text}");
        }
    }
}
