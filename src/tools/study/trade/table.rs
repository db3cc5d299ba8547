//! The report of the study: a document, and a few lines for the terminal.

use std::fmt::Write;

use super::Trade;
use super::report::{Effect, PSNR, Report, SECONDS};
use crate::columns::number_or_dash;
use crate::difference::{Difference, INTERVALS};
use densify_core::numbers::grouped;
use densify_html::{Column, Document, Table, Text};

/// The study as a document, without plots.
pub(super) fn document(report: &Report) -> Document {
    let mut document = Document::new("What each knob costs and buys");
    let Trade { iterations, budget, seeds, train, .. } = &report.study;
    let mut text = Text::from(format!(
        "densify {}; scenes: {}; {} iterations, at most {} rows, {seeds} {} per level.",
        env!("CARGO_PKG_VERSION"),
        report.scenes.join(", "),
        grouped(*iterations as usize),
        grouped(*budget),
        if *seeds == 1 { "seed" } else { "seeds" },
    ));
    if !train.is_empty() {
        text = text.plain(" Options of every run: ").code(&train.join(" ")).plain(".");
    }
    let differences = format!(
        " with the same scene and seed; ratios are geometric means. {INTERVALS}. Scores are of views held out, \
         rendered without any shortcut."
    );
    document.paragraph(text.plain(" Differences are from ").code("exact").plain(&differences));
    document.section("exact");
    document.table(exact_table(report));
    document.section("Outcome of training");
    document.table(outcome_table(report));
    document
}

/// The runs with the preset `exact`, from which differences are taken.
fn exact_table(report: &Report) -> Table {
    let mut table = Table::new(["scene", "PSNR [dB]", "time [s]", "peak [MiB]"].map(Column::text));
    for scene in &report.scenes {
        let psnr = number_or_dash(report.mean(scene, "", "", PSNR), 2);
        let seconds = number_or_dash(report.mean(scene, "", "", SECONDS).map(f64::exp), 1);
        let peak = number_or_dash(report.peak_mib(scene, "", ""), 0);
        table.row([scene.clone(), psnr, seconds, peak]);
    }
    table
}

fn outcome_table(report: &Report) -> Table {
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
    for effect in &report.effects {
        table.row(row(effect));
    }
    table
}

fn row(effect: &Effect) -> Vec<Text> {
    let ratio = |d: &Difference| {
        let low_and_high = |[low, high]: [f64; 2]| format!("{:.3}, {:.3}", low.exp(), high.exp());
        format!("{:.3}{}", d.mean.exp(), d.within(low_and_high))
    };
    let mut same = Text::from(format!("{} of {}", effect.same, effect.psnr.pairs));
    if effect.factor.is_exact && effect.same < effect.psnr.pairs {
        same = same.plain(": ").bold("not exact");
    }
    vec![
        effect.factor.name.as_str().into(),
        effect.level.as_str().into(),
        effect.psnr.show(2).into(),
        effect.ssim.show(4).into(),
        ratio(&effect.seconds).into(),
        effect.cpu.as_ref().map_or_else(|| "–".to_owned(), ratio).into(),
        ratio(&effect.peak).into(),
        same,
    ]
}

/// A line per level.
pub(super) fn summary(report: &Report) -> String {
    let mut text = format!("{:<28}  dPSNR [dB]  time x  peak x", "knob");
    for effect in &report.effects {
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
    use super::super::report::sample;
    use super::*;

    #[test]
    fn every_level_has_its_row() {
        let report = sample();
        let text = document(&report).to_string();
        for words in [
            "| room | 31.00 | 100.0 | 64 |",
            "| sh_degree | 0 | +0.20 [+0.20, +0.20] |",
            "| alpha_min | 1/32 | -0.90 [",
            "| 0 of 3 |",
            "--policy=diet",
        ] {
            assert!(text.contains(words), "{words:?} is not in {text}");
        }
        let said = summary(&report);
        assert!(said.contains("sh_degree=0") && said.contains("0.500   1.000"), "{said}");
    }
}
