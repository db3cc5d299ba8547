//! The scores: of every run, and their means over seeds with intervals and paired differences.

use maud::{Markup, html};

use super::groups::{Group, Groups, Scene};
use super::runs::Told;
use densify_core::memory::Bytes;
use densify_core::numbers::{duration, grouped, percent};
use densify_html::{Column, table};
use densify_study::difference::{Difference, Pair};
use densify_train::evaluate::Mean;

const NOTHING: &str = "–";

/// A score and how many digits of it are told.
type Score = (&'static str, fn(&Mean) -> f64, usize);

const SCORES: [Score; 3] = [
    ("PSNR [dB]", |mean| mean.psnr, 2),
    ("SSIM", |mean| mean.ssim, 4),
    ("FLIP", |mean| mean.flip, 4),
];

/// The numbers of a single run that matter most.
pub(super) fn headline(run: &Told) -> Markup {
    let score = run.score();
    let summary = run.summary.as_ref();
    let of_budget = format!("of at most {}", grouped(run.config.budget()));
    let promised = summary.map(|it| format!("{} promised", Bytes(it.ledger_bytes)));
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

/// The iteration that a run has come to.
pub(super) fn last_step(run: &Told) -> u32 {
    let so_far = run.steps.last().map_or(run.iteration, |step| step.step);
    run.summary.as_ref().map_or(so_far, |summary| summary.iterations)
}

pub(super) fn time(seconds: f64) -> String {
    duration(std::time::Duration::try_from_secs_f64(seconds).unwrap_or_default())
}

fn number(value: f64, digits: usize) -> String {
    if value.is_nan() { NOTHING.to_owned() } else { format!("{value:.digits$}") }
}

/// Every run.
pub(super) fn of_runs(runs: &[Told], groups: &Groups) -> Markup {
    let has_lpips = runs.iter().any(|run| run.score().is_some_and(|mean| mean.lpips.is_some()));
    let mut columns = vec![Column::Text("run")];
    if groups.scenes.len() > 1 {
        columns.push(Column::Text("scene"));
    }
    columns.extend([Column::Text("policy"), Column::Number("seed"), Column::Number("iteration")]);
    columns.extend(SCORES.map(|(name, ..)| Column::Number(name)));
    if has_lpips {
        columns.push(Column::Number("LPIPS"));
    }
    let rest = ["Gaussians", "at the peak", "budget", "peak memory", "time"];
    columns.extend(rest.map(Column::Number));
    let scene_of = |number: usize| {
        let has = |scene: &&Scene| scene.groups.iter().any(|group| group.runs.contains(&number));
        groups.scenes.iter().find(has).map_or(NOTHING.to_owned(), |scene| scene.label.clone())
    };
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| NOTHING.to_owned());
    let row = |(at, run): (usize, &Told)| {
        let mut row = vec![run.name.clone()];
        if groups.scenes.len() > 1 {
            row.push(scene_of(at));
        }
        let spec = &run.config.spec;
        row.extend([
            spec.density.policy.clone(),
            spec.schedule.seed.to_string(),
            grouped(run.iteration as usize),
        ]);
        let score = run.score();
        let cell = |(_, value, digits): Score| or_dash(score.map(|it| number(value(&it), digits)));
        row.extend(SCORES.map(cell));
        if has_lpips {
            row.push(or_dash(score.and_then(|mean| Some(number(mean.lpips?, 4)))));
        }
        let peak = run.summary.as_ref().map(|summary| grouped(summary.peak_rows));
        row.extend([
            or_dash(run.rows().map(grouped)),
            or_dash(peak),
            grouped(run.config.budget()),
            or_dash(run.peak_bytes().map(|bytes| Bytes(bytes).to_string())),
            or_dash(run.seconds().map(time)),
        ]);
        row
    };
    let rows: Vec<Vec<String>> = runs.iter().enumerate().map(row).collect();
    table(&columns, &rows)
}

/// Means over seeds, and differences from the first group of each scene; nothing where no scene has two runs.
pub(super) fn of_groups(runs: &[Told], groups: &Groups) -> Option<Markup> {
    let several = groups.scenes.iter().filter(|scene| count(scene) > 1);
    let several: Vec<&Scene> = several.collect();
    if several.is_empty() {
        return None;
    }
    Some(html! {
        h3 { "Means over seeds" }
        @for scene in several {
            @if groups.scenes.len() > 1 { p { strong { (scene.label) } } }
            (of_scene(scene, runs))
        }
        p.note {
            "Brackets are 95 % intervals of the mean by Student's t, from three seeds on."
            @if groups.scenes.iter().any(|scene| scene.groups.len() > 1) {
                " Differences are taken between runs of the same seed."
            }
        }
    })
}

fn count(scene: &Scene) -> usize {
    scene.groups.iter().map(|group| group.runs.len()).sum()
}

fn of_scene(scene: &Scene, runs: &[Told]) -> Markup {
    let first = &scene.groups[0];
    let against = format!("PSNR against {} [dB]", first.label);
    let mut columns = vec![Column::Text("settings"), Column::Number("runs")];
    columns.extend(SCORES.map(|(name, ..)| Column::Number(name)));
    if scene.groups.len() > 1 {
        columns.push(Column::Number(&against));
    }
    let row = |group: &Group| {
        let mut row = vec![group.label.clone(), group.runs.len().to_string()];
        for (_, value, digits) in SCORES {
            let values = pairs(group, runs, |run| run.score().map(|mean| value(&mean)));
            row.push(mean_of(&values, digits));
        }
        if scene.groups.len() > 1 {
            row.push(if std::ptr::eq(group, first) {
                NOTHING.to_owned()
            } else {
                against_first(group, first, runs)
            });
        }
        row
    };
    let rows: Vec<Vec<String>> = scene.groups.iter().map(row).collect();
    table(&columns, &rows)
}

/// Values of the runs of a group, with their seeds.
fn pairs(group: &Group, runs: &[Told], value: impl Fn(&Told) -> Option<f64>) -> Vec<Pair<'static>> {
    let pair = |&run: &usize| {
        let seed = runs[run].config.spec.schedule.seed as u32;
        Some(Pair { scene: "", seed, difference: value(&runs[run])? })
    };
    group.runs.iter().filter_map(pair).collect()
}

