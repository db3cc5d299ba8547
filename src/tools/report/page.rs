//! The page: its parts in order, what matters most first.

use maud::{Markup, html};

use super::groups::Groups;
use super::runs::Told;
use super::scores::{self, last_step};
use super::views::{Named, Shown, Turn, View};
use super::{curves, edits, memory, options};
use densify_core::numbers::grouped;
use densify_html::page as whole_page;
use densify_run::failure::Failure;
use densify_train::evaluate::Split;

/// The whole report.
pub(super) fn page(runs: &[Told], groups: &Groups, shown: &[Shown]) -> Result<String, Failure> {
    let title = match (runs, &groups.scenes[..]) {
        ([run], _) => format!("{}: report of a run", run.name),
        (_, [scene]) => format!("{}: report of {} runs", scene.label, runs.len()),
        (_, scenes) => format!("Report of {} runs of {} scenes", runs.len(), scenes.len()),
    };
    let body = html! {
        header {
            h1 { (title) }
            p { (introduction(groups)) }
            @for run in runs { @if let Some(state) = unfinished(run) { p { strong { (state) } } } }
            @if let [run] = runs { (scores::headline(run)) }
        }
        section {
            h2 { "Scores" }
            (scores::of_runs(runs, groups))
            @if runs.iter().all(|run| run.score().is_none()) {
                p.note { "No view was held out, or none was measured; train with --eval to have scores." }
            } @else {
                p.note { "Means over the views held out from training. Higher PSNR and SSIM are better, lower FLIP." }
            }
            @if let Some(means) = scores::of_groups(runs, groups) { (means) }
            @if let Some(geometry) = scores::geometry(runs) { (geometry) }
            @if let Some(differing) = options::differing(runs)? {
                h3 { "What differs between the runs" }
                (differing)
            }
        }
        @for (scene, shown) in groups.scenes.iter().zip(shown) {
            section {
                h2 { "Views" @if groups.scenes.len() > 1 { " of " (scene.label) } }
                (views(shown))
            }
        }
        @if let Some(curves) = curves::all(runs)? {
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

fn introduction(groups: &Groups) -> Markup {
    let scenes: Vec<&str> = groups.scenes.iter().map(|scene| &*scene.label).collect();
    html! {
        "3D Gaussian Splatting of " strong { (scenes.join(", ")) }
        ", by densify. Everything is in this file; nothing is loaded from elsewhere."
    }
}

/// What is to be known of a run that has not come to its end.
fn unfinished(run: &Told) -> Option<String> {
    let (step, last) = (grouped(last_step(run) as usize), grouped(run.config.last() as usize));
    let shown = grouped(run.iteration as usize);
    match &run.summary {
        _ if run.trains => Some(format!(
            "{} is being trained: it has come to iteration {step} of {last}, and what is shown is its model of \
             iteration {shown}.",
            run.name
        )),
        Some(summary) if summary.finished => None,
        _ => Some(format!(
            "{} was stopped after iteration {step} of {last}; what is shown is its model of iteration {shown}.",
            run.name
        )),
    }
}

fn views(shown: &Shown) -> Markup {
    let count = grouped(shown.count);
    let runs = shown.turns.len();
    html! {
        p {
            @match shown.split {
                Split::Test => { "The worst and the best of " (count) " views held out, by PSNR" }
                Split::Train => { "No view was held out: the worst and the best of " (count) " views trained on, by PSNR" }
            }
            @if runs > 1 { " with " (shown.ranked_by) }
            ". Move the border: the photograph is on the left of it, the render on the right."
        }
        div.figures { @for view in &shown.views { (pair(view)) } }
        @if shown.turns.iter().any(|turn| !turn.frames.is_empty()) {
            h3 { "Around the scene" }
            div.figures { @for turn in &shown.turns { (around(turn, runs > 1)) } }
        }
    }
}

/// A photograph and its renders, two of them over each other, and a window of each.
fn pair(view: &View) -> Markup {
    let (width, height) = view.pictures[0].picture.size;
    let several = view.pictures.len() > 2;
    html! {
        figure.pair {
            div.stack style=(shape(width, height)) {
                @for (at, Named { name, picture }) in view.pictures.iter().enumerate() {
                    img src=(picture.uri) alt=(format!("{}: {name}", view.name)) width=(width) height=(height)
                        class=[["left", "right"].get(at)];
                }
                div.border {}
            }
            input type="range" min="0" max="100" step="0.5" value="50"
                aria-label=(format!("Border between the pictures of {}", view.name));
            @if several {
                div.choices {
                    (choice("left", "Left", 0, &view.pictures))
                    (choice("right", "Right", 1, &view.pictures))
                }
            }
            figcaption {
                strong { (view.name) } ", " (view.place)
                @for (run, [psnr, ssim, flip]) in &view.scores {
                    br;
                    @if several { (run) ": " }
                    (format!("PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4}"))
                }
            }
            div.crops {
                @for Named { name, picture } in &view.crops {
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

/// What a stack of pictures of this size needs to be told, as they lie over each other.
fn shape(width: u32, height: u32) -> String {
    let ratio = f64::from(width) / f64::from(height);
    format!("aspect-ratio: {width} / {height}; --ratio: {ratio:.4}")
}

fn choice(side: &str, label: &str, chosen: usize, pictures: &[Named]) -> Markup {
    html! {
        label { (label) " "
            select class=(side) {
                @for (at, Named { name, .. }) in pictures.iter().enumerate() {
                    option value=(at) selected[at == chosen] { (name) }
                }
            }
        }
    }
}

fn around(turn: &Turn, is_named: bool) -> Markup {
    let Some(first) = turn.frames.first() else { return html! {} };
    let (width, height) = first.size;
    let last = turn.frames.len() - 1;
    html! {
        figure.turn {
            div.stack style=(shape(width, height)) {
                @for (at, frame) in turn.frames.iter().enumerate() {
                    img src=(frame.uri) alt=(format!("{}, turned by {}°", turn.name, 360 * at / (last + 1)))
                        width=(width) height=(height) hidden[at > 0];
                }
            }
            input type="range" min="0" max=(last) step="1" value="0" aria-label=(format!("Turn around {}", turn.name));
            @if is_named { figcaption { strong { (turn.name) } } }
        }
    }
}

fn details(run: &Told) -> Result<Markup, Failure> {
    Ok(html! {
        @if let Some(memory) = memory::of_run(run) { h3 { "Memory" } (memory) }
        h3 { "Edits" }
        (edits::of_run(run))
        @if let Some(reductions) = &run.reductions {
            h3 { "What was left out automatically" }
            @if reductions.left_out.is_empty() {
                p { "Nothing" @if reductions.full { ", as asked (--full)" } "." }
            } @else {
                ul { @for left in &reductions.left_out {
                    li { strong { (left.what) } ": " (left.evidence) "; " (left.loss) "." }
                } }
            }
        }
        h3 { "Settings" }
        p.note {
            "densify " (run.config.densify) ", computed on "
            (run.config.resolved.adapter.as_deref().unwrap_or("the processor"))
            ". Options that are not the default:"
        }
        (options::of_run(run)?)
    })
}
