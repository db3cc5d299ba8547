//! The report of a comparison, and its summary for the terminal.

use std::collections::BTreeSet;

use toml::{Table, Value};

use super::{Outcome, counts, difference, outcomes_at, ranking, scenes_and_limits, spreads};
use crate::difference::{INTERVALS, mean};
use crate::distinct;
use crate::text_table::number_or_dash;
use densify_core::numbers::grouped;
use densify_html::{Column, Document, Table as ReportTable, Text};
use densify_run::Partial;
use densify_run::failure::Failure;
use densify_train::metrics::geometry::Geometry;

/// Mean over runs; `None` if a run has no value.
fn mean_of(runs: &[&Outcome], value: impl Fn(&Outcome) -> Option<f64>) -> Option<f64> {
    mean(runs.iter().map(|run| value(run)).collect::<Option<Vec<f64>>>()?)
}

/// Creates the report without pictures and options.
pub(super) fn document(outcomes: &[Outcome], policies: &[String]) -> Document {
    let mut document = Document::new("Comparison of density-control policies");
    let (Some(first), Some(run)) = (policies.first(), outcomes.first()) else {
        return document;
    };
    let seeds = distinct(outcomes.iter().map(|r| r.seed)).len();
    let runs = format!(
        "{} iterations, {seeds} {}. Means over seeds; differences from ",
        grouped(run.iterations as usize),
        if seeds == 1 { "seed" } else { "seeds" },
    );
    let pairs =
        format!(" are paired by scene, limit and seed. {INTERVALS}. All options are at the end.");
    document.paragraph(Text::from(runs).code(first).plain(&pairs));
    if policies.len() > 1 {
        document.section("Over all scenes and limits");
        document.table(ranking::table(outcomes, policies));
    }
    counts::add_tables(&mut document, outcomes, policies);
    spreads::add(&mut document, outcomes, policies);
    for (scene, limit) in scenes_and_limits(outcomes) {
        let here = outcomes_at(outcomes, scene, limit);
        document.section(&format!("{scene}, {limit}"));
        let columns = [
            "policy",
            "PSNR",
            "SSIM",
            "FLIP",
            "rows",
            "true peak",
            "budget",
            "SH degree",
            "promised memory [MiB]",
            "peak memory [MiB]",
            "time [s]",
            "processor time [s]",
            "extra passes",
        ];
        let mut table = ReportTable::new(columns.map(Column::text));
        for policy in policies {
            if here.iter().any(|run| run.factor == *policy) {
                table.row(row(policy, first, &here));
            }
        }
        document.table(table);
        add_geometry(&mut document, &here, policies);
    }
    document
}

/// Adds the options that all runs share, defaults included, in the format of `--config`.
pub(super) fn add_options(document: &mut Document, outcomes: &[Outcome]) -> Result<(), Failure> {
    let mut shared: Option<Table> = None;
    for run in outcomes {
        let spec = Partial::new(run.spec.clone(), "options")?.describe()?;
        let mut all = Partial::all(&spec)?.into_table();
        if let Some(others) = &shared {
            keep_common(&mut all, others);
        }
        shared = Some(all);
    }
    let shared = toml::to_string(&shared.unwrap_or_default()).map_err(Failure::input)?;
    let versions: BTreeSet<&str> = outcomes.iter().map(|run| &*run.densify).collect();
    let versions = Vec::from_iter(versions).join(", ");
    document.section("Options");
    document.paragraph(format!(
        "The options that all runs share, with densify {versions}, defaults included. Options that \
        differ between runs, or that each run chose itself, are in its config.toml."
    ));
    document.code("toml", shared);
    Ok(())
}

/// Removes the entries that differ from another table.
fn keep_common(table: &mut Table, other: &Table) {
    table.retain(|name, value| match (value, other.get(name)) {
        (Value::Table(inner), Some(Value::Table(other))) => {
            keep_common(inner, other);
            true
        }
        (value, other) => Some(&*value) == other,
    });
}

