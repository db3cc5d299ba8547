//! `densify compare`: policies under equal conditions at several budgets.

mod counts;
mod crops;
mod plots;
mod policy_variant;
mod ranking;
mod report;

use std::collections::BTreeSet;
use std::fmt;
use std::path::PathBuf;

use clap::Args;
use densify_policies::registry;
use toml::Value;

use super::difference::{Difference, Pair};
use super::outcome::Outcome;
use super::planned_run::PlannedRun;
use super::{EngineArgs, Finished, Study, distinct, labels, shared_options};
use densify_core::numbers::{self, grouped};
use densify_run::failure::Failure;
use densify_run::{Observer, Partial};
use policy_variant::PolicyVariant;

/// Options of a run that the comparison sets itself.
const OWN_OPTIONS: [&str; 8] =
    ["scene", "policy", "budget", "seed", "iterations", "output", "test_iterations", "view"];
/// The name that stands for all policies.
const ALL: &str = "all";
/// Number of evaluations during each run, for the curves.
const EVALUATIONS: u32 = 8;

const EXAMPLES: &str = "\
Examples:
  densify compare data/garden --policies vanilla,diet --budget 200k
  densify compare data/room data/cup --policies diet,taming,mcmc --budget 15k,30k,60k --seeds 5
  densify compare data/garden --policies vanilla,diet --budget 1M -- -r 4 --sh-degree 2
  densify compare data/room data/cup --policies vanilla,diet --budget room=28k,30k
  densify compare data/garden --policies diet,diet:rho=0,diet:full_depth=0 --budget 200k
  densify compare data/garden --policies vanilla,all --budget 200k
  densify compare scene:table scene:thin --policies vanilla,diet --budget 10k --iterations 3000";

/// Trains a scene with several policies, under the same conditions, and says which did best.
///
/// Every policy runs with every budget and every seed, one run after another. Finished runs are not
/// repeated: after an interruption, the same command continues. The folder then holds compare.md
/// (tables and pictures), compare.html (the same as one file), compare.jsonl (a record per run),
/// plots as SVG, and the runs themselves. With --engine the runs can be trained on a cluster.
///
/// Quality is measured on held-out views. Differences are between runs of the same scene, budget and
/// seed, against the first policy named, with 95 % intervals of their mean for three seeds or more;
/// policies are ranked by that mean. A run whose peak exceeded its budget is marked and not ranked.
/// The budget bounds the peak, and some policies end far below it, so the number of Gaussians at the
/// end is shown beside the peak. Where the geometry is known (built-in scenes, and those that
/// `densify scenegen` wrote), the tables also show how well the Gaussians match it.
#[derive(Debug, Clone, Args)]
#[command(after_help = EXAMPLES)]
pub struct Comparison {
    /// Folders of the scenes, or built-in scenes (scene:NAME)
    #[arg(required = true)]
    pub scenes: Vec<PathBuf>,
    /// Policies, separated by commas; the others are compared with the first. `all` stands for all that
    /// are not named otherwise. A policy with parameters counts as another policy: diet:rho=0, or
    /// diet:rho=0:split=random
    #[arg(long, value_name = "NAMES", value_delimiter = ',', required = true)]
    pub policies: Vec<String>,
    /// Budgets in Gaussians, separated by commas; SCENE=ROWS is for one scene, named by its folder,
    /// which then has no other budgets
    #[arg(short, long, value_name = "ROWS", value_delimiter = ',', required = true, value_parser = SceneBudget::parse)]
    pub budget: Vec<SceneBudget>,
    /// Number of runs of each policy at each budget, with seeds 0, 1, …
    #[arg(long, value_name = "K", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub seeds: u32,
    /// Length of each run
    #[arg(short, long, value_name = "N", default_value_t = 7_000, value_parser = clap::value_parser!(u32).range(1..))]
    pub iterations: u32,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR", default_value = "comparison")]
    pub output: PathBuf,
    /// Options of `densify train` for every run
    #[arg(last = true, value_name = "TRAIN OPTIONS")]
    pub train: Vec<String>,
    /// Where the runs are started.
    #[command(flatten)]
    pub engine: EngineArgs,
}

