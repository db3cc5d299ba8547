//! Line plots for studies and reports.

use std::ops::Range;

use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::element::DashedPathElement;
use plotters::prelude::*;

use super::plot::{self, Area, range};
use densify_core::numbers::grouped;
use densify_run::failure::Failure;

/// Number of colours in the palette.
pub const COLOURS: usize = PALETTE.len();
/// Colours that colour-blind people can distinguish (Okabe and Ito 2008).
pub const PALETTE: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];

/// Length of a dash and of a gap `[px]`.
const DASH: [i32; 2] = [6, 4];
/// Maximum number of points of a curve whose points are marked.
const MAX_MARKED_POINTS: usize = 16;

/// A line through some points.
pub struct Curve {
    /// Name in the legend.
    pub name: String,
    /// (x, y), in rising order of x.
    pub points: Vec<(f64, f64)>,
    /// Index of the colour in the palette.
    pub colour: usize,
    /// True if the curve is drawn dashed.
    pub is_dashed: bool,
}

/// Curves over the same axes.
pub struct Panel {
    /// Title; may be empty.
    pub title: String,
    /// Name of the x axis.
    pub x: &'static str,
    /// Name of the y axis.
    pub y: &'static str,
    /// True if the x values of the points are logarithms of the quantity on the x axis.
    pub log_x: bool,
    /// True if a legend in the panel names the curves.
    pub has_legend: bool,
    /// The curves, drawn in order.
    pub curves: Vec<Curve>,
}

impl Panel {
    /// True if any curve has a point.
    pub fn has_points(&self) -> bool {
        self.curves.iter().any(|curve| !curve.points.is_empty())
    }
}

/// Draws the panels one above the other, each with this size in pixels.
pub fn svg(panels: &[Panel], (width, height): (u32, u32)) -> Result<String, Failure> {
    plot::svg((width, height * panels.len() as u32), |area| {
        for (panel, area) in panels.iter().zip(area.split_evenly((panels.len(), 1))) {
            // An empty panel has no axes.
            if let Some(bounds) = bounds(panel) {
                draw_panel(panel, bounds, &area)?;
            }
        }
        Ok(())
    })
}

/// Range of the axes with a margin, `[[x min, x max], [y min, y max]]`; `None` without points.
fn bounds(panel: &Panel) -> Option<[[f64; 2]; 2]> {
    let points = || panel.curves.iter().flat_map(|curve| &curve.points);
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
    if !panel.title.is_empty() {
        builder.caption(&panel.title, ("sans-serif", 17));
    }
    builder.margin(8).margin_right(28).x_label_area_size(42).y_label_area_size(70);
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
    for Curve { name, points, colour, is_dashed } in &panel.curves {
        let colour = PALETTE[*colour];
        let style = colour.stroke_width(2);
        let xy = points.iter().copied();
        let ends = |(x, y)| [(x, y), (x + 18, y)];
        if *is_dashed {
            let [dash, gap] = DASH;
            let line = chart.draw_series(DashedLineSeries::new(xy, dash, gap, style))?;
            let legend = move |at| DashedPathElement::new(ends(at), dash, gap, style);
            line.label(name).legend(legend);
        } else {
            let line = chart.draw_series(LineSeries::new(xy, style))?;
            line.label(name).legend(move |at| PathElement::new(ends(at), style));
        }
        // A curve of few points consists of separate measurements, which a line alone would hide.
        if points.len() <= MAX_MARKED_POINTS && !is_dashed {
            let dot = |&point: &(f64, f64)| Circle::new(point, 3, colour.filled());
            chart.draw_series(points.iter().map(dot))?;
        }
    }
    if panel.has_legend {
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()?;
    }
    Ok(())
}

/// An axis with given ticks.
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
        panel.curves.iter().flat_map(|curve| &curve.points).map(|&(x, _)| x).collect();
    ticks.sort_by(f64::total_cmp);
    ticks.dedup();
    ticks
}

/// At most eleven ticks from `least` to `most` in steps of 1, 2 or 5 times a power of ten.
fn even_ticks(least: f64, most: f64) -> Vec<f64> {
    let decade = 10_f64.powf(((most - least) / 10.0).log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|n| n * decade);
    let step = steps.into_iter().find(|step| (most - least) / step <= 10.0).unwrap_or(most);
    let (first, last) = ((least / step).ceil() as i32, (most / step).floor() as i32);
    (first..=last).map(|i| f64::from(i) * step).collect()
}

/// Smallest number of decimals that represents every tick exactly.
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

    const SIZE: (u32, u32) = (720, 300);

    #[test]
    fn a_plot_shows_every_curve_and_may_be_empty() {
        let curve =
            |name: &str, points| Curve { name: name.into(), points, colour: 0, is_dashed: false };
        let panel = |log_x| Panel {
            title: "title".into(),
            x: "budget",
            y: "PSNR",
            log_x,
            has_legend: true,
            curves: vec![
                curve("one", vec![(1.0, 30.0), (4.0, 32.0)]),
                curve("two", vec![(1.0, 29.0), (4.0, 33.0)]),
                curve("empty", Vec::new()),
            ],
        };
        for log_x in [false, true] {
            let text = svg(&[panel(log_x), panel(log_x)], SIZE).unwrap();
            assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"));
            assert_eq!(text.matches("title").count(), 2);
            // Each curve has a line in its panel and one in the legend.
            assert_eq!(text.matches("<polyline").count() % 2, 0);
            for name in ["one", "two", "PSNR"] {
                assert!(text.contains(name), "{name} is not in {text}");
            }
        }
        assert_eq!(even_ticks(0.0, 300.0), [0.0, 50.0, 100.0, 150.0, 200.0, 250.0, 300.0]);
        assert_eq!(even_ticks(0.0, 7000.0).len(), 8);
        // Ticks go from 29 to 33 dB with margins, in steps of 0.5 dB, with one decimal.
        let text = svg(&[panel(false)], SIZE).unwrap();
        for (label, is_there) in [("30.5", true), ("30.0", true), ("30.000", false)] {
            let lines = text.lines().filter(|line| line.trim() == label);
            assert_eq!(lines.count() > 0, is_there, "{label} in {text}");
        }
        for (least, most, expected) in [(29.0, 36.0, 0), (0.9, 0.93, 3), (12.0, 90_000.0, 0)] {
            assert_eq!(digits(&even_ticks(least, most)), expected, "{least} to {most}");
        }
        let line = |is_dashed| Curve { is_dashed, ..curve("line", vec![(1.0, 1.0), (4.0, 2.0)]) };
        let strokes = |is_dashed, has_legend| {
            let panel = Panel { curves: vec![line(is_dashed)], has_legend, ..panel(false) };
            svg(&[panel], SIZE).unwrap().matches("stroke-width=\"2\"").count()
        };
        // A solid curve is one stroke in the panel and one in the legend; a dashed curve is many strokes.
        assert_eq!((strokes(false, true), strokes(false, false)), (2, 1));
        assert!(strokes(true, true) > 20, "{}", strokes(true, true));
        let empty = Panel { curves: Vec::new(), ..panel(false) };
        assert!(svg(&[empty], SIZE).unwrap().starts_with("<svg"));
    }
}
