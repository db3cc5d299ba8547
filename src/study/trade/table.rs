//! The study as text: Markdown for the file, a few lines for the terminal.
//!
//! Markdown has no grey: rows that others dominate are set in italics, and say by what.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::Trade;
use super::report::{Effect, PSNR, Report, SECONDS};
use crate::knobs::Class;
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
    text += &numerical(report);
    text += &outcomes(report);
    text += &together(report);
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

fn numerical(report: &Report) -> String {
    let mut table = MarkdownTable::new(
        "knob | level | scene | standard rules [dB] | everything blended [dB] | largest error",
    );
    for image in &report.images {
        table.row(&[
            knob_or_exact(&image.knob).to_owned(),
            image.level.clone(),
            image.scene.clone(),
            format!("{:.1}", image.standard),
            format!("{:.1}", image.everything),
            format!("{:.1e}", image.worst),
        ]);
    }
    format!(
        "\n## Numerical error\n\nThe same model, rendered with the knob at the level, against a \
         renderer in float64: by the standard rules (alpha from 1/255, transmittance down to 1e-4), \
         and one that blends everything.\n\n{table}"
    )
}

fn knob_or_exact(knob: &str) -> &str {
    if knob.is_empty() { "(exact)" } else { knob }
}

fn outcomes(report: &Report) -> String {
    let mut table = MarkdownTable::new(
        "knob | level | class | ΔPSNR [dB] | ΔSSIM | ΔFLIP | depth error × | Chamfer × | time × | \
         processor time × | peak × | images [dB] | same bits | verdict",
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
         above −0.001, that of depth error below 1.02, and numerical PSNR is at least 60 dB.\n\n{table}"
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
    if effect.factor.class == Class::Exact && effect.same < effect.psnr.pairs {
        verdict.push("**not the same bits**".into());
    }
    if let Some(by) = &effect.dominated {
        verdict.push(format!("dominated by {by}"));
    }
    vec![
        effect.factor.name.clone(),
        effect.level.clone(),
        effect.factor.class.to_string(),
        effect.psnr.show(2),
        effect.ssim.show(4),
        effect.flip.show(4),
        maybe(&effect.depth),
        maybe(&effect.chamfer),
        ratio(&effect.seconds),
        maybe(&effect.cpu),
        ratio(&effect.peak),
        number_or_dash(effect.numerical, 1),
        format!("{} of {}", effect.same, effect.psnr.pairs),
        verdict.join(", "),
    ]
}

fn together(report: &Report) -> String {
    if report.together.is_empty() {
        return String::new();
    }
    let mut table = MarkdownTable::new(
        "knob | level | ΔPSNR alone [dB] | among others [dB] | time × alone | among others | interacts",
    );
    for one in &report.together {
        let [psnr, seconds] = one.alone;
        let differs =
            |k: usize| one.errors.is_some_and(|e| (one.among[k] - one.alone[k]).abs() > 2.0 * e[k]);
        let interacts = match (one.errors, differs(0), differs(1)) {
            (None, ..) => "not known: no column was left idle",
            (_, true, true) => "in PSNR and time",
            (_, true, false) => "in PSNR",
            (_, false, true) => "in time",
            _ => "no",
        };
        let error = one.errors.map_or_else(String::new, |e| format!(" ± {:.2}", e[0]));
        table.row(&[
            one.knob.clone(),
            one.level.clone(),
            format!("{psnr:+.2}"),
            format!("{:+.2}{error}", one.among[0]),
            format!("{:.3}", seconds.exp()),
            format!("{:.3}", one.among[1].exp()),
            interacts.to_owned(),
        ]);
    }
    format!(
        "\n## Knobs together\n\nThose whose effect on PSNR or time is more than two standard errors, \
         each at the fastest such level, in twelve runs after Plackett and Burman (1946) with the \
         first seed. Where an effect among others differs from the one alone by more than two \
         standard errors, knobs interact.\n\n{table}"
    )
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
            "| alpha_min | 1/32 | room | 42.0 | 41.0 | 1.0e-2 |",
            "| ssim_every | 5 | heuristic | +0.20 [+0.20, +0.20] |",
            "| *alpha_min* | *1/32* | *bounded* | *-0.90 [",
            "*dominated by alpha_min=1/64*",
            "| 0 of 3 | free |",
            "--policy=diet",
            "| (exact) |  | 50.00 |",
        ] {
            assert!(text.contains(words), "{words:?} is not in {text}");
        }
        assert!(!text.contains("Knobs together"));
        let said = summary(&report);
        assert!(said.contains("ssim_every=5") && said.contains("0.500   1.000  free"), "{said}");
    }
}
