//! Tables of scores: of every run, and means over seeds with intervals and paired differences.

use maud::{Markup, html};

use super::groups::{Group, Scene};
use super::runs::RunRecord;
use densify_core::memory::Bytes;
use densify_core::numbers::{duration, grouped, percent};
use densify_html::{Column, Table};
use densify_study::difference::{Difference, Pair};
use densify_train::evaluate::Mean;

const DASH: &str = "–";

/// Name, value and number of decimals of a score.
type Score = (&'static str, fn(&Mean) -> f64, usize);

const SCORES: [Score; 3] = [
    ("PSNR [dB]", |mean| mean.psnr, 2),
    ("SSIM", |mean| mean.ssim, 4),
    ("FLIP", |mean| mean.flip, 4),
];

/// Summarises a single run by its most important numbers.
pub(super) fn summarise(run: &RunRecord) -> Markup {
    let score = run.score();
    let summary = run.summary.as_ref();
    let of_budget = format!("of at most {}", grouped(run.config.budget));
    let promised = summary.map(|summary| format!("{} promised", Bytes(summary.ledger_bytes)));
    html! {
        dl.numbers {
            @for (name, value, digits) in SCORES {
                @if let Some(score) = &score {
                    div { dt { (name.trim_end_matches(" [dB]")) }
                        dd { (number(value(score), digits)) @if name.ends_with("[dB]") { " dB" } } }
                }
            }
            @if let Some(rows) = run.rows() {
                div { dt { "Gaussians" } dd { (grouped(rows)) small { (of_budget) } } }
            }
            @if let Some(peak) = run.peak_bytes() {
                div { dt { "Memory at its peak" } dd { (Bytes(peak)) @if let Some(promised) = promised { small { (promised) } } } }
            }
            @if let Some(seconds) = run.seconds() {
                div { dt { "Time" } dd { (time(seconds)) small { (grouped(last_step(run) as usize)) " iterations" } } }
            }
        }
    }
}

/// The last completed iteration of a run.
pub(super) fn last_step(run: &RunRecord) -> u32 {
    let so_far = run.steps.last().map_or(run.iteration, |step| step.step);
    run.summary.as_ref().map_or(so_far, |summary| summary.iterations)
}

pub(super) fn time(seconds: f64) -> String {
    duration(std::time::Duration::try_from_secs_f64(seconds).unwrap_or_default())
}

fn number(value: f64, digits: usize) -> String {
    if value.is_nan() { DASH.to_owned() } else { format!("{value:.digits$}") }
}

/// Tabulates all runs.
pub(super) fn tabulate_runs(runs: &[RunRecord], scenes: &[Scene]) -> Markup {
    let has_lpips = runs.iter().any(|run| run.score().is_some_and(|mean| mean.lpips.is_some()));
    let mut columns = vec![Column::text("run")];
    if scenes.len() > 1 {
        columns.push(Column::text("scene"));
    }
    columns.extend([Column::text("policy"), Column::number("seed"), Column::number("iteration")]);
    columns.extend(SCORES.map(|(name, ..)| Column::number(name)));
    if has_lpips {
        columns.push(Column::number("LPIPS"));
    }
    let rest = ["Gaussians", "at the peak", "budget", "peak memory", "time"];
    columns.extend(rest.map(Column::number));
    let scene_of = |number: usize| {
        let has = |scene: &&Scene| scene.groups.iter().any(|group| group.runs.contains(&number));
        scenes.iter().find(has).map_or(DASH.to_owned(), |scene| scene.label.clone())
    };
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| DASH.to_owned());
    let row = |(at, run): (usize, &RunRecord)| {
        let mut row = vec![run.name.clone()];
        if scenes.len() > 1 {
            row.push(scene_of(at));
        }
        let spec = &run.config.spec;
        row.extend([
            spec.density.policy.clone(),
            spec.schedule.seed.to_string(),
            grouped(run.iteration as usize),
        ]);
        let score = run.score();
        let cell =
            |(_, value, digits): Score| or_dash(score.map(|mean| number(value(&mean), digits)));
        row.extend(SCORES.map(cell));
        if has_lpips {
            row.push(or_dash(score.and_then(|mean| Some(number(mean.lpips?, 4)))));
        }
        let peak = run.summary.as_ref().map(|summary| grouped(summary.peak_rows));
        row.extend([
            or_dash(run.rows().map(grouped)),
            or_dash(peak),
            grouped(run.config.budget),
            or_dash(run.peak_bytes().map(|bytes| Bytes(bytes).to_string())),
            or_dash(run.seconds().map(time)),
        ]);
        row
    };
    let mut table = Table::new(columns);
    runs.iter().enumerate().for_each(|run| table.row(row(run)));
    table.to_html()
}

