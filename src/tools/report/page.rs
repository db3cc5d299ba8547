//! Composes the page from its parts, the most important first.

use maud::{Markup, html};

use super::groups::Scene;
use super::pictures::{NamedPicture, Orbit, ScenePictures, ViewComparison};
use super::runs::RunRecord;
use super::scores::{self, last_step};
use super::{curves, edits, memory, options};
use densify_core::numbers::grouped;
use densify_html::page as whole_page;
use densify_run::failure::Failure;
use densify_train::evaluate::Split;

/// Composes the report.
pub(super) fn page(
    runs: &[RunRecord],
    scenes: &[Scene],
    pictures: &[ScenePictures],
) -> Result<String, Failure> {
    let title = match (runs, scenes) {
        ([run], _) => format!("{}: report of a run", run.name),
        (_, [scene]) => format!("{}: report of {} runs", scene.label, runs.len()),
        (_, scenes) => format!("Report of {} runs of {} scenes", runs.len(), scenes.len()),
    };
    let body = html! {
        header {
            h1 { (title) }
            p { (introduction(scenes)) }
            @for run in runs { @if let Some(note) = describe_unfinished(run) { p { strong { (note) } } } }
            @if let [run] = runs { (scores::summarise(run)) }
        }
        section {
            h2 { "Scores" }
            (scores::tabulate_runs(runs, scenes))
            @if runs.iter().all(|run| run.score().is_none()) {
                p.note { "No view was held out, or none was evaluated; train with --eval to get scores." }
            } @else {
                p.note { "Means over the views held out from training. Higher PSNR and SSIM are better, as is lower FLIP." }
            }
            @if let Some(means) = scores::tabulate_means(runs, scenes) { (means) }
            @if let Some(geometry) = scores::tabulate_geometry(runs) { (geometry) }
            @if let Some(differing) = options::list_differences(runs)? {
                h3 { "What differs between the runs" }
                (differing)
            }
        }
        @for (scene, pictures) in scenes.iter().zip(pictures) {
            section {
                h2 { "Views" @if scenes.len() > 1 { " of " (scene.label) } }
                (views(pictures))
            }
        }
        @if let Some(curves) = curves::draw(runs)? {
            section { h2 { "Over the iterations" } (curves) }
        }
        @for run in runs {
            section {
                h2 { @if runs.len() > 1 { (run.name) ": details" } @else { "Details" } }
                (details(run)?)
            }
        }
    };
    Ok(whole_page(&title, &body))
}

fn introduction(scenes: &[Scene]) -> Markup {
    let scenes: Vec<&str> = scenes.iter().map(|scene| &*scene.label).collect();
    html! {
        "3D Gaussian Splatting of " strong { (scenes.join(", ")) }
        ", by densify. Everything is in this file; nothing is loaded from elsewhere."
    }
}

/// A note on a run that is in training or was stopped.
fn describe_unfinished(run: &RunRecord) -> Option<String> {
    let (step, last) = (grouped(last_step(run) as usize), grouped(run.config.last() as usize));
    let iteration = grouped(run.iteration as usize);
    match &run.summary {
        _ if run.is_training => Some(format!(
            "{} is being trained and has reached iteration {step} of {last}; this report is about its model of \
             iteration {iteration}.",
            run.name
        )),
        Some(summary) if summary.finished => None,
        _ => Some(format!(
            "{} was stopped after iteration {step} of {last}; this report is about its model of iteration {iteration}.",
            run.name
        )),
    }
}

fn views(pictures: &ScenePictures) -> Markup {
    let count = grouped(pictures.count);
    let runs = pictures.orbits.len();
    html! {
        p {
            @match pictures.split {
                Split::Test => { "The worst and the best of " (count) " held-out views, by PSNR" }
                Split::Train => { "No view was held out: the worst and the best of " (count) " training views, by PSNR" }
            }
            @if runs > 1 { " with " (pictures.ranked_by) }
            ". Drag the border: the photograph is on its left, the render on its right."
        }
        div.figures { @for view in &pictures.views { (comparison_figure(view)) } }
        @if pictures.orbits.iter().any(|orbit| !orbit.frames.is_empty()) {
            h3 { "Around the scene" }
            div.figures { @for orbit in &pictures.orbits { (orbit_figure(orbit, runs > 1)) } }
        }
    }
}

