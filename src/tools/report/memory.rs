//! Memory of a run: peak, promised limit, and the ledger.

use maud::{Markup, html};

use super::runs::RunRecord;
use densify_core::memory::{Bytes, LedgerLine};
use densify_html::{Column, Table};

/// The host memory that a run promised not to exceed `[bytes]`. Device memory is left out, as the system's measurements
/// do not include it.
pub(super) fn promised_host_bytes(run: &RunRecord) -> Option<u64> {
    let summary = run.summary.as_ref()?;
    Some(match summary.ledger.on_device() {
        0 => summary.ledger_bytes,
        _ => summary.ledger.on_host(),
    })
}

/// Describes peak, promise and ledger of a run; `None` while it trains.
pub(super) fn describe(run: &RunRecord) -> Option<Markup> {
    let summary = run.summary.as_ref()?;
    let promise = promised_host_bytes(run)?;
    let device = summary.ledger.on_device();
    let mut lines: Vec<&LedgerLine> = summary.ledger.lines.iter().collect();
    lines.sort_by_key(|line| line.section);
    let mut ledger =
        Table::new([Column::text("part"), Column::text("buffer"), Column::number("size")]);
    for line in lines {
        let place = if line.on_device { " (on the device)" } else { "" };
        ledger.row([
            line.section.name().to_owned(),
            format!("{}{place}", line.what),
            Bytes(line.bytes).to_string(),
        ]);
    }
    Some(html! {
        p {
            @match summary.peak_bytes {
                Some(peak) => {
                    "The process took " strong { (Bytes(peak)) } " at its peak; it promised to take at most " (Bytes(promise))
                    @if peak <= promise { ", and the promise was kept." }
                    @else { ". " strong { "The promise was exceeded." } }
                }
                None => { "The process promised to take at most " (Bytes(promise)) "; this system does not report its peak." }
            }
            @if device > 0 { " It promised to take at most " (Bytes(device)) " of the device's memory." }
            @if let Some(limit) = summary.memory { " The limit was " (Bytes(limit)) "." }
        }
        details {
            summary { "The ledger: every buffer" }
            (ledger.to_html())
            p.note { "Not all buffers exist at the same time." }
        }
    })
}
