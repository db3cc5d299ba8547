//! Who did best: every policy against the first in each score, with ranks and intervals.

use super::{Outcome, difference};
use crate::columns::{Columns, number_or_dash};
use crate::difference::{Difference, mean};
use densify_html::{Column, Table};

/// A score of a run.
struct Score {
    title: &'static str,
    of: fn(&Outcome) -> f64,
    digits: usize,
    /// Whether less of it is better.
    is_error: bool,
}

const SCORES: [Score; 3] = [
    Score { title: "PSNR [dB]", of: |run| run.psnr, digits: 2, is_error: false },
    Score { title: "SSIM", of: |run| run.ssim, digits: 4, is_error: false },
    Score { title: "FLIP", of: |run| run.flip, digits: 4, is_error: true },
];

/// How a policy did in a score.
struct Standing {
    /// Over its runs that kept their budget.
    mean: Option<f64>,
    /// From the first policy; `None` for itself, and without a pair of runs that both kept their budget.
    difference: Option<Difference>,
    /// 1 for the best by mean difference, equal ones alike; `None` where there is nothing to rank by.
    rank: Option<usize>,
}

impl Standing {
    fn rank(&self) -> String {
        self.rank.map_or_else(|| "–".to_owned(), |rank| rank.to_string())
    }
}

impl Score {
    /// Every policy's standing. Ranks go by the mean of paired differences, not by the policies' own
    /// means: where a run broke its budget, these would be of other scenes.
    fn standings(&self, outcomes: &[Outcome], policies: &[String]) -> Vec<Standing> {
        let first = policies.first().map_or("", String::as_str);
        let mut standings: Vec<Standing> = policies
            .iter()
            .map(|policy| {
                let runs = outcomes.iter().filter(|r| r.factor == *policy && r.kept_its_budget());
                let versus = difference(outcomes.iter(), policy, first, self.of);
                Standing {
                    mean: mean(runs.map(self.of)),
                    difference: versus.filter(|_| policy != first),
                    rank: None,
                }
            })
            .collect();
        // What a policy gains over the first one, which gains nothing over itself.
        let gains: Vec<Option<f64>> = (standings.iter().enumerate())
            .map(|(place, standing)| match place {
                0 => standing.mean.map(|_| 0.0),
                _ => standing.difference.map(|d| if self.is_error { -d.mean } else { d.mean }),
            })
            .collect();
        for (standing, gain) in standings.iter_mut().zip(&gains) {
            let better = |gain: f64| gains.iter().flatten().filter(|other| **other > gain).count();
            standing.rank = gain.map(|gain| 1 + better(gain));
        }
        standings
    }
}

/// Ranks and differences in every score, in the order in which the policies were named.
pub(super) fn table(outcomes: &[Outcome], policies: &[String]) -> Table {
    let titles = SCORES.iter().flat_map(|score| [score.title, "better in", "rank"]);
    let mut table = Table::new(std::iter::once("policy").chain(titles).map(Column::text));
    let all = SCORES.map(|score| (score.standings(outcomes, policies), score));
    for (place, policy) in policies.iter().enumerate() {
        let mut cells = vec![policy.clone()];
        for (standings, score) in &all {
            let standing = &standings[place];
            let (shown, better) = match standing.difference {
                Some(versus) => {
                    let better = if score.is_error { versus.below } else { versus.above };
                    (versus.show(score.digits), format!("{better} of {}", versus.pairs))
                }
                None if standing.rank.is_some() => ("–".to_owned(), "–".to_owned()),
                None => ("not ranked: no pair kept its budget".to_owned(), "–".to_owned()),
            };
            cells.extend([shown, better, standing.rank()]);
        }
        table.row(cells);
    }
    table
}

