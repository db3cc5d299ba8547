//! Tabulates what the spread of scores comes from: seeds, or views.

use std::collections::BTreeMap;

use super::{Outcome, outcomes_at, scenes_and_limits};
use crate::Limit;
use crate::difference::mean;
use crate::distinct;
use crate::spread::Spread;
use crate::text_table::or_dash;
use densify_html::{Column, Document, Table};
use densify_train::output::Mean;

/// PSNR of single views by seed.
type BySeed<'a> = BTreeMap<u32, BTreeMap<&'a str, f64>>;

/// PSNR of the views by seed: of a policy, or its differences from another, over the seeds that both have.
fn by_seed<'a>(here: &[&'a Outcome], policy: &str, base: Option<&str>) -> BySeed<'a> {
    let of = |policy: &str, seed: u32| {
        here.iter().find(|run| run.factor == policy && run.seed == seed && run.kept_its_budget())
    };
    let values = |run: &&'a Outcome| {
        let other = match base {
            Some(base) => Some(of(base, run.seed)?),
            None => None,
        };
        let value = |(name, score): (&'a String, &Mean)| {
            let other = other.map_or(Some(0.0), |other| Some(other.views.get(name)?.psnr))?;
            Some((name.as_str(), score.psnr - other))
        };
        Some((run.seed, run.views.iter().filter_map(value).collect()))
    };
    let runs = here.iter().filter(|run| run.factor == policy && run.kept_its_budget());
    runs.filter_map(values).collect()
}

/// Means over limits of the seeds and views that all limits have. Runs of one seed under several limits start alike, so
/// only their mean is an independent value.
fn over_limits<'a>(limits: &[BySeed<'a>]) -> BySeed<'a> {
    let Some(first) = limits.first() else { return BySeed::new() };
    let of_view = |seed: &u32, view: &str| {
        let values = limits.iter().map(|limit| limit.get(seed)?.get(view).copied());
        mean(values.collect::<Option<Vec<f64>>>()?)
    };
    let of_seed = |(seed, views): (&u32, &BTreeMap<&'a str, f64>)| {
        let views = views.keys().filter_map(|view| Some((*view, of_view(seed, view)?)));
        (*seed, views.collect::<BTreeMap<_, _>>())
    };
    first.iter().map(of_seed).filter(|(_, views)| !views.is_empty()).collect()
}

fn spread(values: BySeed<'_>) -> Option<Spread> {
    Spread::new(&values.into_values().collect::<Vec<_>>())
}

/// Adds a table of the parts of the spread, if there are at least two seeds and two views.
pub(super) fn add(document: &mut Document, outcomes: &[Outcome], policies: &[String]) {
    let Some(first) = policies.first() else { return };
    let places = scenes_and_limits(outcomes);
    let scenes = distinct(places.iter().map(|(scene, _)| *scene));
    let mut table = Table::new(
        ["where", "policy", "PSNR [dB]", "between seeds [dB]", "seeds", "views", "seeds × views"]
            .map(Column::text),
    );
    let mut has_rows = false;
    for policy in policies {
        let base = (policy != first).then_some(first.as_str());
        let at = |(scene, limit): &(&str, Limit)| {
            by_seed(&outcomes_at(outcomes, scene, *limit), policy, base)
        };
        for place in &places {
            let Some(spread) = spread(at(place)) else { continue };
            let (scene, limit) = place;
            has_rows = true;
            let [seeds, views, rest] =
                spread.shares().map(|share| format!("{:.0} %", 100.0 * share));
            let place = format!("{scene}, {limit}");
            let between = format!("{:.2}", spread.seeds.sqrt());
            let value = value(&[spread], base.is_some());
            table.row([place, policy.clone(), value, between, seeds, views, rest]);
        }
        // The mean over the scenes is of interest for differences only.
        if base.is_none() || scenes.len() < 2 {
            continue;
        }
        let of_scene = |scene: &&str| {
            let limits = places.iter().filter(|(other, _)| other == scene).map(at);
            spread(over_limits(&limits.collect::<Vec<_>>()))
        };
        if let Some(all) = scenes.iter().map(of_scene).collect::<Option<Vec<Spread>>>() {
            let dashes = [(); 4].map(|()| "–".to_owned());
            let cells = ["mean over the scenes".to_owned(), policy.clone(), value(&all, true)];
            table.row(cells.into_iter().chain(dashes));
        }
    }
    if has_rows {
        document.section("Seeds and views");
        document.paragraph(format!(
            "What the PSNR of single views varies with; of {first} itself, of the others their \
             differences from it. Shares are of the variance of one view with one seed; seeds × views are \
             views that some seeds render better than others. Between seeds is the standard deviation \
             that seeds have in all views alike. Brackets are 95 % intervals for other seeds and other \
             views of the same scenes; those of the other tables are for other seeds and these views."
        ));
        document.table(table);
    }
}