/// A budget for all scenes, or for one.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct SceneBudget {
    /// Label of the scene, if the budget is for one scene only.
    pub scene: Option<String>,
    /// Maximum number of Gaussians.
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
    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        let (scene, rows) = match text.rsplit_once('=') {
            Some((scene, rows)) => (Some(scene.to_owned()), rows),
            None => (None, text),
        };
        Ok(Self { scene, rows: numbers::rows(rows)? })
    }
}

impl Comparison {
    /// Trains the runs that are not done yet, all with the options `train`, and writes tables and pictures; `None`
    /// while a scheduler still has unfinished runs.
    pub fn run(
        &self,
        train: Partial,
        observer: &dyn Observer,
    ) -> Result<Option<Finished>, Failure> {
        let policies = all_policies(&self.policies)?;
        let runs = self.plan_runs(&policies, train)?;
        let mut study = Study::open(&self.output, "compare", observer)?;
        let Some(outcomes) = study.run(&runs, &self.engine)? else { return Ok(None) };
        let mut document = report::document(&outcomes, &policies);
        document.section("Pictures");
        for picture in plots::draw(&self.output, &outcomes, &policies, observer)? {
            document.picture(picture.file, picture.caption);
        }
        for picture in crops::draw(&self.output, &outcomes, observer)? {
            let text = format!("{}.", picture.caption);
            document.picture(picture.file, picture.caption);
            document.paragraph(text);
        }
        report::add_options(&mut document, &outcomes)?;
        study.finish("compare", &document, report::summary(&outcomes, &policies)).map(Some)
    }

    /// All runs in the order of training: seed after seed, so that an interrupted comparison is still fair.
    fn plan_runs(&self, policies: &[String], train: Partial) -> Result<Vec<PlannedRun>, Failure> {
        let shared = shared_options(train, &OWN_OPTIONS)?;
        require_unique(&self.budget, "--budget")?;
        let labels = labels(&self.scenes)?;
        let budgets = budgets(&self.budget, &labels)?;
        let smallest = budgets.iter().flatten().copied().min().unwrap_or(1);
        let variants: Vec<PolicyVariant<'_>> =
            policies.iter().map(|policy| PolicyVariant::parse(policy)).collect();
        for variant in &variants {
            variant.check(smallest, self.iterations)?;
        }
        let steps = (1..EVALUATIONS).map(|i| i64::from((self.iterations * i / EVALUATIONS).max(1)));
        let shared = Partial::option("test_iterations", steps.map(Value::from).collect::<Vec<_>>())
            .over(shared);
        let mut runs = Vec::new();
        for seed in 0..self.seeds {
            for ((scene, label), budgets) in self.scenes.iter().zip(&labels).zip(&budgets) {
                for &budget in budgets {
                    let base =
                        PlannedRun::new(&shared, (scene, label), budget, seed, self.iterations);
                    for (policy, variant) in policies.iter().zip(&variants) {
                        runs.push(PlannedRun {
                            factor: policy.clone(),
                            level: budget.to_string(),
                            title: format!("{policy}, {} rows", grouped(budget)),
                            folder: format!("{}-{budget}", variant.folder()),
                            spec: variant.options().over(base.spec.clone()),
                            ..base.clone()
                        });
                    }
                }
            }
        }
        Ok(runs)
    }
}

/// The named policies, each once. `all` stands for the registered policies that are not named otherwise, ordered by
/// name.
fn all_policies(named: &[String]) -> Result<Vec<String>, Failure> {
    require_unique(named, "--policies")?;
    let registered = registry::policies()?;
    let mut policies = Vec::new();
    for name in named {
        if name == ALL {
            let names = registered.iter().map(|entry| entry.name.to_owned());
            policies.extend(names.filter(|name| !named.contains(name)));
        } else {
            policies.push(name.clone());
        }
    }
    Ok(policies)
}

fn require_unique<T: Ord + fmt::Display>(values: &[T], flag: &str) -> Result<(), Failure> {
    let mut seen = BTreeSet::new();
    match values.iter().find(|&value| !seen.insert(value)) {
        Some(twice) => Err(Failure::input(format!("{flag} names {twice} twice"))),
        None => Ok(()),
    }
}