/// The same for the terminal, the best in PSNR first: means, ranks in every score, and the difference in
/// PSNR with its interval. (Three intervals would not fit into a line; the report has them.)
pub(super) fn lines(outcomes: &[Outcome], policies: &[String]) -> String {
    let [psnr, ssim, flip] = SCORES.map(|score| (score.standings(outcomes, policies), score));
    let first = policies.first().map_or("", String::as_str);
    let versus = format!("from {first}");
    let mut columns = Columns::new(&[
        ">rank",
        "<policy",
        ">PSNR [dB]",
        &format!("<{versus}"),
        ">SSIM",
        ">rank",
        ">FLIP",
        ">rank",
        ">runs",
        "<",
    ]);
    let mut order: Vec<usize> = (0..policies.len()).collect();
    // Stable: those without a rank stay at the end in the order of their names on the command line.
    order.sort_by_key(|&place| psnr.0[place].rank.unwrap_or(usize::MAX));
    for place in order {
        let policy = &policies[place];
        let (kept, over): (Vec<&Outcome>, Vec<&Outcome>) =
            outcomes.iter().filter(|r| r.factor == *policy).partition(|r| r.kept_its_budget());
        let over = match over.len() {
            0 => String::new(),
            over => format!("({over} more over the budget, not counted)"),
        };
        let standing = &psnr.0[place];
        let show = |it: Difference| it.show(psnr.1.digits);
        let mut cells = vec![
            standing.rank(),
            policy.clone(),
            number_or_dash(standing.mean, 3),
            standing.difference.map_or_else(String::new, show),
        ];
        for (standings, score) in [&ssim, &flip] {
            cells.push(number_or_dash(standings[place].mean, score.digits));
            cells.push(standings[place].rank());
        }
        cells.extend([kept.len().to_string(), over]);
        columns.row(cells);
    }
    columns.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::sample;

    /// A run of the policy in this scene. SSIM is a hundredth of the PSNR, and FLIP 1 less that.
    fn run(policy: &str, scene: &str, seed: u32, psnr: f64) -> Outcome {
        Outcome { scene: scene.into(), ..sample(policy, "1000", seed, psnr) }
    }

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().copied().map(String::from).collect()
    }

    #[test]
    fn ranks_are_by_paired_difference_and_less_error_is_better() {
        // b is better by 1 in all three seeds, c worse by 1; d like b.
        let gain = [("a", 0.0), ("b", 1.0), ("c", -1.0), ("d", 1.0)];
        let all: Vec<Outcome> = (0..3)
            .flat_map(|seed| gain.map(|(policy, gain)| run(policy, "room", seed, 30.0 + gain)))
            .collect();
        let policies = names(&["a", "b", "c", "d"]);
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
        let said = lines(&all, &policies);
        let expected = "\
rank  policy  PSNR [dB]  from a                  SSIM  rank    FLIP  rank  runs
   1  b          31.000  +1.00 [+1.00, +1.00]  0.3100     1  0.6900     1     3
   1  d          31.000  +1.00 [+1.00, +1.00]  0.3100     1  0.6900     1     3
   3  a          30.000                        0.3000     3  0.7000     3     3
   4  c          29.000  -1.00 [-1.00, -1.00]  0.2900     4  0.7100     4     3";
        assert_eq!(said, expected, "{said}");
    }

    #[test]
    fn a_scene_without_one_policy_does_not_change_its_rank() {
        // b is better by 1 where it can be ranked, and broke its budget in the scene that is easy for both:
        // by its own mean, 31, it would be behind a, 35.
        let mut broken = run("b", "easy", 0, 42.0);
        broken.peak_rows = 1001;
        let all = [
            run("a", "hard", 0, 30.0),
            run("a", "easy", 0, 40.0),
            run("b", "hard", 0, 31.0),
            broken,
        ];
        let policies = names(&["a", "b"]);
        let ranks = SCORES[0].standings(&all, &policies).iter().map(|s| s.rank).collect::<Vec<_>>();
        assert_eq!(ranks, [Some(2), Some(1)]);
        let said = lines(&all, &policies);
        assert!(said.contains("1  b          31.000  +1.00, one run"), "{said}");
        assert!(said.contains("1  (1 more over the budget, not counted)"), "{said}");
    }

    #[test]
    fn what_broke_every_budget_has_no_rank() {
        let broken = Outcome { peak_rows: 1001, ..run("b", "room", 0, 99.0) };
        let all = [broken, run("a", "room", 0, 30.0), run("c", "room", 0, 29.0)];
        let text = table(&all, &names(&["a", "b", "c"])).to_string();
        assert!(text.contains("| b | not ranked: no pair kept its budget | – | – |"), "{text}");
        assert!(text.contains("| c | -1.00, one run | 0 of 1 | 2 |"), "{text}");
        let said = lines(&all, &names(&["b", "a", "c"]));
        // Without runs of the first there is nothing to compare with.
        let mut ranked = said.lines().skip(1).filter(|line| !line.trim_start().starts_with('–'));
        assert_eq!(ranked.next(), None, "{said}");
    }
}
