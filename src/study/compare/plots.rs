//! Plots as SVG: quality against budget; rows, PSNR and memory along the runs.

use std::ops::Range;
use std::path::Path;

use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::element::DashedPathElement;
use plotters::prelude::*;

use super::{Outcome, at, scenes_and_budgets};
use crate::failure::Failure;
use crate::number::grouped;
use crate::study::Picture;
use crate::study::difference::mean;
use crate::study::distinct;
use crate::study::plot::{self, Area, range};

/// Size of a panel `[px]`.
const PANEL: (u32, u32) = (720, 300);
/// Colours that stay apart for the colour-blind (Okabe and Ito 2008).
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];

/// A dash and the gap after it `[px]`.
const DASH: [i32; 2] = [6, 4];

/// A curve per policy.
struct Panel {
    title: String,
    x: &'static str,
    y: &'static str,
    /// Whether x is the logarithm of what the axis says.
    log_x: bool,
    curves: Vec<(String, Vec<(f64, f64)>)>,
}

/// Draws every plot into the folder `output`.
pub(super) fn draw(
    output: &Path,
    outcomes: &[Outcome],
    policies: &[String],
) -> Result<Vec<Picture>, Failure> {
    let mut pictures = Vec::new();
    let all = scenes_and_budgets(outcomes);
    for scene in distinct(all.iter().map(|(scene, _)| *scene)) {
        let budgets: Vec<usize> =
            all.iter().filter(|(other, _)| *other == scene).map(|(_, budget)| *budget).collect();
        if budgets.len() > 1 {
            let caption = format!("{scene}: quality against budget, means over seeds");
            let plot = svg(&quality(outcomes, policies, scene, &budgets))?;
            pictures.push(plot::write(output, format!("quality-{scene}.svg"), caption, &plot)?);
        }
        for budget in budgets {
            let caption = format!(
                "{scene}, {} rows: rows, PSNR and memory over iterations, first seed",
                grouped(budget)
            );
            let plot = svg(&growth(output, &at(outcomes, scene, budget), policies))?;
            let file = format!("growth-{scene}-{budget}.svg");
            pictures.push(plot::write(output, file, caption, &plot)?);
        }
    }
    Ok(pictures)
}

/// Scores against budget.
fn quality(
    outcomes: &[Outcome],
    policies: &[String],
    scene: &str,
    budgets: &[usize],
) -> [Panel; 3] {
    let panel = |y: &'static str, score: fn(&Outcome) -> f64| Panel {
        title: format!("{scene}: {y} against budget"),
        x: "budget (rows)",
        y,
        log_x: true,
        curves: by_policy(policies, |policy| {
            let point = |&budget: &usize| {
                let runs = at(outcomes, scene, budget).into_iter();
                let runs = runs.filter(|r| r.factor == policy && r.kept_its_budget());
                Some(((budget as f64).ln(), mean(runs.map(score))?))
            };
            budgets.iter().filter_map(point).collect()
        }),
    };
    [panel("PSNR (dB)", |r| r.psnr), panel("SSIM", |r| r.ssim), panel("FLIP", |r| r.flip)]
}

/// Rows, PSNR and memory along the runs at the first seed.
fn growth(output: &Path, runs: &[&Outcome], policies: &[String]) -> Vec<Panel> {
    let (scene, budget) = runs.first().map_or(("", 0), |run| (&*run.scene, run.budget));
    let panel = |y: &'static str, curve: &dyn Fn(&Outcome) -> Vec<(u32, f64)>| Panel {
        title: format!("{scene}, {} rows: {y} over iterations", grouped(budget)),
        x: "iteration",
        y,
        log_x: false,
        curves: by_policy(policies, |policy| {
            let first = runs.iter().filter(|r| r.factor == policy).min_by_key(|r| r.seed);
            let points = first.map(|run| curve(run)).unwrap_or_default();
            points.into_iter().map(|(x, y)| (f64::from(x), y)).collect()
        }),
    };
    let memory = |r: &Outcome| {
        let bytes = over_time(output, r, "resident_bytes").into_iter();
        bytes.map(|(step, bytes)| (step, bytes / f64::from(1 << 20))).collect()
    };
    let mut panels = vec![
        panel("rows", &|r| over_time(output, r, "rows")),
        panel("PSNR (dB)", &|r| r.curve.clone()),
        panel("resident memory (MiB)", &memory),
    ];
    // Not every system says.
    panels.retain(|panel| bounds(panel).is_some());
    panels
}