/// The mean over scenes with its interval.
fn value(spreads: &[Spread], is_difference: bool) -> String {
    or_dash(Spread::interval(spreads).map(|(mean, [low, high])| match is_difference {
        true => format!("{mean:+.2} [{low:+.2}, {high:+.2}]"),
        false => format!("{mean:.2} [{low:.2}, {high:.2}]"),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::sample;

    /// A run of two views with these PSNRs.
    fn run(policy: &str, seed: u32, psnr: [f64; 2]) -> Outcome {
        let view = |psnr| Mean { psnr, ssim: 0.5, flip: 0.5, lpips: None, fitted: None };
        let views = ["a.png", "b.png"].map(String::from).into_iter().zip(psnr.map(view)).collect();
        Outcome { views, ..sample(policy, "1000", seed, 30.0) }
    }

    #[test]
    fn shares_of_seeds_and_views_are_listed() {
        let policies = ["a", "b"].map(String::from);
        let mut all = vec![
            run("a", 0, [30.0, 40.0]),
            run("a", 1, [30.0, 40.0]),
            run("b", 0, [31.0, 41.0]),
            run("b", 1, [33.0, 45.0]),
        ];
        let mut document = Document::new("");
        add(&mut document, &all, &policies);
        let text = document.to_string();
        // The differences of b are those of the test in `spread.rs`.
        for row in [
            "| room, 1,000 rows | a | 35.00 [-28.53, 98.53] | 0.00 | 0 % | 100 % | 0 % |",
            "| room, 1,000 rows | b | +2.50 [-16.56, +21.56] | 2.00 | 80 % | 0 % | 20 % |",
        ] {
            assert!(text.contains(row), "{row} is not in {text}");
        }
        assert!(!text.contains("mean over the scenes"), "{text}");
        // In a second scene b is worse by as much, in the mean over two limits: by 1 dB less and more.
        let elsewhere = |run: &Outcome, budget: usize, shift: f64| {
            let sign = if run.factor == "b" { -1.0 } else { 1.0 };
            let shift = if run.factor == "b" { shift } else { 0.0 };
            let mirrored = |(view, base): (&Mean, f64)| base + sign * (view.psnr - base) + shift;
            let psnr: Vec<f64> = run.views.values().zip([30.0, 40.0]).map(mirrored).collect();
            let run = super::tests::run(&run.factor, run.seed, [psnr[0], psnr[1]]);
            Outcome { scene: "cup".into(), budget, ..run }
        };
        let limits = [(1000, 1.0), (2000, -1.0)];
        let cup =
            all.iter().flat_map(|run| limits.map(|(rows, shift)| elsewhere(run, rows, shift)));
        let both: Vec<Outcome> = all.iter().cloned().chain(cup).collect();
        let mut document = Document::new("");
        add(&mut document, &both, &policies);
        let text = document.to_string();
        // Squared errors of 1.5² and 1.5², over 2²; their degrees of freedom of 81/83 add up to 1.95.
        for row in [
            "| cup, 1,000 rows | b | -1.50 [-20.56, +17.56] | 2.00 |",
            "| cup, 2,000 rows | b | -3.50 [-22.56, +15.56] | 2.00 |",
            "| mean over the scenes | b | +0.00 [-4.67, +4.67]",
        ] {
            assert!(text.contains(row), "{row} is not in {text}");
        }
        // Without a second seed of both, there is nothing to divide.
        all.truncate(1);
        let mut document = Document::new("");
        add(&mut document, &all, &policies);
        assert!(!document.to_string().contains("Seeds and views"));
    }
}
