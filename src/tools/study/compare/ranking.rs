//! Ranks the policies in each score by their difference from the first, with intervals.

use super::{Outcome, difference};
use crate::difference::{Difference, mean};
use crate::text_table::{TextTable, number_or_dash, or_dash};
use densify_html::{Column, Table};

/// A score of a run.
struct Score {
    title: &'static str,
    value: fn(&Outcome) -> f64,
    digits: usize,
    /// True if lower values are better.
    is_error: bool,
}

const SCORES: [Score; 3] = [
    Score { title: "PSNR [dB]", value: |run| run.psnr, digits: 2, is_error: false },
    Score { title: "SSIM", value: |run| run.ssim, digits: 4, is_error: false },
    Score { title: "FLIP", value: |run| run.flip, digits: 4, is_error: true },
];

/// A policy's result in a score.
struct Standing {
    /// Mean over its runs that kept their budget.
    mean: Option<f64>,
    /// Difference from the first policy; `None` for that policy itself, and without a pair of runs that kept their
    /// budgets.
    difference: Option<Difference>,
    /// Rank by mean difference, 1 for the best, shared by equal ones; `None` without a difference.
    rank: Option<usize>,
}

impl Standing {
    fn rank(&self) -> String {
        or_dash(self.rank.map(|rank| rank.to_string()))
    }
}

impl Score {
    /// The standing of each policy. Ranks are by the mean of paired differences, not by the policies' means, which
    /// would cover different scenes if a run broke its budget.
    fn standings(&self, outcomes: &[Outcome], policies: &[String]) -> Vec<Standing> {
        let first = policies.first().map_or("", String::as_str);
        let standing = |policy: &String| {
            let runs = outcomes.iter().filter(|r| r.factor == *policy && r.kept_its_budget());
            let difference = difference(outcomes.iter(), policy, first, self.value);
            let difference = difference.filter(|_| policy != first);
            Standing { mean: mean(runs.map(self.value)), difference, rank: None }
        };
        let mut standings: Vec<Standing> = policies.iter().map(standing).collect();
        // The gain over the first policy, which itself gains 0.
        let gain = |(index, standing): (usize, &Standing)| match index {
            0 => standing.mean.map(|_| 0.0),
            _ => standing.difference.map(|d| if self.is_error { -d.mean } else { d.mean }),
        };
        let gains: Vec<Option<f64>> = standings.iter().enumerate().map(gain).collect();
        for (standing, gain) in standings.iter_mut().zip(&gains) {
            let better = |gain: f64| gains.iter().flatten().filter(|other| **other > gain).count();
            standing.rank = gain.map(|gain| 1 + better(gain));
        }
        standings
    }
}

/// Tabulates ranks and differences in each score, in the order of the policies on the command line.
pub(super) fn table(outcomes: &[Outcome], policies: &[String]) -> Table {
    let titles = SCORES.iter().flat_map(|score| [score.title, "better in", "rank"]);
    let mut table = Table::new(std::iter::once("policy").chain(titles).map(Column::text));
    let all = SCORES.map(|score| (score.standings(outcomes, policies), score));
    for (index, policy) in policies.iter().enumerate() {
        let mut cells = vec![policy.clone()];
        for (standings, score) in &all {
            let standing = &standings[index];
            let (shown, better) = match standing.difference {
                Some(difference) => {
                    let better = if score.is_error { difference.below } else { difference.above };
                    (difference.format(score.digits), format!("{better} of {}", difference.pairs))
                }
                None if standing.rank.is_some() => ("–".to_owned(), "–".to_owned()),
                None => (
                    "not ranked: with no seed did it and the first policy both keep the budget"
                        .to_owned(),
                    "–".to_owned(),
                ),
            };
            cells.extend([shown, better, standing.rank()]);
        }
        table.row(cells);
    }
    table
}