/// (iteration, value) of a field of the run's log; nothing where it has none.
fn over_time(output: &Path, run: &Outcome, field: &str) -> Vec<(u32, f64)> {
    let path = output.join("runs").join(&run.run).join("stats/train.jsonl");
    let text = std::fs::read_to_string(path).unwrap_or_default();
    let steps =
        text.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    let point = |step: serde_json::Value| {
        let iteration = u32::try_from(step["step"].as_u64()?).ok()?;
        Some((iteration, step[field].as_f64()?))
    };
    steps.filter_map(point).collect()
}

fn by_policy(
    policies: &[String],
    curve: impl Fn(&str) -> Vec<(f64, f64)>,
) -> Vec<(String, Vec<(f64, f64)>)> {
    policies.iter().map(|policy| (policy.clone(), curve(policy))).collect()
}

/// The panels, one above the other.
fn svg(panels: &[Panel]) -> Result<String, Failure> {
    plot::svg((PANEL.0, PANEL.1 * panels.len() as u32), |area| {
        for (panel, area) in panels.iter().zip(area.split_evenly((panels.len(), 1))) {
            // An empty panel has no axes.
            if let Some(bounds) = bounds(panel) {
                draw_panel(panel, bounds, &area)?;
            }
        }
        Ok(())
    })
}

/// What the axes must show, with a margin: `[[x least, x most], [y least, y most]]`.
fn bounds(panel: &Panel) -> Option<[[f64; 2]; 2]> {
    let points = || panel.curves.iter().flat_map(|(_, points)| points);
    let [x0, x1] = range(points().map(|p| p.0))?;
    let [y0, y1] = range(points().map(|p| p.1))?;
    let margin = if y1 > y0 { 0.08 * (y1 - y0) } else { 0.5 };
    let x = if panel.log_x { [x0 - 0.1, x1 + 0.1] } else { [0.0, x1.max(1.0)] };
    Some([x, [y0 - margin, y1 + margin]])
}

fn draw_panel(
    panel: &Panel,
    [[x0, x1], [y0, y1]]: [[f64; 2]; 2],
    area: &Area<'_>,
) -> Result<(), Box<dyn std::error::Error>> {
    let mut builder = ChartBuilder::on(area);
    builder
        .caption(&panel.title, ("sans-serif", 17))
        .margin(8)
        .margin_right(28)
        .x_label_area_size(42)
        .y_label_area_size(70);
    let ticks = if panel.log_x { ticks_at_points(panel) } else { even_ticks(x0, x1) };
    let y_ticks = even_ticks(y0, y1);
    let digits = digits(&y_ticks);
    let y_axis = Axis { range: y0..y1, ticks: y_ticks };
    let mut chart = builder.build_cartesian_2d(Axis { range: x0..x1, ticks }, y_axis)?;
    let whole = |x: &f64| grouped(if panel.log_x { x.exp() } else { *x }.round() as usize);
    let number = |y: &f64| match digits {
        0 if *y >= 0.0 => grouped(y.round() as usize),
        _ => format!("{y:.digits$}"),
    };
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_desc(panel.x)
        .y_desc(panel.y)
        .x_label_formatter(&whole)
        .y_label_formatter(&number)
        .draw()?;
    for (i, (policy, points)) in panel.curves.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        let style = colour.stroke_width(2);
        let points_of = points.iter().copied();
        let ends = |(x, y)| [(x, y), (x + 18, y)];
        // With more curves than colours, those that repeat a colour are dashed.
        if i < COLOURS.len() {
            let line = chart.draw_series(LineSeries::new(points_of, style))?;
            line.label(policy).legend(move |at| PathElement::new(ends(at), style));
        } else {
            let [dash, gap] = DASH;
            let line = chart.draw_series(DashedLineSeries::new(points_of, dash, gap, style))?;
            let legend = move |at| DashedPathElement::new(ends(at), dash, gap, style);
            line.label(policy).legend(legend);
        }
        // Few points are measurements, which a line alone would hide.
        if points.len() <= 2 * super::POINTS as usize {
            let dot = |&point: &(f64, f64)| Circle::new(point, 3, colour.filled());
            chart.draw_series(points.iter().map(dot))?;
        }
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerRight)
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK.mix(0.3))
        .draw()?;
    Ok(())
}

