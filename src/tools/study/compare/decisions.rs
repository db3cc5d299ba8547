//! `--until-decided`: which comparisons are decided, and which runs the others need.

use clap::ValueEnum;

use super::{Outcome, scenes_and_limits};
use crate::Limit;
use crate::difference::mean;
use crate::distinct;
use crate::planned_run::PlannedRun;
use crate::sequential::{Decision, Rule, Verdict};
use crate::text_table::TextTable;
use densify_html::{Column, Document, Table, Text};

/// What `--until-decided` decides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Decide {
    /// Every scene, under every limit
    Scenes,
    /// The mean over the scenes
    Mean,
}

impl Decide {
    fn words(self) -> &'static str {
        match self {
            Self::Scenes => "On each scene, under each limit",
            Self::Mean => "For the mean over the scenes",
        }
    }

    /// The rule in words, for the terminal and the report.
    pub(super) fn text(self, rule: Rule, base: &str) -> String {
        rule.text(base, self.words())
    }
}

/// A comparison of a policy with the first.
pub(super) struct Case {
    policy: String,
    /// Scene and limit; `None` for the mean over all.
    place: Option<(String, Limit)>,
    /// Number of seeds that were tried, whether or not they count.
    tried: u32,
    pub(super) decision: Decision,
}

impl Case {
    fn place(&self) -> String {
        let name = self.place.as_ref().map(|(scene, limit)| format!("{scene}, {limit}"));
        name.unwrap_or_else(|| "mean over the scenes".to_owned())
    }

    fn is_at(&self, run: &PlannedRun) -> bool {
        let place = |(scene, limit): &(String, Limit)| run.label == *scene && run.limit() == *limit;
        self.place.as_ref().is_none_or(place)
    }
}

/// All comparisons, by policy.
pub(super) fn cases(
    outcomes: &[Outcome],
    policies: &[String],
    decide: Decide,
    rule: Rule,
) -> Vec<Case> {
    let Some((base, others)) = policies.split_first() else { return Vec::new() };
    let places = scenes_and_limits(outcomes);
    let case = |policy: &String, at: &[(&str, Limit)]| {
        let differences = differences(outcomes, [policy, base], at);
        let is_here = |run: &&Outcome| {
            run.factor == *policy && at.contains(&(run.scene.as_str(), run.limit()))
        };
        let tried = outcomes.iter().filter(is_here).map(|run| run.seed + 1).max().unwrap_or(0);
        let place = (decide == Decide::Scenes).then(|| (at[0].0.to_owned(), at[0].1));
        Case { policy: policy.clone(), place, tried, decision: rule.decide(&differences) }
    };
    let groups: Vec<Vec<(&str, Limit)>> = match decide {
        _ if places.is_empty() => Vec::new(),
        Decide::Scenes => places.iter().map(|place| vec![*place]).collect(),
        Decide::Mean => vec![places],
    };
    others.iter().flat_map(|policy| groups.iter().map(|at| case(policy, at))).collect()
}

/// Differences in PSNR of the first policy from the second by seed: the mean over scenes of the means over limits. Seeds
/// count for which all runs exist and kept their budgets.
fn differences(outcomes: &[Outcome], policies: [&String; 2], places: &[(&str, Limit)]) -> Vec<f64> {
    let mut seeds = distinct(outcomes.iter().map(|run| run.seed));
    seeds.sort_unstable();
    let scenes = distinct(places.iter().map(|(scene, _)| *scene));
    let psnr = |policy: &String, (scene, limit): (&str, Limit), seed: u32| {
        let is_it = |run: &&Outcome| {
            run.factor == *policy && run.seed == seed && run.scene == scene && run.limit() == limit
        };
        outcomes.iter().find(is_it).filter(|run| run.kept_its_budget()).map(|run| run.psnr)
    };
    let of_seed = |seed: u32| {
        let of_scene = |scene: &str| {
            let here = places.iter().filter(|(other, _)| *other == scene);
            let difference = |place: &(&str, Limit)| {
                Some(psnr(policies[0], *place, seed)? - psnr(policies[1], *place, seed)?)
            };
            mean(here.map(difference).collect::<Option<Vec<f64>>>()?)
        };
        mean(scenes.iter().map(|scene| of_scene(scene)).collect::<Option<Vec<f64>>>()?)
    };
    seeds.into_iter().filter_map(of_seed).collect()
}

/// The runs of the next seed that undecided comparisons need, those of the first policy included. `all` are the runs of
/// all seeds that the rule allows.
pub(super) fn next_runs(cases: &[Case], all: &[PlannedRun], base: &str) -> Vec<PlannedRun> {
    let open = || cases.iter().filter(|case| case.decision.verdict == Verdict::Undecided);
    let is_needed = |run: &&PlannedRun| {
        open().any(|case| {
            let is_policy = run.factor == case.policy || run.factor == base;
            is_policy && run.seed == case.tried && case.is_at(run)
        })
    };
    all.iter().filter(is_needed).cloned().collect()
}

/// Names the comparisons that are undecided.
pub(super) fn undecided(cases: &[Case]) -> String {
    let open = cases.iter().filter(|case| case.decision.verdict == Verdict::Undecided);
    let names: Vec<String> =
        open.map(|case| format!("{} ({})", case.policy, case.place())).collect();
    names.join("; ")
}

