//! The study as text: Markdown for the file, a few lines for the terminal.
//!
//! Markdown has no grey: rows that others dominate are set in italics, and say by what.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::Trade;
use super::report::{Effect, PSNR, Report, SECONDS};
use crate::number::grouped;
use crate::study::difference::{Difference, INTERVALS};
use crate::study::markdown::{MarkdownTable, number_or_dash};

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
    text += &stages(report);
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

fn knob_or_exact(knob: &str) -> &str {
    if knob.is_empty() { "(exact)" } else { knob }
}

fn outcomes(report: &Report) -> String {
    let mut table = MarkdownTable::new(
        "knob | level | ΔPSNR [dB] | ΔSSIM | ΔFLIP | depth error × | Chamfer × | time × | \
         processor time × | peak × | same bits | verdict",
    );
    for effect in &report.effects {
        let mut cells = row(effect);
        if effect.dominated.is_some() {
            for cell in cells.iter_mut().filter(|cell| !cell.is_empty()) {
                *cell = format!("*{cell}*");
            }
        }
        table.row(&cells);
    }
    format!(
        "\n## Outcome of training\n\nItalics: dominated, another level is nowhere worse and somewhere \
         better in PSNR, time and memory. Free: the interval of PSNR lies above −0.05 dB, that of SSIM \
         above −0.001, and that of depth error below 1.02.\n\n{table}"
    )
}

fn row(effect: &Effect) -> Vec<String> {
    let ratio = |d: &Difference| {
        let low_and_high = |[low, high]: [f64; 2]| format!("{:.3}, {:.3}", low.exp(), high.exp());
        format!("{:.3}{}", d.mean.exp(), d.within(low_and_high))
    };
    let maybe = |d: &Option<Difference>| d.as_ref().map_or_else(|| "–".to_owned(), ratio);
    let mut verdict: Vec<String> = Vec::new();
    if effect.free {
        verdict.push("free".into());
    }
    if effect.factor.is_exact && effect.same < effect.psnr.pairs {
        verdict.push("**not the same bits**".into());
    }
    if let Some(by) = &effect.dominated {
        verdict.push(format!("dominated by {by}"));
    }
    vec![
        effect.factor.name.clone(),
        effect.level.clone(),
        effect.psnr.show(2),
        effect.ssim.show(4),
        effect.flip.show(4),
        maybe(&effect.depth),
        maybe(&effect.chamfer),
        ratio(&effect.seconds),
        maybe(&effect.cpu),
        ratio(&effect.peak),
        format!("{} of {}", effect.same, effect.psnr.pairs),
        verdict.join(", "),
    ]
}

/// Seconds by stage of `exact` and of every level, as a mean over all runs.
fn stages(report: &Report) -> String {
    let mean = |knob: &str, level: &str| -> BTreeMap<String, f64> {
        let runs: Vec<_> = report.runs(knob, level).collect();
        let mut sums: BTreeMap<String, f64> = BTreeMap::new();
        for (stage, seconds) in runs.iter().flat_map(|run| &run.stage_seconds) {
            *sums.entry(stage.clone()).or_default() += seconds / runs.len() as f64;
        }
        sums
    };
    let base = mean("", "");
    let names: Vec<&String> = base.keys().collect();
    let titles = ["knob", "level"].into_iter().chain(names.iter().map(|name| &***name));
    let mut table = MarkdownTable::new(&titles.collect::<Vec<_>>().join(" | "));
    let levels = report.effects.iter().map(|e| (&*e.factor.name, &*e.level));
    for (knob, level) in std::iter::once(("", "")).chain(levels) {
        let seconds = mean(knob, level);
        let cell = |name: &&String| number_or_dash(seconds.get(*name).copied(), 2);
        let first = [knob_or_exact(knob).to_owned(), level.to_owned()];
        table.row(&first.into_iter().chain(names.iter().map(cell)).collect::<Vec<_>>());
    }
    format!("\n## Time by stage\n\nSeconds, means over all scenes and seeds.\n\n{table}")
}

/// A line per level.
pub(super) fn summary(report: &Report) -> String {
    let mut text = format!("{:<28}  dPSNR [dB]  time x  peak x", "knob");
    for effect in &report.effects {
        let name = format!("{}={}", effect.factor.name, effect.level);
        let free = if effect.free { "  free" } else { "" };
        let _ = write!(
            text,
            "\n{name:<28}  {:>+10.2}  {:>6.3}  {:>6.3}{free}",
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
    fn every_level_has_its_row_and_the_dominated_are_grey() {
        let report = sample();
        let text = markdown(&report);
        for words in [
            "| room | 31.00 | 100.0 | 64 |",
            "| sh_degree | 0 | +0.20 [+0.20, +0.20] |",
            "| *alpha_min* | *1/32* | *-0.90 [",
            "*dominated by alpha_min=1/64*",
            "| 0 of 3 | free |",
            "--policy=diet",
            "| (exact) |  | 50.00 |",
        ] {
            assert!(text.contains(words), "{words:?} is not in {text}");
        }
        let said = summary(&report);
        assert!(said.contains("sh_degree=0") && said.contains("0.500   1.000  free"), "{said}");
    }
}
