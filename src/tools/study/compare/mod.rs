//! `densify compare`: policies under equal conditions at several budgets.

mod counts;
mod crops;
mod decisions;
mod exchange;
mod plots;
mod policy_variant;
mod ranking;
mod report;
mod scene_limit;
mod spreads;

use std::collections::BTreeSet;
use std::fmt;
use std::path::PathBuf;

use clap::Args;
use densify_policies::registry;
use toml::Value;

use super::difference::{Difference, Pair};
use super::outcome::Outcome;
use super::planned_run::PlannedRun;
use super::sequential::{Rule, SEEDS};
use super::{EngineArgs, Finished, Limit, Study, about, distinct, labels, shared_options};
pub use decisions::Decide;
use densify_run::failure::Failure;
use densify_run::{DEFAULT_BUDGET, Observer, Partial};
use policy_variant::PolicyVariant;
pub use scene_limit::SceneLimit;
use scene_limit::limits_of_scenes;

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
  densify compare data/garden --policies diet,igs --memory 512MiB,1GiB
  densify compare data/room data/cup --policies diet,merit --budget 200k --until-decided --hours 8
  densify compare scene:table scene:thin --policies vanilla,diet --budget 10k --iterations 3000";

/// Trains a scene with several policies, under the same conditions, and says which did best.
///
/// Every policy runs under every limit with every seed, one run after another, the longest first.
/// Finished runs are not repeated: after an interruption, the same command continues. With --hours,
/// only what fits is started; with --until-decided, seeds are added where they are needed. With
/// --engine the runs can be trained on a cluster. The folder then holds compare.md (tables and
/// pictures), compare.html (the same as one file), compare.jsonl (a record per run with the scores of
/// every view), plots as SVG, results/ (scores in the formats of NerfBaselines and 3DGS.zip), and the
/// runs themselves.
///
/// Quality is measured on held-out views. Differences are between runs of the same scene, limit and
/// seed, against the first policy named, with 95 % intervals of their mean for three seeds or more;
/// policies are ranked by that mean. A run whose peak exceeded its budget is marked and not ranked.
/// The limit bounds the peak, and some policies end far below it, so the number of Gaussians at the
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
    #[arg(short, long, value_name = "ROWS", value_delimiter = ',', required_unless_present = "memory", value_parser = SceneLimit::rows)]
    pub budget: Vec<SceneLimit>,
    /// Limits of the memory of each run, instead of budgets or in addition; a policy that needs less per
    /// Gaussian then has more of them. Spelled like --budget
    #[arg(long, value_name = "BYTES", value_delimiter = ',', value_parser = SceneLimit::memory)]
    pub memory: Vec<SceneLimit>,
    /// Number of runs of each policy under each limit, with seeds 0, 1, …; with --until-decided, the
    /// number to begin with
    #[arg(long, value_name = "K", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub seeds: u32,
    /// Add seeds until it is decided whether each policy is better than the first, worse, or not worse,
    /// on every scene or in the mean over the scenes; the rule is shown before `[default: scenes]`
    #[arg(long, value_name = "WHAT", num_args = 0..=1, require_equals = true, default_missing_value = "scenes")]
    pub until_decided: Option<Decide>,
    /// Largest number of seeds with --until-decided
    #[arg(long, value_name = "K", default_value_t = 12, value_parser = clap::value_parser!(u32).range(SEEDS), requires = "until_decided")]
    pub max_seeds: u32,
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

impl Comparison {
    /// Trains the runs that are not done yet, all with the options `train`, and writes tables and pictures; `None`
    /// while a scheduler still has unfinished runs.
    pub fn run(
        &self,
        train: Partial,
        observer: &dyn Observer,
    ) -> Result<Option<Finished>, Failure> {
        let policies = all_policies(&self.policies)?;
        let rule = self.rule(&policies)?;
        let runs = self.plan_runs(&policies, train)?;
        let mut study = Study::open(&self.output, "compare", &self.engine, observer)?;
        if let Some((_, _, text)) = &rule {
            observer.say(format_args!("rule     {text}"));
        }
        let Some(outcomes) = self.train(&runs, &policies, rule.as_ref(), &mut study)? else {
            return Ok(None);
        };
        if outcomes.is_empty() {
            return Err(Failure::input("no run is done yet; give --hours more"));
        }
        let mut document = report::document(&outcomes, &policies);
        let mut summary = report::summary(&outcomes, &policies);
        if let Some((decide, rule, text)) = &rule {
            let cases = decisions::cases(&outcomes, &policies, *decide, *rule);
            decisions::add(&mut document, &cases, text);
            summary += &format!("\n{}\n", decisions::format(&cases));
        }
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
        exchange::write(&self.output, &outcomes, &policies)?;
        study.finish(&document, summary).map(Some)
    }

