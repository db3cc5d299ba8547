//! Plots quality against the limit, and Gaussians, PSNR and memory over the iterations.

use std::collections::BTreeMap;
use std::path::Path;

use super::{Outcome, outcomes_at, scenes_and_limits};
use crate::Limit;
use crate::Picture;
use crate::difference::mean;
use crate::distinct;
use crate::panel::{COLOURS, Curve, Panel, svg};
use crate::plot;
use densify_run::Observer;
use densify_run::failure::Failure;
use densify_train::output::{StepRecord, steps_of};

/// Size of a panel `[px]`.
const PANEL: (u32, u32) = (720, 300);

/// Draws all plots into the folder `output`. Runs whose records cannot be read are left out.
pub(super) fn draw(
    output: &Path,
    outcomes: &[Outcome],
    policies: &[String],
    observer: &dyn Observer,
) -> Result<Vec<Picture>, Failure> {
    let mut pictures = Vec::new();
    let all = scenes_and_limits(outcomes);
    for scene in distinct(all.iter().map(|(scene, _)| *scene)) {
        let limits: Vec<Limit> =
            all.iter().filter(|(other, _)| *other == scene).map(|(_, limit)| *limit).collect();
        for axis in [&ROWS, &MEMORY] {
            let limits: Vec<Limit> =
                limits.iter().copied().filter(|limit| (axis.value)(*limit).is_some()).collect();
            if limits.len() > 1 {
                let caption = format!("{scene}: quality against {}, means over seeds", axis.word);
                let plot = svg(&quality(outcomes, policies, scene, &limits, axis), PANEL)?;
                let file = format!("{}-{scene}.svg", axis.file);
                pictures.push(plot::write(output, file, caption, &plot)?);
            }
        }
        for limit in limits {
            let caption =
                format!("{scene}, {limit}: rows, PSNR and memory over iterations, first seed");
            let growth = growth(output, &outcomes_at(outcomes, scene, limit), policies, observer);
            let plot = svg(&growth, PANEL)?;
            let file = format!("growth-{scene}-{}.svg", limit.word());
            pictures.push(plot::write(output, file, caption, &plot)?);
        }
    }
    Ok(pictures)
}

/// The axis of one kind of limit.
struct Axis {
    /// The limit in the text.
    word: &'static str,
    /// The title of the axis.
    title: &'static str,
    /// First part of the name of the plot's file.
    file: &'static str,
    /// The value on the axis; `None` for limits of the other kind.
    value: fn(Limit) -> Option<f64>,
}

const ROWS: Axis = Axis {
    word: "budget",
    title: "budget (rows)",
    file: "quality",
    value: |limit| match limit {
        Limit::Rows(rows) => Some(rows as f64),
        Limit::Memory(_) => None,
    },
};
const MEMORY: Axis = Axis {
    word: "memory",
    title: "memory (MiB)",
    file: "quality-memory",
    value: |limit| match limit {
        Limit::Rows(_) => None,
        Limit::Memory(bytes) => Some(bytes as f64 / f64::from(1 << 20)),
    },
};

/// Scores against the limit.
fn quality(
    outcomes: &[Outcome],
    policies: &[String],
    scene: &str,
    limits: &[Limit],
    axis: &Axis,
) -> [Panel; 3] {
    let panel = |y: &'static str, score: fn(&Outcome) -> f64| Panel {
        title: format!("{scene}: {y} against {}", axis.word),
        x: axis.title,
        y,
        log_x: true,
        has_legend: true,
        curves: by_policy(policies, |policy| {
            let point = |&limit: &Limit| {
                let runs = outcomes_at(outcomes, scene, limit).into_iter();
                let runs = runs.filter(|r| r.factor == policy && r.kept_its_budget());
                Some(((axis.value)(limit)?.ln(), mean(runs.map(score))?))
            };
            limits.iter().filter_map(point).collect()
        }),
    };
    [panel("PSNR (dB)", |r| r.psnr), panel("SSIM", |r| r.ssim), panel("FLIP", |r| r.flip)]
}

/// Gaussians, PSNR and memory over the iterations of the runs at the first seed.
fn growth(
    output: &Path,
    runs: &[&Outcome],
    policies: &[String],
    observer: &dyn Observer,
) -> Vec<Panel> {
    let first_run =
        |policy: &str| runs.iter().filter(|r| r.factor == policy).min_by_key(|r| r.seed).copied();
    let mut records = BTreeMap::new();
    for run in policies.iter().filter_map(|policy| first_run(policy)) {
        let steps = steps_of(&output.join("runs").join(&run.run)).unwrap_or_else(|error| {
            observer.say(format_args!("note: {error}; the curves of this run are left out"));
            Vec::new()
        });
        records.insert(&run.run, steps);
    }
    let place =
        runs.first().map_or_else(String::new, |run| format!("{}, {}", run.scene, run.limit()));
    let panel = |y: &'static str, curve: &dyn Fn(&Outcome) -> Vec<(u32, f64)>| Panel {
        title: format!("{place}: {y} over iterations"),
        x: "iteration",
        y,
        log_x: false,
        has_legend: true,
        curves: by_policy(policies, |policy| {
            let points = first_run(policy).map(curve).unwrap_or_default();
            points.into_iter().map(|(x, y)| (f64::from(x), y)).collect()
        }),
    };
    let logged = |run: &Outcome, value: fn(&StepRecord) -> Option<f64>| {
        records[&run.run].iter().filter_map(|step| Some((step.step, value(step)?))).collect()
    };
    let memory = |step: &StepRecord| Some(step.resident_bytes? as f64 / f64::from(1 << 20));
    let mut panels = vec![
        panel("rows", &|run| logged(run, |step| Some(step.rows as f64))),
        panel("PSNR (dB)", &|run| run.curve.clone()),
        panel("resident memory (MiB)", &|run| logged(run, memory)),
    ];
    // Not every system reports resident memory.
    panels.retain(Panel::has_points);
    panels
}

/// One curve per policy; those that repeat a colour are dashed.
fn by_policy(policies: &[String], points: impl Fn(&str) -> Vec<(f64, f64)>) -> Vec<Curve> {
    let curve = |(index, policy): (usize, &String)| Curve {
        name: policy.clone(),
        points: points(policy),
        colour: index % COLOURS,
        is_dashed: index >= COLOURS,
    };
    policies.iter().enumerate().map(curve).collect()
}