/// The results of a policy in a scene under a limit.
fn row(policy: &str, first: &str, here: &[&Outcome]) -> Vec<Text> {
    let runs: Vec<&Outcome> = here.iter().filter(|r| r.factor == policy).copied().collect();
    let score = |score: fn(&Outcome) -> f64, digits| {
        let mean = number_or_dash(mean_of(&runs, |r| Some(score(r))), digits);
        let difference = difference(here.iter().copied(), policy, first, score);
        match difference.filter(|_| policy != first) {
            Some(difference) => format!("{mean} ({})", difference.format(digits)),
            None => mean,
        }
    };
    let peak = runs.iter().map(|r| r.peak_rows).max().unwrap_or(0);
    let mut peak_cell = Text::from(grouped(peak));
    if runs.iter().any(|run| !run.kept_its_budget()) {
        peak_cell = peak_cell.plain(" ").bold("over the budget: not ranked");
    }
    let in_mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let mib = |r: &Outcome| r.peak_bytes.map(in_mib);
    let budget = runs.iter().map(|r| r.budget).max().unwrap_or(0);
    let rows = mean_of(&runs, |r| Some(r.rows as f64)).unwrap_or(0.0);
    // With `--sh-degree auto`, the runs of a policy may differ.
    let degrees: BTreeSet<u8> = runs.iter().filter_map(|run| run.sh_degree).collect();
    let degrees: Vec<String> = degrees.iter().map(u8::to_string).collect();
    vec![
        policy.into(),
        score(|r| r.psnr, 2).into(),
        score(|r| r.ssim, 4).into(),
        score(|r| r.flip, 4).into(),
        grouped(rows.round() as usize).into(),
        peak_cell,
        grouped(budget).into(),
        degrees.join(", ").into(),
        number_or_dash(mean_of(&runs, |r| Some(in_mib(r.ledger_bytes))), 0).into(),
        number_or_dash(mean_of(&runs, mib), 0).into(),
        number_or_dash(mean_of(&runs, |r| Some(r.seconds)), 1).into(),
        number_or_dash(mean_of(&runs, |r| r.cpu_seconds), 1).into(),
        number_or_dash(mean_of(&runs, |r| Some(r.extra_forwards as f64)), 0).into(),
    ]
}

/// A geometric measurement.
type Measure = fn(&Geometry) -> f64;

/// Adds the table of geometric errors, if the surface of the scene is known.
fn add_geometry(document: &mut Document, here: &[&Outcome], policies: &[String]) {
    if here.iter().all(|r| r.geometry.is_none()) {
        return;
    }
    let columns: [(Measure, usize); 4] = [
        (|g| g.depth.rmse, 3),
        (|g| g.centres.chamfer, 3),
        (|g| g.centres.f_score_one_percent, 1),
        (|g| g.floaters.of_rows, 2),
    ];
    let titles =
        ["policy", "depth RMSE [%]", "Chamfer [%]", "F-score at 1 % [%]", "floaters [% of rows]"];
    let mut table = ReportTable::new(titles.map(Column::text));
    for policy in policies {
        let runs: Vec<&Outcome> = here.iter().filter(|r| r.factor == *policy).copied().collect();
        if runs.is_empty() {
            continue;
        }
        let cell = |(value, digits): (Measure, usize)| {
            let percent = |r: &Outcome| {
                let value = r.geometry.as_ref().map(value);
                value.filter(|value| value.is_finite()).map(|value| 100.0 * value)
            };
            number_or_dash(mean_of(&runs, percent), digits)
        };
        table.row(std::iter::once(policy.clone()).chain(columns.map(cell)));
    }
    document.paragraph("Geometry, lengths as % of the diagonal of the scene:");
    document.table(table);
}

