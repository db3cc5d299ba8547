//! The study as text: Markdown for the file, a few lines for the terminal.

use std::fmt::Write;

use super::Trade;
use super::report::{Effect, PSNR, Report, SECONDS};
use crate::difference::{Difference, INTERVALS};
use crate::markdown::{MarkdownTable, number_or_dash};
use densify_core::numbers::grouped;

/// The whole study.
pub(super) fn markdown(report: &Report) -> String {
    let mut text = String::from("# What each knob costs and buys\n\n");
    let Trade { iterations, budget, seeds, train, .. } = &report.study;
    let options = match train.join(" ") {
        words if words.is_empty() => String::new(),
        words => format!(" Options of every run: `{words}`."),
    };
    let _ = writeln!(
        text,
        "densify {}; scenes: {}; {} iterations, at most {} rows, {seeds} {} per level.{options} \
         Differences are from `exact` with the same scene and seed; ratios are \
         geometric means. {INTERVALS}. Scores are of views held out, rendered without any shortcut.",
        env!("CARGO_PKG_VERSION"),
        report.scenes.join(", "),
        grouped(*iterations as usize),
        grouped(*budget),
        if *seeds == 1 { "seed" } else { "seeds" },
    );
    text += &exact(report);
    text += &outcomes(report);
    text
}

/// What the differences are from.
fn exact(report: &Report) -> String {
    let mut table = MarkdownTable::new("scene | PSNR [dB] | time [s] | peak [MiB]");
    for scene in &report.scenes {
        let psnr = number_or_dash(report.mean(scene, "", "", PSNR), 2);
        let seconds = number_or_dash(report.mean(scene, "", "", SECONDS).map(f64::exp), 1);
        let peak = number_or_dash(report.peak_mib(scene, "", ""), 0);
        table.row(&[scene.clone(), psnr, seconds, peak]);
    }
    format!("\n## exact\n\n{table}")
}

fn outcomes(report: &Report) -> String {
    let mut table = MarkdownTable::new(
        "knob | level | ΔPSNR [dB] | ΔSSIM | time × | processor time × | peak × | same bits",
    );
    for effect in &report.effects {
        table.row(&row(effect));
    }
    format!("\n## Outcome of training\n\n{table}")
}

fn row(effect: &Effect) -> Vec<String> {
    let ratio = |d: &Difference| {
        let low_and_high = |[low, high]: [f64; 2]| format!("{:.3}, {:.3}", low.exp(), high.exp());
        format!("{:.3}{}", d.mean.exp(), d.within(low_and_high))
    };
    let broken = effect.factor.is_exact && effect.same < effect.psnr.pairs;
    let broken = if broken { ": **not exact**" } else { "" };
    vec![
        effect.factor.name.clone(),
        effect.level.clone(),
        effect.psnr.show(2),
        effect.ssim.show(4),
        ratio(&effect.seconds),
        effect.cpu.as_ref().map_or_else(|| "–".to_owned(), ratio),
        ratio(&effect.peak),
        format!("{} of {}{broken}", effect.same, effect.psnr.pairs),
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
        let text = markdown(&report);
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
