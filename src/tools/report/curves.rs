//! Curves over iterations: loss, Gaussians, PSNR of the test views, and memory with its promised limit.

use maud::{Markup, html};
use plotters::style::RGBColor;

use super::memory::promised_host_bytes;
use super::runs::RunRecord;
use densify_html::inline_svg;
use densify_run::failure::Failure;
use densify_study::panel::{COLOURS, Curve, PALETTE, Panel, svg};
use densify_train::output::StepRecord;

/// Size of a panel `[px]`: small, so that its text is readable on a phone.
const SIZE: (u32, u32) = (460, 270);
/// Maximum number of points of a curve, about twice the number that can be distinguished.
const MAX_POINTS: usize = 300;
const MIB: f64 = 1024.0 * 1024.0;

/// Draws all panels; `None` if no run has written a record yet.
pub(super) fn draw(runs: &[RunRecord]) -> Result<Option<Markup>, Failure> {
    let records = |value: fn(&StepRecord) -> Option<f64>| {
        move |run: &RunRecord| {
            let points =
                run.steps.iter().filter_map(|step| Some((f64::from(step.step), value(step)?)));
            thin(&points.collect::<Vec<_>>())
        }
    };
    let test_psnr = |run: &RunRecord| {
        run.scores.iter().map(|(&step, mean)| (f64::from(step), mean.psnr)).collect()
    };
    let memory = records(|step| Some(step.resident_bytes? as f64 / MIB));
    let mut panels = vec![
        ("Loss", panel("loss", runs, records(|step| Some(f64::from(step.loss))))),
        ("Gaussians", panel("Gaussians", runs, records(|step| Some(step.rows as f64)))),
        ("PSNR of the test views", panel("PSNR (dB)", runs, test_psnr)),
    ];
    let mut memory = panel("resident memory (MiB)", runs, memory);
    memory.curves.extend(runs.iter().enumerate().filter_map(|(at, run)| {
        let promised = promised_host_bytes(run)? as f64 / MIB;
        let last = f64::from(run.steps.last()?.step);
        let points = vec![(0.0, promised), (last, promised)];
        Some(Curve { name: run.name.clone(), points, colour: at % COLOURS, is_dashed: true })
    }));
    panels.push(("Memory; dashed: the promised limit", memory));
    panels.retain(|(_, panel)| panel.has_points());
    if panels.is_empty() {
        return Ok(None);
    }
    let figures = panels.iter().map(|(title, panel)| {
        let drawn = svg(std::slice::from_ref(panel), SIZE)?;
        let label = format!("{title}, over iterations");
        Ok(html! { figure.curve { h3 { (title) } (inline_svg(&drawn, SIZE, &label)) } })
    });
    let figures = figures.collect::<Result<Vec<Markup>, Failure>>()?;
    Ok(Some(html! {
        @if runs.len() > 1 { (legend(runs)) }
        div.figures { @for figure in &figures { (figure) } }
    }))
}

fn panel(
    y: &'static str,
    runs: &[RunRecord],
    points: impl Fn(&RunRecord) -> Vec<(f64, f64)>,
) -> Panel {
    let curve = |(at, run): (usize, &RunRecord)| Curve {
        name: run.name.clone(),
        // Non-finite values cannot be drawn.
        points: points(run).into_iter().filter(|(_, y)| y.is_finite()).collect(),
        colour: at % COLOURS,
        is_dashed: false,
    };
    let curves = runs.iter().enumerate().map(curve).collect();
    // The legend is above all panels, as text of the page.
    Panel { title: String::new(), x: "iteration", y, log_x: false, has_legend: false, curves }
}

/// The legend: the colour of each run.
fn legend(runs: &[RunRecord]) -> Markup {
    let colour = |at: usize| {
        let RGBColor(r, g, b) = PALETTE[at % COLOURS];
        format!("#{r:02X}{g:02X}{b:02X}")
    };
    html! {
        ul.names {
            @for (at, run) in runs.iter().enumerate() {
                li {
                    svg viewBox="0 0 16 6" aria-hidden="true" {
                        line x1="0" y1="3" x2="16" y2="3" stroke=(colour(at)) stroke-width="2" {}
                    }
                    (run.name)
                }
            }
        }
    }
}

/// Reduces the number of points by averaging neighbours.
fn thin(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let chunk = points.len().div_ceil(MAX_POINTS).max(1);
    let mean = |chunk: &[(f64, f64)]| {
        let (x, y) = chunk.iter().fold((0.0, 0.0), |sum, point| (sum.0 + point.0, sum.1 + point.1));
        (x / chunk.len() as f64, y / chunk.len() as f64)
    };
    points.chunks(chunk).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_curves_are_reduced_to_means() {
        let points: Vec<(f64, f64)> = (0..3000).map(|i| (f64::from(i), f64::from(i % 2))).collect();
        let thinned = thin(&points);
        assert_eq!(thinned.len(), 300);
        assert!(thinned.iter().all(|(_, y)| (y - 0.5).abs() < 1e-9));
        assert!((thinned[0].0 - 4.5).abs() < 1e-9, "{:?}", thinned[0]);
        assert_eq!(thin(&points[..7]), points[..7]);
        assert_eq!(thin(&[]), []);
    }
}