/// Formats the ranking for the terminal, the best in PSNR first: means and ranks in each score, and the difference in
/// PSNR with its interval. Three intervals would not fit into a line; the report has them.
pub(super) fn format(outcomes: &[Outcome], policies: &[String]) -> String {
    let [psnr, ssim, flip] = SCORES.map(|score| (score.standings(outcomes, policies), score));
    let first = policies.first().map_or("", String::as_str);
    let mut table = TextTable::new(&[
        ">rank",
        "<policy",
        ">PSNR [dB]",
        &format!("<vs {first}"),
        ">SSIM",
        ">rank",
        ">FLIP",
        ">rank",
        ">runs",
        "<",
    ]);
    let mut order: Vec<usize> = (0..policies.len()).collect();
    // A stable sort keeps policies without a rank in the order of the command line.
    order.sort_by_key(|&index| psnr.0[index].rank.unwrap_or(usize::MAX));
    for index in order {
        let policy = &policies[index];
        let (kept, over): (Vec<&Outcome>, Vec<&Outcome>) =
            outcomes.iter().filter(|r| r.factor == *policy).partition(|r| r.kept_its_budget());
        let over = match over.len() {
            0 => String::new(),
            over => format!("(and {over} over the budget, not counted)"),
        };
        let standing = &psnr.0[index];
        let format = |difference: Difference| difference.format(psnr.1.digits);
        let mut cells = vec![
            standing.rank(),
            policy.clone(),
            number_or_dash(standing.mean, 3),
            standing.difference.map(format).unwrap_or_default(),
        ];
        for (standings, score) in [&ssim, &flip] {
            let Standing { mean, .. } = standings[index];
            cells.extend([number_or_dash(mean, score.digits), standings[index].rank()]);
        }
        cells.extend([kept.len().to_string(), over]);
        table.row(cells);
    }
    table.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::sample;

    /// An outcome in this scene. SSIM is PSNR / 100, and FLIP is 1 − SSIM.
    fn run(policy: &str, scene: &str, seed: u32, psnr: f64) -> Outcome {
        Outcome { scene: scene.into(), ..sample(policy, "1000", seed, psnr) }
    }

    #[test]
    fn ranks_are_by_paired_difference_and_less_error_is_better() {
        // In all three seeds b and d are better than a by 1, and c is worse by 1.
        let gain = [("a", 0.0), ("b", 1.0), ("c", -1.0), ("d", 1.0)];
        let all: Vec<Outcome> = (0..3)
            .flat_map(|seed| gain.map(|(policy, gain)| run(policy, "room", seed, 30.0 + gain)))
            .collect();
        let policies = ["a", "b", "c", "d"].map(String::from);
        for score in &SCORES {
            let ranks = score.standings(&all, &policies).iter().map(|s| s.rank).collect::<Vec<_>>();
            assert_eq!(ranks, [Some(3), Some(1), Some(4), Some(1)], "{}", score.title);
        }
        let text = table(&all, &policies).to_string();
        for row in [
            "| a | – | – | 3 | – | – | 3 | – | – | 3 |",
            "| b | +1.00 [+1.00, +1.00] | 3 of 3 | 1 | +0.0100 [+0.0100, +0.0100] | 3 of 3 | 1 | \
             -0.0100 [-0.0100, -0.0100] | 3 of 3 | 1 |",
            "| c | -1.00 [-1.00, -1.00] | 0 of 3 | 4 |",
        ] {
            assert!(text.contains(row), "{row} is not in {text}");
        }
        let text = format(&all, &policies);
        let expected = "\
rank  policy  PSNR [dB]  vs a                    SSIM  rank    FLIP  rank  runs
   1  b          31.000  +1.00 [+1.00, +1.00]  0.3100     1  0.6900     1     3
   1  d          31.000  +1.00 [+1.00, +1.00]  0.3100     1  0.6900     1     3
   3  a          30.000                        0.3000     3  0.7000     3     3
   4  c          29.000  -1.00 [-1.00, -1.00]  0.2900     4  0.7100     4     3";
        assert_eq!(text, expected, "{text}");
    }

    #[test]
    fn a_scene_where_a_policy_broke_its_budget_does_not_change_its_rank() {
        // b is better by 1 in the hard scene, where it kept its budget; in the easy scene it broke its budget, so that
        // run does not count. By its mean of 31, b would rank behind a with 35.
        let broken = Outcome { peak_rows: 1001, ..run("b", "easy", 0, 42.0) };
        let [a, b] = [run("a", "hard", 0, 30.0), run("b", "hard", 0, 31.0)];
        let all = [a, run("a", "easy", 0, 40.0), b, broken];
        let policies = ["a", "b"].map(String::from);
        let ranks = SCORES[0].standings(&all, &policies).iter().map(|s| s.rank).collect::<Vec<_>>();
        assert_eq!(ranks, [Some(2), Some(1)]);
        let text = format(&all, &policies);
        assert!(text.contains("1  b          31.000  +1.00, one run"), "{text}");
        assert!(text.contains("1  (and 1 over the budget, not counted)"), "{text}");
    }

    #[test]
    fn a_policy_that_broke_every_budget_has_no_rank() {
        let broken = Outcome { peak_rows: 1001, ..run("b", "room", 0, 99.0) };
        let all = [broken, run("a", "room", 0, 30.0), run("c", "room", 0, 29.0)];
        let text = table(&all, &["a", "b", "c"].map(String::from)).to_string();
        assert!(text.contains("| b | not ranked: with no seed did it and the first policy both keep the budget | – | – |"), "{text}");
        assert!(text.contains("| c | -1.00, one run | 0 of 1 | 2 |"), "{text}");
        let text = format(&all, &["b", "a", "c"].map(String::from));
        // Without runs of the first policy there are no differences.
        let mut ranked = text.lines().skip(1).filter(|line| !line.trim_start().starts_with('–'));
        assert_eq!(ranked.next(), None, "{text}");
    }
}
