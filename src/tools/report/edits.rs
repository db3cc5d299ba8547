//! The edits of a run: their sums by cause, and the log.

use std::collections::BTreeMap;

use maud::{Markup, html};

use super::runs::Told;
use densify_core::numbers::grouped;
use densify_html::{Column, table};
use densify_train::trainer::EditEvent;

/// Most causes that are told apart.
const MOST_CAUSES: usize = 12;
/// Most lines of the log that are shown.
const MOST_LINES: usize = 400;

/// Sums over some edits.
#[derive(Debug, Default, Clone, PartialEq)]
struct Sum {
    edits: usize,
    removed: usize,
    added: usize,
    updated: usize,
    denied: usize,
    first: u32,
    last: u32,
}

impl Sum {
    fn add(&mut self, event: &EditEvent) {
        if self.edits == 0 {
            self.first = event.step;
        }
        self.edits += 1;
        self.removed += event.removed;
        self.added += event.added;
        self.updated += event.updated;
        self.denied += event.denied;
        self.last = event.step;
    }

    fn row(&self, cause: &str) -> Vec<String> {
        let counts = [self.edits, self.removed, self.added, self.updated, self.denied];
        let steps = match self.first == self.last {
            true => grouped(self.first as usize),
            false => format!("{} to {}", grouped(self.first as usize), grouped(self.last as usize)),
        };
        let counts = counts.into_iter().map(grouped);
        std::iter::once(cause.to_owned()).chain(counts).chain([steps]).collect()
    }
}

/// The edits of a run, summed and in full.
pub(super) fn of_run(run: &Told) -> Markup {
    if run.events.is_empty() {
        return html! { p { "No row was added or pruned." } };
    }
    let numbers = ["edits", "pruned", "added", "rewritten", "denied", "iterations"];
    let columns: Vec<Column<'_>> =
        std::iter::once(Column::Text("cause")).chain(numbers.map(Column::Number)).collect();
    let rows: Vec<Vec<String>> =
        sums(&run.events).iter().map(|(cause, sum)| sum.row(cause)).collect();
    let log = ["iteration", "before", "pruned", "added", "rewritten", "denied", "after"];
    let log: Vec<Column<'_>> =
        log.map(Column::Number).into_iter().chain([Column::Text("cause")]).collect();
    let line = |event: &EditEvent| {
        let EditEvent { step, before, removed, added, updated, denied, after, cause } = event;
        let numbers = [*step as usize, *before, *removed, *added, *updated, *denied, *after];
        numbers.map(grouped).into_iter().chain([cause.clone()]).collect::<Vec<String>>()
    };
    let every = run.events.len().div_ceil(MOST_LINES).max(1);
    let lines: Vec<Vec<String>> = run.events.iter().step_by(every).map(line).collect();
    html! {
        (table(&columns, &rows))
        p.note { "Denied: what the policy wanted and the budget had no room for." }
        details {
            summary {
                "The log: " (grouped(lines.len()))
                @if every > 1 { " of " (grouped(run.events.len())) }
                " edits"
            }
            (table(&log, &lines))
        }
    }
}

/// Sums by cause, the most frequent first, and of all together below.
fn sums(events: &[EditEvent]) -> Vec<(String, Sum)> {
    let mut by_cause: BTreeMap<&str, Sum> = BTreeMap::new();
    let mut all = Sum::default();
    for event in events {
        let cause = if event.cause.is_empty() { "unnamed" } else { &event.cause };
        by_cause.entry(cause).or_default().add(event);
        all.add(event);
    }
    let mut sums: Vec<(String, Sum)> =
        by_cause.into_iter().map(|(cause, sum)| (cause.to_owned(), sum)).collect();
    sums.sort_by_key(|(_, sum)| std::cmp::Reverse(sum.edits));
    let others = sums.len().saturating_sub(MOST_CAUSES);
    sums.truncate(MOST_CAUSES);
    if sums.len() > 1 {
        let name =
            if others > 0 { format!("all, with {others} rarer causes") } else { "all".into() };
        sums.push((name, all));
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(step: u32, cause: &str, removed: usize, added: usize) -> EditEvent {
        let cause = cause.to_owned();
        EditEvent { step, before: 9, removed, added, updated: 1, denied: 2, after: 9, cause }
    }

    #[test]
    fn edits_are_summed_by_cause() {
        let events = [event(100, "grow", 0, 5), event(200, "grow", 1, 4), event(300, "", 7, 0)];
        let rows: Vec<String> =
            sums(&events).iter().map(|(cause, sum)| sum.row(cause).join(" ")).collect();
        assert_eq!(
            rows,
            ["grow 2 1 9 2 4 100 to 200", "unnamed 1 7 0 1 2 300", "all 3 8 9 3 6 100 to 300"]
        );
        assert_eq!(sums(&events[..2]).len(), 1, "one cause needs no sum of all");
        let many: Vec<EditEvent> = (0..20).map(|n| event(n, &format!("c{n:02}"), 1, 1)).collect();
        let sums = sums(&many);
        assert_eq!(sums.len(), MOST_CAUSES + 1);
        assert_eq!((&*sums[12].0, sums[12].1.removed), ("all, with 8 rarer causes", 20));
    }
}