const TITLES: [&str; 5] = ["policy", "where", "difference in PSNR [dB]", "seeds", "verdict"];

fn row(case: &Case) -> [String; 5] {
    let Case { policy, decision, .. } = case;
    let seeds = decision.seeds.to_string();
    [policy.clone(), case.place(), decision.difference(), seeds, decision.words()]
}

/// Adds the rule and the verdicts.
pub(super) fn add(document: &mut Document, cases: &[Case], rule: &str) {
    document.section("Decisions");
    document.paragraph(format!(
        "The rule, fixed before the first run: {rule}. The intervals of the other tables are those of a \
         fixed number of seeds."
    ));
    let mut table = Table::new(TITLES.map(Column::text));
    for case in cases {
        table.row(row(case).map(Text::from));
    }
    document.table(table);
}

/// Formats the verdicts for the terminal.
pub(super) fn format(cases: &[Case]) -> String {
    let mut table = TextTable::new(&["<policy", "<where", "<PSNR [dB]", ">seeds", "<verdict"]);
    for case in cases {
        table.row(row(case).to_vec());
    }
    table.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::sample;

    fn run(policy: &str, scene: &str, seed: u32, psnr: f64) -> Outcome {
        Outcome { scene: scene.into(), ..sample(policy, "1000", seed, psnr) }
    }

    /// b is far better in room, c the same as a; in cup, seeds disagree.
    fn outcomes() -> Vec<Outcome> {
        let seed = |seed: u32| {
            let base = 30.0 + f64::from(seed);
            let sign = [1.0, -1.0, 0.5][seed as usize];
            [
                run("a", "room", seed, base),
                run("b", "room", seed, base + 2.0 + 0.01 * sign),
                run("c", "room", seed, base),
                run("a", "cup", seed, base),
                run("b", "cup", seed, base + sign),
                run("c", "cup", seed, base - 1.0 + 0.01 * sign),
            ]
        };
        (0..3).flat_map(seed).collect()
    }

    fn planned(seeds: std::ops::Range<u32>) -> Vec<PlannedRun> {
        let run = |seed, scene: &str, policy: &str| PlannedRun {
            label: scene.into(),
            factor: policy.into(),
            budget: 1000,
            seed,
            ..PlannedRun::default()
        };
        let scenes =
            |seed| ["room", "cup"].map(|scene| ["a", "b", "c"].map(|p| run(seed, scene, p)));
        seeds.flat_map(|seed| scenes(seed).into_iter().flatten()).collect()
    }

    fn names(runs: &[PlannedRun]) -> Vec<String> {
        runs.iter().map(|run| format!("{} {} {}", run.label, run.factor, run.seed)).collect()
    }

    #[test]
    fn only_undecided_scenes_get_more_seeds() {
        let policies = ["a", "b", "c"].map(String::from);
        let rule = Rule::new(12);
        let cases = cases(&outcomes(), &policies, Decide::Scenes, rule);
        let words: Vec<String> = cases.iter().map(|case| row(case).join(" | ")).collect();
        let expected = [
            "b | room, 1,000 rows | +2.00 [+1.94, +2.06] | 3 | better",
            "b | cup, 1,000 rows | +0.17 [-5.62, +5.96] | 3 | undecided",
            "c | room, 1,000 rows | +0.00 [+0.00, +0.00] | 3 | not worse",
            "c | cup, 1,000 rows | -1.00 [-1.06, -0.94] | 3 | worse",
        ];
        assert_eq!(words, expected);
        let next = next_runs(&cases, &planned(0..12), "a");
        assert_eq!(names(&next), ["cup a 3", "cup b 3"]);
        assert_eq!(undecided(&cases), "b (cup, 1,000 rows)");
        // At the last seed that is allowed, nothing is left to run.
        assert_eq!(next_runs(&cases, &planned(0..3), "a"), []);
        let mut document = Document::new("");
        add(&mut document, &cases, &Decide::Scenes.text(rule, "a"));
        let text = document.to_string();
        assert!(
            text.contains("| b | cup, 1,000 rows |") && text.contains("from 3 to 12"),
            "{text}"
        );
    }

    #[test]
    fn the_mean_over_scenes_needs_all_scenes() {
        let policies = ["a", "b", "c"].map(String::from);
        let mut outcomes = outcomes();
        let decided = cases(&outcomes, &policies, Decide::Mean, Rule::new(12));
        // b: means of 2.01 and 1, 1.99 and −1, 2.005 and 0.5.
        assert_eq!(decided[0].decision.difference(), "+1.08 [-1.84, +4.01]");
        assert_eq!(decided[1].decision.words(), "worse");
        let next = next_runs(&decided, &planned(0..12), "a");
        assert_eq!(names(&next), ["room a 3", "room b 3", "cup a 3", "cup b 3"]);
        // A run that broke its budget takes its seed out of the mean.
        outcomes[1].peak_rows = 1001;
        let fewer = cases(&outcomes, &policies, Decide::Mean, Rule::new(12));
        assert_eq!(fewer[0].decision.seeds, 2);
        assert_eq!(fewer[0].decision.verdict, Verdict::Undecided);
        assert!(cases(&[], &policies, Decide::Mean, Rule::new(12)).is_empty());
    }
}
