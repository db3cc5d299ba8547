//! The report of the study, and its summary for the terminal.

use std::fmt::Write;

use super::Trade;
use super::results::{Effect, LOG_SECONDS, PSNR, Results};
use crate::difference::{Difference, INTERVALS};
use crate::text_table::{number_or_dash, or_dash};
use densify_core::numbers::grouped;
use densify_html::{Column, Document, Table, Text};

/// Creates the report without plots.
pub(super) fn document(results: &Results) -> Document {
    let mut document = Document::new("What each knob costs and buys");
    let Trade { iterations, budget, seeds, train, .. } = &results.study;
    let mut text = Text::from(format!(
        "densify {}; scenes: {}; {} iterations, at most {} rows, {seeds} {} per level.",
        env!("CARGO_PKG_VERSION"),
        results.scenes.join(", "),
        grouped(*iterations as usize),
        grouped(*budget),
        if *seeds == 1 { "seed" } else { "seeds" },
    ));
    if !train.is_empty() {
        text = text.plain(" Options of every run: ").code(&train.join(" ")).plain(".");
    }
    let differences = format!(
        " with the same scene and seed; ratios are geometric means. {INTERVALS}. Scores are those of held-out views, \
         rendered without any shortcut."
    );
    document.paragraph(text.plain(" Differences are from ").code("exact").plain(&differences));
    document.section("exact");
    document.table(exact_table(results));
    document.section("Outcome of training");
    document.table(outcome_table(results));
    document
}

/// Tabulates the runs with the preset `exact`, to which differences refer.
fn exact_table(results: &Results) -> Table {
    let mut table = Table::new(["scene", "PSNR [dB]", "time [s]", "peak [MiB]"].map(Column::text));
    for scene in &results.scenes {
        let psnr = number_or_dash(results.mean(scene, "", "", PSNR), 2);
        let seconds = number_or_dash(results.mean(scene, "", "", LOG_SECONDS).map(f64::exp), 1);
        let peak = number_or_dash(results.peak_mib(scene, "", ""), 0);
        table.row([scene.clone(), psnr, seconds, peak]);
    }
    table
}

fn outcome_table(results: &Results) -> Table {
    let columns = [
        "knob",
        "level",
        "ΔPSNR [dB]",
        "ΔSSIM",
        "time ×",
        "processor time ×",
        "peak ×",
        "same bits",
    ];
    let mut table = Table::new(columns.map(Column::text));
    for effect in &results.effects {
        table.row(row(effect));
    }
    table
}

fn row(effect: &Effect) -> Vec<Text> {
    let ratio = |d: &Difference| {
        let bounds = |[low, high]: [f64; 2]| format!("{:.3}, {:.3}", low.exp(), high.exp());
        format!("{:.3}{}", d.mean.exp(), d.format_interval(bounds))
    };
    let mut identical = Text::from(format!("{} of {}", effect.identical, effect.psnr.pairs));
    if effect.factor.is_exact && effect.identical < effect.psnr.pairs {
        identical = identical.plain(": ").bold("not exact");
    }
    vec![
        effect.factor.name.as_str().into(),
        effect.level.as_str().into(),
        effect.psnr.format(2).into(),
        effect.ssim.format(4).into(),
        ratio(&effect.seconds).into(),
        or_dash(effect.cpu.as_ref().map(ratio)).into(),
        ratio(&effect.peak).into(),
        identical,
    ]
}

/// Formats a line per level for the terminal.
pub(super) fn summary(results: &Results) -> String {
    let mut text = format!("{:<28}  dPSNR [dB]  time x  peak x", "knob");
    for effect in &results.effects {
        let name = format!("{}={}", effect.factor.name, effect.level);
        let _ = write!(
            text,
            "\n{name:<28}  {:>+10.2}  {:>6.3}  {:>6.3}",
            effect.psnr.mean,
            effect.seconds.mean.exp(),
            effect.peak.mean.exp()
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::results::sample;
    use super::*;

    #[test]
    fn every_level_has_its_row() {
        let results = sample();
        let text = document(&results).to_string();
        for words in [
            "| room | 31.00 | 100.0 | 64 |",
            "| sh_degree | 0 | +0.20 [+0.20, +0.20] |",
            "| alpha_min | 1/32 | -0.90 [",
            "| 0 of 3 |",
            "--policy=diet",
        ] {
            assert!(text.contains(words), "{words:?} is not in {text}");
        }
        let summary = summary(&results);
        assert!(summary.contains("sh_degree=0") && summary.contains("0.500   1.000"), "{summary}");
    }
}