/// `30.12 [29.95, 30.29]`
fn mean_of(values: &[Pair<'_>], digits: usize) -> String {
    let Some(found) = Difference::new(values) else { return NOTHING.to_owned() };
    let within = found.within(|[low, high]| format!("{low:.digits$}, {high:.digits$}"));
    format!("{:.digits$}{within}", found.mean)
}

fn against_first(group: &Group, first: &Group, runs: &[Told]) -> String {
    let psnr = |run: &Told| run.score().map(|mean| mean.psnr);
    let base = pairs(first, runs, psnr);
    let pair = |pair: Pair<'static>| {
        let other = base.iter().find(|other| other.seed == pair.seed)?;
        Some(Pair { difference: pair.difference - other.difference, ..pair })
    };
    let differences: Vec<Pair<'_>> =
        pairs(group, runs, psnr).into_iter().filter_map(pair).collect();
    Difference::new(&differences).map_or_else(|| NOTHING.to_owned(), |found| found.show(2))
}

/// How the models sit on the known surface; nothing where none is known.
pub(super) fn geometry(runs: &[Told]) -> Option<Markup> {
    let row = |run: &Told| {
        let it = run.geometry.as_ref()?;
        Some(vec![
            run.name.clone(),
            percent(it.depth.rmse),
            percent(it.centres.chamfer),
            percent(it.centres.f_score_one_percent),
            percent(it.floaters.of_rows),
        ])
    };
    let rows: Vec<Vec<String>> = runs.iter().filter_map(row).collect();
    let numbers = ["depth RMSE", "Chamfer distance", "F-score at 1 %", "floaters, of all"];
    let columns: Vec<Column<'_>> =
        std::iter::once(Column::Text("run")).chain(numbers.map(Column::Number)).collect();
    (!rows.is_empty()).then(|| {
        html! {
            h3 { "Geometry" }
            (table(&columns, &rows))
            p.note { "Against the known surface; lengths as shares of the diagonal of its box." }
        }
    })
}