/// A photograph and its renders, two of these pictures overlaid with a slider, and a crop of each picture.
fn comparison_figure(view: &ViewComparison) -> Markup {
    let (width, height) = view.pictures[0].picture.size;
    let has_several_renders = view.pictures.len() > 2;
    html! {
        figure.pair {
            div.stack style=(aspect_style(width, height)) {
                @for (at, NamedPicture { name, picture }) in view.pictures.iter().enumerate() {
                    img src=(picture.uri) alt=(format!("{}: {name}", view.name)) width=(width) height=(height)
                        class=[["left", "right"].get(at)];
                }
                div.border {}
            }
            input type="range" min="0" max="100" step="0.5" value="50"
                aria-label=(format!("Border between the pictures of {}", view.name));
            @if has_several_renders {
                div.choices {
                    (picture_choice("left", "Left", 0, &view.pictures))
                    (picture_choice("right", "Right", 1, &view.pictures))
                }
            }
            figcaption {
                strong { (view.name) } ", " (view.place)
                @for (run, [psnr, ssim, flip]) in &view.scores {
                    br;
                    @if has_several_renders { (run) ": " }
                    (format!("PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4}"))
                }
            }
            div.crops {
                @for NamedPicture { name, picture } in &view.crops {
                    @let (width, height) = picture.size;
                    div {
                        img src=(picture.uri) alt=(format!("{}, enlarged: {name}", view.name)) width=(width) height=(height);
                        (name)
                    }
                }
            }
        }
    }
}

/// The CSS for overlaid pictures of this size.
fn aspect_style(width: u32, height: u32) -> String {
    let ratio = f64::from(width) / f64::from(height);
    format!("aspect-ratio: {width} / {height}; --ratio: {ratio:.4}")
}

fn picture_choice(side: &str, label: &str, chosen: usize, pictures: &[NamedPicture]) -> Markup {
    html! {
        label { (label) " "
            select class=(side) {
                @for (at, NamedPicture { name, .. }) in pictures.iter().enumerate() {
                    option value=(at) selected[at == chosen] { (name) }
                }
            }
        }
    }
}

fn orbit_figure(orbit: &Orbit, is_named: bool) -> Markup {
    let Some(first) = orbit.frames.first() else { return html! {} };
    let (width, height) = first.size;
    let last = orbit.frames.len() - 1;
    html! {
        figure.turn {
            div.stack style=(aspect_style(width, height)) {
                @for (at, frame) in orbit.frames.iter().enumerate() {
                    img src=(frame.uri) alt=(format!("{}, turned by {}°", orbit.name, 360 * at / (last + 1)))
                        width=(width) height=(height) hidden[at > 0];
                }
            }
            input type="range" min="0" max=(last) step="1" value="0" aria-label=(format!("Turn around {}", orbit.name));
            @if is_named { figcaption { strong { (orbit.name) } } }
        }
    }
}

fn details(run: &RunRecord) -> Result<Markup, Failure> {
    Ok(html! {
        @if let Some(memory) = memory::describe(run) { h3 { "Memory" } (memory) }
        h3 { "Edits" }
        (edits::tabulate(run))
        @if let Some(reductions) = &run.reductions {
            h3 { "Automatic reductions" }
            @if reductions.left_out.is_empty() {
                p { "None" @if reductions.full { ", as requested (--full)" } "." }
            } @else {
                ul { @for reduction in &reductions.left_out {
                    li { strong { (reduction.what) } ": " (reduction.evidence) "; " (reduction.loss) "." }
                } }
            }
        }
        h3 { "Settings" }
        p.note {
            "densify " (run.config.densify) ", computed on "
            (run.config.resolved.adapter.as_deref().unwrap_or("the processor"))
            ". Options that differ from the defaults:"
        }
        (options::list(run)?)
    })
}