/// The budgets of each scene: its own, or else those for all scenes.
fn budgets(given: &[SceneBudget], labels: &[String]) -> Result<Vec<Vec<usize>>, Failure> {
    let unknown = given.iter().find(|b| b.scene.as_ref().is_some_and(|s| !labels.contains(s)));
    if let Some(unknown) = unknown {
        return Err(Failure::input(format!(
            "--budget {unknown} is for none of the scenes; they are called {}",
            labels.join(", ")
        )));
    }
    let rows_for = |scene: Option<&String>| -> Vec<usize> {
        given.iter().filter(|b| b.scene.as_ref() == scene).map(|b| b.rows).collect()
    };
    let scene_budgets = |label: &String| {
        let own = rows_for(Some(label));
        let rows = if own.is_empty() { rows_for(None) } else { own };
        if rows.is_empty() {
            return Err(Failure::input(format!(
                "--budget gives no budget for {label}; add {label}=ROWS, or ROWS for all scenes"
            )));
        }
        Ok(rows)
    };
    labels.iter().map(scene_budgets).collect()
}

/// The outcomes of a scene at a budget.
fn outcomes_at<'a>(outcomes: &'a [Outcome], scene: &str, budget: usize) -> Vec<&'a Outcome> {
    outcomes.iter().filter(|run| run.scene == scene && run.budget == budget).collect()
}

/// Pairs of scene and budget, in the order of the scenes' first appearance.
fn scenes_and_budgets(outcomes: &[Outcome]) -> Vec<(&str, usize)> {
    let runs: Vec<(&str, usize)> = outcomes.iter().map(|run| (&*run.scene, run.budget)).collect();
    let scenes = distinct(runs.iter().map(|(scene, _)| *scene));
    let pairs = |scene: &str| distinct(runs.iter().copied().filter(|(other, _)| *other == scene));
    scenes.into_iter().flat_map(pairs).collect()
}

/// Difference of a policy from `base` over pairs of runs with the same scene, budget and seed that kept their budgets;
/// `None` if there is no pair.
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
        Some(Pair { scene: &run.scene, seed: run.seed, difference: score(run) - score(other) })
    });
    Difference::new(&pairs.collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_stands_for_the_policies_that_are_not_named_otherwise() {
        let expanded = |text: &str| {
            let named: Vec<String> = text.split(',').map(String::from).collect();
            all_policies(&named).map_err(|failure| failure.to_string())
        };
        let registered = registry::policies().expect("the registry is sound");
        let names = || registered.iter().map(|entry| entry.name.to_owned());
        let without = |left_out: &str| names().filter(|name| name != left_out).collect::<Vec<_>>();
        assert_eq!(expanded("all"), Ok(names().collect()));
        let (vanilla, others) = (vec!["vanilla".to_owned()], without("vanilla"));
        assert_eq!(expanded("vanilla,all"), Ok([&*vanilla, &others].concat()));
        assert_eq!(expanded("all,vanilla"), Ok([&*others, &vanilla].concat()));
        // A policy with parameters is an additional one.
        let all = expanded("diet:rho=0,all").expect("they are known");
        assert_eq!((all[0].as_str(), all[1..].to_vec()), ("diet:rho=0", names().collect()));
        assert!(expanded("all,diet,all").is_err_and(|message| message.contains("all twice")));
    }

    #[test]
    fn a_scene_with_budgets_of_its_own_takes_no_others() {
        let labels = ["room".to_owned(), "cup".to_owned()];
        let rows = |text: &str| {
            let given: Result<Vec<_>, _> = text.split(',').map(SceneBudget::parse).collect();
            budgets(&given.expect("they parse"), &labels).map_err(|failure| failure.to_string())
        };
        assert_eq!(rows("30k"), Ok(vec![vec![30_000]; 2]));
        assert_eq!(rows("30k,room=28k,room=1k"), Ok(vec![vec![28_000, 1_000], vec![30_000]]));
        assert!(rows("room=28k").is_err_and(|m| m.contains("cup=ROWS")));
        assert!(rows("30k,rom=28k").is_err_and(|m| m.contains("rom=28000") && m.contains("room")));
        for text in ["room=", "=", "room=x"] {
            assert!(SceneBudget::parse(text).is_err(), "{text}");
        }
    }
}
