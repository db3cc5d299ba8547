//! Memory: what was promised, what was taken, and the ledger behind it.

use maud::{Markup, html};

use super::runs::Told;
use densify_core::memory::{Bytes, LedgerLine};
use densify_html::{Column, table};

/// What a run promised to take of the host's memory `[bytes]`; that of a device is not in what the system
/// measures.
pub(super) fn promised_to_the_host(run: &Told) -> Option<u64> {
    let summary = run.summary.as_ref()?;
    Some(match summary.ledger.on_device() {
        0 => summary.ledger_bytes,
        _ => summary.ledger.on_host(),
    })
}

/// Peak, promise and ledger of a run; nothing while it trains.
pub(super) fn of_run(run: &Told) -> Option<Markup> {
    let summary = run.summary.as_ref()?;
    let promise = promised_to_the_host(run)?;
    let device = summary.ledger.on_device();
    let mut lines: Vec<&LedgerLine> = summary.ledger.lines.iter().collect();
    lines.sort_by_key(|line| line.section);
    let row = |line: &&LedgerLine| {
        let place = if line.on_device { " (on the device)" } else { "" };
        vec![
            line.section.name().to_owned(),
            format!("{}{place}", line.what),
            Bytes(line.bytes).to_string(),
        ]
    };
    let rows: Vec<Vec<String>> = lines.iter().map(row).collect();
    let columns = [Column::Text("part"), Column::Text("buffer"), Column::Number("size")];
    Some(html! {
        p {
            @match summary.peak_bytes {
                Some(peak) => {
                    "The process took " strong { (Bytes(peak)) } " at its peak; " (Bytes(promise)) " were promised"
                    @if peak <= promise { ", and the promise was kept." }
                    @else { ": " strong { "more than promised." } }
                }
                None => { "The process was to take at most " (Bytes(promise)) "; this system does not say what it took." }
            }
            @if device > 0 { " Of the device's memory it promised to take " (Bytes(device)) "." }
            @if let Some(limit) = summary.memory { " The limit was " (Bytes(limit)) "." }
        }
        details {
            summary { "The ledger: every buffer" }
            (table(&columns, &rows))
            p.note { "Not all are held at the same time." }
        }
    })
}