/// Formats the overall ranking and the counts for the terminal.
pub(super) fn summary(outcomes: &[Outcome], policies: &[String]) -> String {
    let (ranks, counts) = (ranking::format(outcomes, policies), counts::format(outcomes, policies));
    format!(
        "{ranks}\n\nDifferences are paired by scene, limit and seed; brackets are 95 % intervals of \
         their mean.\n\n{counts}\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::sample;

    fn record(policy: &str, seed: u32, psnr: f64, peak_rows: usize) -> Outcome {
        Outcome { peak_rows, cpu_seconds: Some(2.5), ..sample(policy, "1000", seed, psnr) }
    }

    #[test]
    fn differences_are_paired_and_broken_budgets_marked() {
        let all = [
            record("a", 0, 30.0, 1000),
            record("a", 1, 32.0, 1000),
            record("b", 0, 30.5, 1000),
            record("b", 1, 32.5, 999),
            record("c", 0, 40.0, 1001),
            record("c", 1, 40.0, 1001),
        ];
        let policies = ["a", "b", "c"].map(String::from);
        let text = document(&all, &policies).to_string();
        assert!(text.contains("| b | +0.50, two runs | 2 of 2 | 1 |"), "{text}");
        assert!(text.contains("| b | 31.50 (+0.50, two runs) |"), "{text}");
        let other_degree = Outcome { sh_degree: Some(0), ..record("a", 2, 30.0, 1000) };
        let more = [other_degree, record("b", 2, 31.5, 1000)];
        let text = document(&[&all[..], &more].concat(), &policies).to_string();
        // Student's t of two degrees of freedom, 4.303, times √(1/3)/√3.
        assert!(text.contains("| b | +0.83 [-0.60, +2.27] | 3 of 3 | 1 |"), "{text}");
        assert!(text.contains("| b | 900 | 1,000 |"), "{text}");
        assert!(text.contains("| c | not ranked"), "{text}");
        assert!(
            text.contains("| a | 30.67 | 0.3067 | 0.6933 | 900 | 1,000 | 1,000 | 0, 3 | 0 | – |"),
            "{text}"
        );
        assert!(text.contains("1,001 **over the budget: not ranked**"), "{text}");
        assert!(!text.contains("Geometry"), "{text}");
        let text = summary(&all, &policies);
        let row_of_c = "   –  c               –                        –     –       –     –     0  (and 2 over";
        assert!(
            text.contains(row_of_c) && text.contains("b          31.500  +0.50, two runs"),
            "{text}"
        );
        assert!(text.contains("policy  1,000 rows: end          peak"), "{text}");
    }

    #[test]
    fn options_that_all_runs_share_are_listed_with_the_defaults() {
        let run = |policy: &str, set: &str| Outcome {
            spec: format!("iterations = 9\npolicy = '{policy}'\nknob.alpha_min = '1/64'\n{set}")
                .parse()
                .expect("TOML"),
            ..record(policy, 0, 30.0, 1000)
        };
        let options = |outcomes: &[Outcome]| {
            let mut document = Document::new("");
            add_options(&mut document, outcomes).expect("options");
            document.to_string()
        };
        let set = "policy_set.diet = { rho = 0.5 }";
        let text = options(&[run("diet", set), run("mcmc", set)]);
        for words in
            ["iterations = 9\n", "init_rates = \"fine\"", "alpha_min = \"1/64\"", "rho = 0.5"]
        {
            assert!(text.contains(words), "{words}: {text}");
        }
        assert!(!text.contains("\npolicy = "), "{text}");
        let text = options(&[run("diet", set), run("diet", "")]);
        assert!(text.contains("policy = \"diet\"") && !text.contains("rho"), "{text}");
    }

    #[test]
    fn geometry_is_shown_where_it_is_known() {
        let measured = |rmse: f64| -> Geometry {
            let text = format!(
                r#"{{"depth": {{"rmse": {rmse}, "abs_rel": null, "coverage": 1.0}}, "normal_error": 3.0,
                "centres": {{"accuracy": 0.01, "accuracy_p95": 0.02, "completeness": 0.005,
                "chamfer": 0.015, "f_score_half_percent": 0.5, "f_score_one_percent": 0.75}},
                "floaters": {{"count": 9, "of_rows": 0.01, "of_weight": null}}, "thin": [],
                "redundancy": {{"blended_per_pixel": 9.0, "below_one_percent": 0.25}}}}"#
            );
            serde_json::from_str(&text).expect("geometry")
        };
        let with =
            |policy: &str, seed, geometry| Outcome { geometry, ..record(policy, seed, 30.0, 1000) };
        let all = [
            with("a", 0, Some(measured(0.02))),
            with("a", 1, Some(measured(0.03))),
            with("b", 0, Some(measured(0.5))),
            with("b", 1, None),
        ];
        let text = document(&all, &["a", "b"].map(String::from)).to_string();
        assert!(text.contains("| a | 2.500 | 1.500 | 75.0 | 1.00 |"), "{text}");
        assert!(text.contains("| b | – | – | – | – |"), "{text}");
    }
}
