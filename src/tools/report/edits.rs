//! The edits of a run: totals by cause, and the log.

use std::collections::BTreeMap;

use maud::{Markup, html};

use super::runs::RunRecord;
use densify_core::numbers::grouped;
use densify_html::{Column, Table};
use densify_train::trainer::EditEvent;

/// Maximum number of causes listed separately.
const MAX_CAUSES: usize = 12;
/// Maximum number of lines of the log.
const MAX_LINES: usize = 400;

/// Totals over edits.
#[derive(Default)]
struct Totals {
    /// Number of edits, of Gaussians pruned, added and rewritten, and of requests denied, in the order of the table's
    /// columns.
    counts: [usize; 5],
    /// Iteration of the first edit.
    first: u32,
    /// Iteration of the last edit.
    last: u32,
}

impl Totals {
    fn add(&mut self, event: &EditEvent) {
        if self.counts[0] == 0 {
            self.first = event.step;
        }
        let counts = [1, event.removed, event.added, event.updated, event.denied];
        self.counts = std::array::from_fn(|column| self.counts[column] + counts[column]);
        self.last = event.step;
    }

    fn row(&self, cause: &str) -> Vec<String> {
        let steps = if self.first == self.last {
            grouped(self.first as usize)
        } else {
            format!("{} to {}", grouped(self.first as usize), grouped(self.last as usize))
        };
        std::iter::once(cause.to_owned()).chain(self.counts.map(grouped)).chain([steps]).collect()
    }
}

/// Tabulates the edits of a run, as totals and in full.
pub(super) fn tabulate(run: &RunRecord) -> Markup {
    if run.events.is_empty() {
        return html! { p { "No Gaussian was added or pruned." } };
    }
    let numbers = ["edits", "pruned", "added", "rewritten", "denied", "iterations"];
    let mut causes =
        Table::new(std::iter::once(Column::text("cause")).chain(numbers.map(Column::number)));
    for (cause, totals) in totals_by_cause(&run.events) {
        causes.row(totals.row(&cause));
    }
    let numbers = ["iteration", "before", "pruned", "added", "rewritten", "denied", "after"];
    let mut log =
        Table::new(numbers.map(Column::number).into_iter().chain([Column::text("cause")]));
    let stride = run.events.len().div_ceil(MAX_LINES).max(1);
    let lines = run.events.iter().step_by(stride);
    let count = lines.len();
    for event in lines {
        let EditEvent { step, before, removed, added, updated, denied, after, cause } = event;
        let numbers = [*step as usize, *before, *removed, *added, *updated, *denied, *after];
        log.row(numbers.map(grouped).into_iter().chain([cause.clone()]));
    }
    html! {
        (causes.to_html())
        p.note { "Denied: requested by the policy, but beyond the budget." }
        details {
            summary {
                "The log: " (grouped(count))
                @if stride > 1 { " of " (grouped(run.events.len())) }
                " edits"
            }
            (log.to_html())
        }
    }
}

/// Totals by cause, the most frequent first, then the totals of all edits.
fn totals_by_cause(events: &[EditEvent]) -> Vec<(String, Totals)> {
    let mut by_cause: BTreeMap<&str, Totals> = BTreeMap::new();
    let mut all = Totals::default();
    for event in events {
        let cause = if event.cause.is_empty() { "unnamed" } else { &event.cause };
        by_cause.entry(cause).or_default().add(event);
        all.add(event);
    }
    let mut totals: Vec<(String, Totals)> =
        by_cause.into_iter().map(|(cause, totals)| (cause.to_owned(), totals)).collect();
    totals.sort_by_key(|(_, totals)| std::cmp::Reverse(totals.counts[0]));
    let others = totals.len().saturating_sub(MAX_CAUSES);
    totals.truncate(MAX_CAUSES);
    if totals.len() > 1 {
        let name =
            if others > 0 { format!("all, with {others} rarer causes") } else { "all".into() };
        totals.push((name, all));
    }
    totals
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(step: u32, cause: &str, removed: usize, added: usize) -> EditEvent {
        let cause = cause.to_owned();
        EditEvent { step, before: 9, removed, added, updated: 1, denied: 2, after: 9, cause }
    }

    #[test]
    fn edits_are_totalled_by_cause() {
        let events = [event(100, "grow", 0, 5), event(200, "grow", 1, 4), event(300, "", 7, 0)];
        let rows: Vec<String> = totals_by_cause(&events)
            .iter()
            .map(|(cause, totals)| totals.row(cause).join(" "))
            .collect();
        assert_eq!(
            rows,
            ["grow 2 1 9 2 4 100 to 200", "unnamed 1 7 0 1 2 300", "all 3 8 9 3 6 100 to 300"]
        );
        assert_eq!(totals_by_cause(&events[..2]).len(), 1, "one cause needs no total");
        let many: Vec<EditEvent> = (0..20).map(|n| event(n, &format!("c{n:02}"), 1, 1)).collect();
        let totals = totals_by_cause(&many);
        assert_eq!(totals.len(), MAX_CAUSES + 1);
        assert_eq!((&*totals[12].0, totals[12].1.counts[1]), ("all, with 8 rarer causes", 20));
    }
}