    /// The rule of `--until-decided`, with its text.
    fn rule(&self, policies: &[String]) -> Result<Option<(Decide, Rule, String)>, Failure> {
        let Some(decide) = self.until_decided else { return Ok(None) };
        self.engine.require_here("--until-decided")?;
        let [base, _, ..] = policies else {
            return Err(Failure::input("--until-decided: name at least two policies"));
        };
        if self.max_seeds < self.seeds {
            return Err(Failure::input(format!(
                "--seeds {} is more than --max-seeds {}; lower one or raise the other",
                self.seeds, self.max_seeds
            )));
        }
        let rule = Rule::new(self.max_seeds);
        Ok(Some((decide, rule, decide.text(rule, base))))
    }

    /// Trains the runs of the first seeds, and then those that the rule asks for. Returns the outcomes; `None` while
    /// a scheduler has unfinished runs.
    fn train(
        &self,
        runs: &[PlannedRun],
        policies: &[String],
        rule: Option<&(Decide, Rule, String)>,
        study: &mut Study<'_>,
    ) -> Result<Option<Vec<Outcome>>, Failure> {
        let at_first = |run: &&PlannedRun| run.seed < self.seeds;
        let mut next: Vec<PlannedRun> = runs.iter().filter(at_first).cloned().collect();
        if rule.is_some() && study.seconds_of(&next)? > 0.0 {
            let further: Vec<PlannedRun> =
                runs.iter().filter(|run| run.seed == self.seeds).cloned().collect();
            let seconds = study.seconds_of(&further)?;
            study.observer.say(format_args!(
                "seeds    {} to begin with, at most {}; a further one of all comparisons takes {}",
                self.seeds,
                self.max_seeds,
                about(seconds)
            ));
        }
        let mut outcomes = Vec::new();
        while !next.is_empty() {
            let Some(ran) = study.run(&next)? else { return Ok(None) };
            outcomes.extend(ran.outcomes);
            let (Some((decide, rule, _)), true) = (rule, ran.left.is_empty()) else { break };
            let cases = decisions::cases(&outcomes, policies, *decide, *rule);
            next = decisions::next_runs(&cases, runs, &policies[0]);
            if !next.is_empty() {
                let open = decisions::undecided(&cases);
                study.observer.say(format_args!("undecided {open}: one more seed"));
            }
        }
        Ok(Some(outcomes))
    }

    /// All runs that may be trained: seed after seed, so that an interrupted comparison is still fair.
    fn plan_runs(&self, policies: &[String], train: Partial) -> Result<Vec<PlannedRun>, Failure> {
        let own_memory = if self.memory.is_empty() { &[][..] } else { &["memory"] };
        let shared = shared_options(train, &[&OWN_OPTIONS, own_memory].concat())?;
        require_unique(&self.budget, "--budget")?;
        require_unique(&self.memory, "--memory")?;
        let labels = labels(&self.scenes)?;
        let limits = limits_of_scenes(&self.budget, &self.memory, &labels)?;
        let rows = |limit: &Limit| match limit {
            Limit::Rows(rows) => Some(*rows),
            Limit::Memory(_) => None,
        };
        let smallest = limits.iter().flatten().filter_map(rows).min().unwrap_or(DEFAULT_BUDGET);
        let variants: Vec<PolicyVariant<'_>> =
            policies.iter().map(|policy| PolicyVariant::parse(policy)).collect();
        for variant in &variants {
            variant.check(smallest, self.iterations)?;
        }
        let steps = (1..EVALUATIONS).map(|i| i64::from((self.iterations * i / EVALUATIONS).max(1)));
        let shared = Partial::option("test_iterations", steps.map(Value::from).collect::<Vec<_>>())
            .over(shared);
        let mut runs = Vec::new();
        let seeds = if self.until_decided.is_some() { self.max_seeds } else { self.seeds };
        for seed in 0..seeds {
            for ((scene, label), limits) in self.scenes.iter().zip(&labels).zip(&limits) {
                for &limit in limits {
                    let base =
                        PlannedRun::new(&shared, (scene, label), limit, seed, self.iterations);
                    for (policy, variant) in policies.iter().zip(&variants) {
                        runs.push(PlannedRun {
                            factor: policy.clone(),
                            level: limit.word(),
                            title: format!("{policy}, {limit}"),
                            folder: format!("{}-{}", variant.folder(), limit.word()),
                            set: format!("{label}, {limit}"),
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

/// The outcomes of a scene under a limit.
fn outcomes_at<'a>(outcomes: &'a [Outcome], scene: &str, limit: Limit) -> Vec<&'a Outcome> {
    outcomes.iter().filter(|run| run.scene == scene && run.limit() == limit).collect()
}

/// Pairs of scene and limit, in the order of the scenes' first appearance.
fn scenes_and_limits(outcomes: &[Outcome]) -> Vec<(&str, Limit)> {
    let runs: Vec<(&str, Limit)> = outcomes.iter().map(|run| (&*run.scene, run.limit())).collect();
    let scenes = distinct(runs.iter().map(|(scene, _)| *scene));
    let pairs = |scene: &str| distinct(runs.iter().copied().filter(|(other, _)| *other == scene));
    scenes.into_iter().flat_map(pairs).collect()
}

/// Difference of a policy from `base` over pairs of runs with the same scene, limit and seed that kept their budgets;
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
        let key = |r: &'a Outcome| (&r.scene, r.limit(), r.seed);
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
}
