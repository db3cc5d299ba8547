//! Tabulates the Gaussians of each policy at the end and at the true peak.
//!
//! Limits bound the peak, and policies are compared under equal limits. Some policies end far below their peak, which
//! matters if the cost of storage or display is more important than that of training.

use super::{Outcome, outcomes_at};
use crate::Limit;
use crate::difference::mean;
use crate::distinct;
use crate::text_table::{TextTable, or_dash};
use densify_core::numbers::grouped;
use densify_html::{Column, Document, Table};

/// Mean number of Gaussians at the end; a dash if there are no runs.
fn final_count(runs: &[&Outcome]) -> String {
    let rows = mean(runs.iter().map(|run| run.rows as f64));
    or_dash(rows.map(|rows| grouped(rows.round() as usize)))
}

/// Largest number of Gaussians at any instant of any run; a dash if there are no runs.
fn peak_count(runs: &[&Outcome]) -> String {
    let peak = runs.iter().map(|run| run.peak_rows).max();
    let mark = if runs.iter().all(|run| run.kept_its_budget()) { "" } else { " (over)" };
    or_dash(peak.map(|rows| format!("{}{mark}", grouped(rows))))
}

/// All limits, ascending.
fn limits(outcomes: &[Outcome]) -> Vec<Limit> {
    let mut limits = distinct(outcomes.iter().map(Outcome::limit));
    limits.sort_unstable();
    limits
}

/// Adds a table per limit with the final counts and the true peaks in each scene.
pub(super) fn add_tables(document: &mut Document, outcomes: &[Outcome], policies: &[String]) {
    document.section("Gaussians at the end and at the true peak");
    document.paragraph(
        "At the end: means over seeds. True peak: the maximum at any instant of any seed. The \
        tables above compare policies under equal limits, which bound the peak; these show where each policy ends.",
    );
    for limit in limits(outcomes) {
        let scenes =
            distinct(outcomes.iter().filter(|run| run.limit() == limit).map(|run| &*run.scene));
        let title =
            |count| scenes.iter().map(move |scene| Column::text(&format!("{scene}, {count}")));
        let columns = title("at the end").chain(title("peak"));
        let mut table = Table::new(std::iter::once(Column::text("policy")).chain(columns));
        for policy in policies {
            let runs = |scene: &&str| {
                let mut runs = outcomes_at(outcomes, scene, limit);
                runs.retain(|run| run.factor == *policy);
                runs
            };
            let runs: Vec<Vec<&Outcome>> = scenes.iter().map(runs).collect();
            let counts = runs.iter().map(|runs| final_count(runs));
            let cells = counts.chain(runs.iter().map(|runs| peak_count(runs)));
            table.row(std::iter::once(policy.clone()).chain(cells));
        }
        document.subsection(&format!("At most {limit}"));
        document.table(table);
    }
}

/// Formats the counts for the terminal, over all scenes under a limit.
pub(super) fn format(outcomes: &[Outcome], policies: &[String]) -> String {
    let limits = limits(outcomes);
    let mut titles = vec!["<policy".to_owned()];
    for limit in &limits {
        titles.extend([format!(">{limit}: end"), ">peak".to_owned()]);
    }
    let mut table = TextTable::new(&titles.iter().map(String::as_str).collect::<Vec<_>>());
    for policy in policies {
        let mut cells = vec![policy.clone()];
        for &limit in &limits {
            let is_included = |run: &&Outcome| run.limit() == limit && run.factor == *policy;
            let runs: Vec<&Outcome> = outcomes.iter().filter(is_included).collect();
            cells.extend([final_count(&runs), peak_count(&runs)]);
        }
        table.row(cells);
    }
    format!(
        "Gaussians at the end (mean over runs) and at the true peak (maximum), by limit\n\n{table}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::sample;

    fn run(policy: &str, scene: &str, budget: usize, seed: u32, rows: [usize; 2]) -> Outcome {
        let (scene, [rows, peak_rows]) = (scene.to_owned(), rows);
        Outcome { scene, budget, rows, peak_rows, ..sample(policy, "", seed, 30.0) }
    }

    #[test]
    fn final_counts_and_peaks_are_listed_for_every_limit() {
        let all = [
            run("a", "room", 9000, 0, [8000, 9000]),
            run("a", "room", 9000, 1, [8501, 8999]),
            run("a", "cup", 9000, 0, [7000, 7000]),
            run("b", "room", 9000, 0, [2700, 9000]),
            run("b", "cup", 9000, 0, [2000, 9001]),
            run("a", "room", 500, 0, [499, 500]),
        ];
        let policies = ["a", "b"].map(String::from);
        let mut document = Document::new("");
        add_tables(&mut document, &all, &policies);
        let text = document.to_string();
        let expected = "
### At most 500 rows

| policy | room, at the end | room, peak |
|---|---|---|
| a | 499 | 500 |
| b | – | – |

### At most 9,000 rows

| policy | room, at the end | cup, at the end | room, peak | cup, peak |
|---|---|---|---|---|
| a | 8,251 | 7,000 | 9,000 | 7,000 |
| b | 2,700 | 2,000 | 9,000 | 9,001 (over) |
";
        assert!(text.ends_with(expected), "{text}");
        let text = format(&all, &policies);
        // (8000 + 8501 + 7000) / 3 = 7833.67.
        let expected = "
policy  500 rows: end  peak  9,000 rows: end          peak
a                 499   500            7,834         9,000
b                   –     –            2,350  9,001 (over)";
        assert!(text.ends_with(expected), "{text}");
    }
}