/// Tabulates means over seeds, and differences from the first group of each scene; `None` if no scene has two runs.
pub(super) fn tabulate_means(runs: &[RunRecord], scenes: &[Scene]) -> Option<Markup> {
    let count = |scene: &Scene| scene.groups.iter().map(|group| group.runs.len()).sum::<usize>();
    let several: Vec<&Scene> = scenes.iter().filter(|scene| count(scene) > 1).collect();
    if several.is_empty() {
        return None;
    }
    Some(html! {
        h3 { "Means over seeds" }
        @for scene in several {
            @if scenes.len() > 1 { p { strong { (scene.label) } } }
            (tabulate_scene(scene, runs))
        }
        p.note {
            "Brackets are 95 % intervals of the mean by Student's t, given for three seeds or more."
            @if scenes.iter().any(|scene| scene.groups.len() > 1) {
                " Differences are between runs of the same seed."
            }
        }
    })
}

fn tabulate_scene(scene: &Scene, runs: &[RunRecord]) -> Markup {
    let first = &scene.groups[0];
    let against = format!("PSNR against {} [dB]", first.label);
    let mut columns = vec![Column::text("settings"), Column::number("runs")];
    columns.extend(SCORES.map(|(name, ..)| Column::number(name)));
    if scene.groups.len() > 1 {
        columns.push(Column::number(&against));
    }
    let row = |group: &Group| {
        let mut row = vec![group.label.clone(), group.runs.len().to_string()];
        for (_, value, digits) in SCORES {
            let values = values_by_seed(group, runs, |run| run.score().map(|mean| value(&mean)));
            row.push(format_mean(&values, digits));
        }
        if scene.groups.len() > 1 {
            let is_first = std::ptr::eq(group, first);
            row.push(if is_first { DASH.to_owned() } else { psnr_difference(group, first, runs) });
        }
        row
    };
    let mut table = Table::new(columns);
    scene.groups.iter().for_each(|group| table.row(row(group)));
    table.to_html()
}

/// A value of each run of a group, with its seed: [`Pair::difference`] is the value itself.
fn values_by_seed(
    group: &Group,
    runs: &[RunRecord],
    value: impl Fn(&RunRecord) -> Option<f64>,
) -> Vec<Pair<'static>> {
    let pair = |&run: &usize| {
        let seed = runs[run].config.spec.schedule.seed as u32;
        Some(Pair { scene: "", seed, difference: value(&runs[run])? })
    };
    group.runs.iter().filter_map(pair).collect()
}

/// Formats the mean with its interval, as `30.12 [29.95, 30.29]`.
fn format_mean(values: &[Pair<'_>], digits: usize) -> String {
    let Some(value) = Difference::new(values) else { return DASH.to_owned() };
    let interval = value.format_interval(|[low, high]| format!("{low:.digits$}, {high:.digits$}"));
    format!("{:.digits$}{interval}", value.mean)
}

fn psnr_difference(group: &Group, first: &Group, runs: &[RunRecord]) -> String {
    let psnr = |run: &RunRecord| run.score().map(|mean| mean.psnr);
    let base = values_by_seed(first, runs, psnr);
    let pair = |pair: Pair<'static>| {
        let other = base.iter().find(|other| other.seed == pair.seed)?;
        Some(Pair { difference: pair.difference - other.difference, ..pair })
    };
    let differences: Vec<Pair<'_>> =
        values_by_seed(group, runs, psnr).into_iter().filter_map(pair).collect();
    Difference::new(&differences).map_or_else(|| DASH.to_owned(), |difference| difference.format(2))
}

/// Tabulates geometric errors against the known surface; `None` if it is not known.
pub(super) fn tabulate_geometry(runs: &[RunRecord]) -> Option<Markup> {
    let row = |run: &RunRecord| {
        let geometry = run.geometry.as_ref()?;
        Some([
            run.name.clone(),
            percent(geometry.depth.rmse),
            percent(geometry.centres.chamfer),
            percent(geometry.centres.f_score_one_percent),
            percent(geometry.floaters.of_rows),
        ])
    };
    let numbers = ["depth RMSE", "Chamfer distance", "F-score at 1 %", "floaters, of Gaussians"];
    let mut table =
        Table::new(std::iter::once(Column::text("run")).chain(numbers.map(Column::number)));
    runs.iter().filter_map(row).for_each(|row| table.row(row));
    (!table.is_empty()).then(|| {
        html! {
            h3 { "Geometry" }
            (table.to_html())
            p.note { "Against the known surface; lengths as fractions of the diagonal of its bounding box." }
        }
    })
}