/// An axis with ticks at chosen places.
struct Axis {
    range: Range<f64>,
    ticks: Vec<f64>,
}

impl Ranged for Axis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        let share = (value - self.range.start) / (self.range.end - self.range.start);
        limit.0 + (f64::from(limit.1 - limit.0) * share).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        if hint.weight().allow_light_points() { Vec::new() } else { self.ticks.clone() }
    }

    fn range(&self) -> Range<f64> {
        self.range.clone()
    }
}

/// A tick at every point of the curves.
fn ticks_at_points(panel: &Panel) -> Vec<f64> {
    let mut ticks: Vec<f64> =
        panel.curves.iter().flat_map(|(_, points)| points).map(|&(x, _)| x).collect();
    ticks.sort_by(f64::total_cmp);
    ticks.dedup();
    ticks
}

/// Ticks from `least` to `most` in steps of 1, 2 or 5 times a power of ten, at most eleven.
fn even_ticks(least: f64, most: f64) -> Vec<f64> {
    let decade = 10_f64.powf(((most - least) / 10.0).log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|n| n * decade);
    let step = steps.into_iter().find(|step| (most - least) / step <= 10.0).unwrap_or(most);
    let (first, last) = ((least / step).ceil() as i32, (most / step).floor() as i32);
    (first..=last).map(|i| f64::from(i) * step).collect()
}

/// The fewest digits after the point that write every tick without loss.
fn digits(ticks: &[f64]) -> usize {
    let is_exact = |digits: &i32| {
        let scaled = |tick: &f64| tick * 10_f64.powi(*digits);
        ticks.iter().map(scaled).all(|tick| (tick - tick.round()).abs() < 1e-6)
    };
    (0..6).find(is_exact).unwrap_or(6) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plot_shows_every_curve_and_none_is_no_error() {
        let panel = |log_x| Panel {
            title: "title".into(),
            x: "budget",
            y: "PSNR",
            log_x,
            curves: vec![
                ("one".into(), vec![(1.0, 30.0), (4.0, 32.0)]),
                ("two".into(), vec![(1.0, 29.0), (4.0, 33.0)]),
                ("empty".into(), Vec::new()),
            ],
        };
        for log_x in [false, true] {
            let text = svg(&[panel(log_x), panel(log_x)]).unwrap();
            assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"));
            assert_eq!(text.matches("title").count(), 2);
            // A line on either panel, and one in either legend.
            assert_eq!(text.matches("<polyline").count() % 2, 0);
            for name in ["one", "two", "PSNR"] {
                assert!(text.contains(name), "{name} is not in {text}");
            }
        }
        assert_eq!(even_ticks(0.0, 300.0), [0.0, 50.0, 100.0, 150.0, 200.0, 250.0, 300.0]);
        assert_eq!(even_ticks(0.0, 7000.0).len(), 8);
        // From 29 to 33 dB, with margins, in half dB; no label says more than it must.
        let text = svg(&[panel(false)]).unwrap();
        for (label, is_there) in [("30.5", true), ("30.0", true), ("30.000", false)] {
            let lines = text.lines().filter(|line| line.trim() == label);
            assert_eq!(lines.count() > 0, is_there, "{label} in {text}");
        }
        for (least, most, expected) in [(29.0, 36.0, 0), (0.9, 0.93, 3), (12.0, 90_000.0, 0)] {
            assert_eq!(digits(&even_ticks(least, most)), expected, "{least} to {most}");
        }
        let many = |count: usize| {
            let curve = |i: usize| (format!("p{i}"), vec![(1.0, i as f64), (4.0, i as f64)]);
            svg(&[Panel { curves: (0..count).map(curve).collect(), ..panel(false) }]).unwrap()
        };
        // As many lines as policies, in curves and legend; the eighth, which repeats a colour, is dashed.
        let lines = |text: &str| text.matches("stroke-width=\"2\"").count();
        assert_eq!(lines(&many(7)), 14);
        assert!(lines(&many(8)) > 40, "{}", lines(&many(8)));
        let empty = Panel { curves: Vec::new(), ..panel(false) };
        assert!(svg(&[empty]).unwrap().starts_with("<svg"));
    }
}
