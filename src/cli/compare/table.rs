//! The comparison as text: Markdown for the file, a few lines for the terminal.

use std::fmt::Write;

use super::difference::between;
use super::{Record, budgets_of, distinct};
use crate::metrics::geometry::Geometry;
use crate::number::grouped;

/// Mean over records; `None` where one has no value.
fn mean(records: &[&Record], of: impl Fn(&Record) -> Option<f64>) -> Option<f64> {
    let values: Option<Vec<f64>> = records.iter().map(|r| of(r)).collect();
    values.filter(|v| !v.is_empty()).map(|v| v.iter().sum::<f64>() / v.len() as f64)
}

fn shown(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("{value:.digits$}"))
}

/// The whole comparison.
pub(super) fn markdown(records: &[&Record], policies: &[String]) -> String {
    let mut text = String::from("# Comparison of density-control policies\n");
    let (first, others) = match policies.split_first() {
        Some((first, others)) if !records.is_empty() => (first, others),
        _ => return text,
    };
    let iterations = records[0].iterations;
    let seeds = distinct(records, |r| r.seed).len();
    let _ = write!(
        text,
        "\n{} iterations, {seeds} {}. Means over seeds; differences from `{first}` are paired by \
         scene, budget and seed, with 95 % bootstrap intervals.\n",
        grouped(iterations as usize),
        if seeds == 1 { "seed" } else { "seeds" },
    );
    if !others.is_empty() {
        text += "\n## Over all scenes and budgets\n\n";
        text += "| policy | PSNR | better in | SSIM | better in | FLIP | better in |\n\
                 |---|---|---|---|---|---|---|\n";
        for policy in others {
            let psnr = between(records, policy, first, |r| r.psnr);
            let ssim = between(records, policy, first, |r| r.ssim);
            let flip = between(records, policy, first, |r| r.flip);
            let (Some(psnr), Some(ssim), Some(flip)) = (psnr, ssim, flip) else {
                let _ =
                    writeln!(text, "| {policy} | not ranked: no run kept its budget | | | | | |");
                continue;
            };
            let _ = writeln!(
                text,
                "| {policy} | {} dB | {} of {} | {} | {} of {} | {} | {} of {} |",
                psnr.show(2),
                psnr.above,
                psnr.pairs,
                ssim.show(4),
                ssim.above,
                ssim.pairs,
                flip.show(4),
                // An error: less is better.
                flip.below,
                flip.pairs,
            );
        }
    }
    for scene in distinct(records, |r| &r.scene) {
        for budget in budgets_of(records, scene) {
            let _ = write!(text, "\n## {scene}, {} rows\n\n", grouped(budget));
            text += "| policy | PSNR | SSIM | FLIP | rows | true peak | peak memory [MiB] | time [s] | processor time [s] | extra passes |\n";
            text += "|---|---|---|---|---|---|---|---|---|---|\n";
            for policy in policies {
                let here =
                    |r: &&&Record| r.scene == *scene && r.budget == budget && r.policy == *policy;
                let runs: Vec<&Record> = records.iter().filter(here).copied().collect();
                text += &line(policy, first, &runs, records, budget);
            }
            text += &geometry(records, policies, scene, budget);
        }
    }
    text
}

/// A number of those measured against the known surface.
type Measure = fn(&Geometry) -> f64;

/// The table of what was measured against the known surface; nothing where none is known.
fn geometry(records: &[&Record], policies: &[String], scene: &str, budget: usize) -> String {
    let here: Vec<&Record> =
        records.iter().filter(|r| r.scene == *scene && r.budget == budget).copied().collect();
    if here.iter().all(|r| r.geometry.is_none()) {
        return String::new();
    }
    let mut text = String::from(
        "\nGeometry, lengths as % of the diagonal of the scene:\n\n\
         | policy | depth RMSE [%] | Chamfer [%] | F-score at 1 % [%] | floaters [% of rows] |\n\
         |---|---|---|---|---|\n",
    );
    let columns: [(Measure, usize); 4] = [
        (|g| g.depth.rmse, 3),
        (|g| g.centres.chamfer, 3),
        (|g| g.centres.f_score_one_percent, 1),
        (|g| g.floaters.of_rows, 2),
    ];
    for policy in policies {
        let runs: Vec<&Record> = here.iter().filter(|r| r.policy == *policy).copied().collect();
        if runs.is_empty() {
            continue;
        }
        let _ = write!(text, "| {policy}");
        for (of, digits) in columns {
            let percent = |r: &Record| {
                let value = r.geometry.as_ref().map(of);
                value.filter(|value| value.is_finite()).map(|value| 100.0 * value)
            };
            let _ = write!(text, " | {}", shown(mean(&runs, percent), digits));
        }
        text += " |\n";
    }
    text
}

fn line(policy: &str, first: &str, runs: &[&Record], records: &[&Record], budget: usize) -> String {
    let Some(run) = runs.first() else {
        return String::new();
    };
    let here: Vec<&Record> =
        records.iter().filter(|r| r.scene == run.scene && r.budget == budget).copied().collect();
    let difference = |score: fn(&Record) -> f64, digits| {
        let difference = between(&here, policy, first, score);
        difference
            .filter(|_| policy != first)
            .map_or_else(String::new, |d| format!(" ({})", d.show(digits)))
    };
    let peak = runs.iter().map(|r| r.peak_rows).max().unwrap_or(0);
    let marked = if peak > budget { " **over the budget: not ranked**" } else { "" };
    let number = |of: fn(&Record) -> f64, digits| shown(mean(runs, |r| Some(of(r))), digits);
    let mib = |r: &Record| r.peak_bytes.map(|bytes| bytes as f64 / f64::from(1 << 20));
    format!(
        "| {policy} | {}{} | {}{} | {}{} | {} | {}{marked} | {} | {} | {} | {} |\n",
        number(|r| r.psnr, 2),
        difference(|r| r.psnr, 2),
        number(|r| r.ssim, 4),
        difference(|r| r.ssim, 4),
        number(|r| r.flip, 4),
        difference(|r| r.flip, 4),
        grouped(mean(runs, |r| Some(r.rows as f64)).unwrap_or(0.0).round() as usize),
        grouped(peak),
        shown(mean(runs, mib), 0),
        number(|r| r.seconds, 1),
        shown(mean(runs, |r| r.cpu_seconds), 1),
        number(|r| r.extra_forwards as f64, 0),
    )
}

/// A line per policy: means over everything.
pub(super) fn summary(records: &[&Record], policies: &[String]) -> String {
    let width = policies.iter().map(String::len).max().unwrap_or(0).max(6);
    let mut text = format!("{:width$}  PSNR [dB]    SSIM    FLIP  runs", "policy");
    for policy in policies {
        let runs: Vec<&Record> =
            records.iter().filter(|r| r.policy == *policy && r.is_bounded()).copied().collect();
        let psnr = shown(mean(&runs, |r| Some(r.psnr)), 3);
        let ssim = shown(mean(&runs, |r| Some(r.ssim)), 4);
        let flip = shown(mean(&runs, |r| Some(r.flip)), 4);
        let _ =
            write!(text, "\n{policy:width$}  {psnr:>9}  {ssim:>6}  {flip:>6}  {:>4}", runs.len());
        let over = records.iter().filter(|r| r.policy == *policy && !r.is_bounded()).count();
        if over > 0 {
            let _ = write!(text, "  ({over} more over the budget, not counted)");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(policy: &str, seed: u32, psnr: f64, peak_rows: usize) -> Record {
        Record {
            densify: "1".into(),
            scene: "room".into(),
            policy: policy.into(),
            budget: 1000,
            seed,
            iterations: 7000,
            run: String::new(),
            spec: toml::Table::new(),
            psnr,
            ssim: psnr / 100.0,
            flip: 1.0 - psnr / 100.0,
            rows: 900,
            peak_rows,
            peak_bytes: None,
            seconds: 1.25,
            cpu_seconds: Some(2.5),
            extra_forwards: 0,
            curve: Vec::new(),
            geometry: None,
        }
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
        let all: Vec<&Record> = all.iter().collect();
        let policies = ["a", "b", "c"].map(String::from);
        let text = markdown(&all, &policies);
        assert!(text.contains("| b | +0.50 [+0.50, +0.50] dB | 2 of 2 | +0.0050 [+0.0050, +0.0050] | 2 of 2 | -0.0050 [-0.0050, -0.0050] | 2 of 2 |"), "{text}");
        assert!(text.contains("| c | not ranked"), "{text}");
        assert!(text.contains("| a | 31.00 | 0.3100 | 0.6900 | 900 | 1,000 | – |"), "{text}");
        assert!(text.contains("1,001 **over the budget: not ranked**"), "{text}");
        assert!(!text.contains("Geometry"), "{text}");
        let said = summary(&all, &policies);
        assert!(said.contains("c               –       –       –     0  (2 more over"), "{said}");
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
            |policy: &str, seed, geometry| Record { geometry, ..record(policy, seed, 30.0, 1000) };
        let all = [
            with("a", 0, Some(measured(0.02))),
            with("a", 1, Some(measured(0.03))),
            with("b", 0, Some(measured(0.5))),
            with("b", 1, None),
        ];
        let all: Vec<&Record> = all.iter().collect();
        let text = markdown(&all, &["a", "b"].map(String::from));
        assert!(text.contains("| a | 2.500 | 1.500 | 75.0 | 1.00 |"), "{text}");
        assert!(text.contains("| b | – | – | – | – |"), "{text}");
    }
}
