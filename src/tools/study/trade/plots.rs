//! Pareto plots, one per scene: PSNR against time, coloured by peak memory.

use std::path::Path;

use plotters::prelude::*;

use super::results::{LOG_SECONDS, PSNR, Results};
use crate::Picture;
use crate::plot::{self, Area, range};
use densify_run::failure::Failure;

/// Size of a plot `[px]`.
const SIZE: (u32, u32) = (900, 560);
/// Colour scale for memory, from low to high, readable for the colour-blind (after viridis).
const SCALE: [RGBColor; 3] = [RGBColor(68, 1, 84), RGBColor(33, 145, 140), RGBColor(253, 180, 37)];

/// A level in the plot.
#[derive(Debug, Clone, PartialEq)]
struct Point {
    name: String,
    seconds: f64,
    /// Difference from `exact` `[dB]`.
    psnr: f64,
    /// Peak memory `[MiB]`.
    peak: f64,
    /// True if no other point is both faster and better.
    is_optimal: bool,
}

/// Draws a plot per scene into the folder `output`.
pub(super) fn draw(output: &Path, results: &Results) -> Result<Vec<Picture>, Failure> {
    let mut drawn = Vec::new();
    for scene in &results.scenes {
        let points = points(results, scene);
        if points.is_empty() {
            continue;
        }
        let title = format!("{scene}: PSNR against time, coloured by peak memory");
        let svg = plot::svg(SIZE, |area| draw_points(&title, &points, area))?;
        drawn.push(plot::write(output, format!("pareto-{scene}.svg"), title, &svg)?);
    }
    Ok(drawn)
}

fn points(results: &Results, scene: &str) -> Vec<Point> {
    let Some(base) = results.mean(scene, "", "", PSNR) else { return Vec::new() };
    let levels = results.effects.iter().map(|e| (&*e.factor.name, &*e.level));
    let point = |(factor, level): (&str, &str)| {
        let name = if factor.is_empty() { "exact".to_owned() } else { format!("{factor}={level}") };
        Some(Point {
            name,
            seconds: results.mean(scene, factor, level, LOG_SECONDS)?.exp(),
            psnr: results.mean(scene, factor, level, PSNR)? - base,
            peak: results.peak_mib(scene, factor, level)?,
            is_optimal: false,
        })
    };
    let mut points: Vec<Point> =
        std::iter::once(("", "")).chain(levels).filter_map(point).collect();
    for index in 0..points.len() {
        let point = &points[index];
        let beats = |other: &Point| other.seconds < point.seconds && other.psnr > point.psnr;
        points[index].is_optimal = !points.iter().any(beats);
    }
    points
}

/// Colour of a peak within the range of all peaks.
fn colour(peak: f64, [least, most]: [f64; 2]) -> RGBColor {
    let share = if most > least { (peak - least) / (most - least) } else { 0.0 };
    let (from, to, t) = if share < 0.5 {
        (SCALE[0], SCALE[1], 2.0 * share)
    } else {
        (SCALE[1], SCALE[2], 2.0 * share - 1.0)
    };
    let mix = |a: u8, b: u8| (f64::from(a) + t * (f64::from(b) - f64::from(a))).round() as u8;
    RGBColor(mix(from.0, to.0), mix(from.1, to.1), mix(from.2, to.2))
}

fn draw_points(
    title: &str,
    points: &[Point],
    area: &Area<'_>,
) -> Result<(), Box<dyn std::error::Error>> {
    let [fast, slow] = range(points.iter().map(|p| p.seconds)).unwrap_or([1.0; 2]);
    let [low, high] = range(points.iter().map(|p| p.psnr)).unwrap_or_default();
    let peaks = range(points.iter().map(|p| p.peak)).unwrap_or_default();
    let margin = 0.08 * (high - low).max(0.1);
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 17))
        .margin(8)
        .margin_right(130)
        .x_label_area_size(42)
        .y_label_area_size(60)
        .build_cartesian_2d((0.93 * fast..1.07 * slow).log_scale(), low - margin..high + margin)?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_desc("time of training [s], logarithmic")
        .y_desc("PSNR against exact [dB]")
        .x_label_formatter(&|x| if *x < 10.0 { format!("{x:.2}") } else { format!("{x:.0}") })
        .y_label_formatter(&|y| format!("{y:+.2}"))
        .draw()?;
    for point in points {
        let at = (point.seconds, point.psnr);
        let filled = colour(point.peak, peaks).filled();
        let (radius, text_colour) =
            if point.is_optimal { (6, BLACK) } else { (4, RGBColor(120, 120, 120)) };
        let font = ("sans-serif", 11).into_font().color(&text_colour);
        let label = Text::new(point.name.clone(), (9, -5), font);
        let element = EmptyElement::at(at) + Circle::new((0, 0), radius, filled) + label;
        chart.draw_series([element])?;
    }
    draw_scale(area, peaks)
}

/// Draws the colour scale at the right of the plot.
fn draw_scale(area: &Area<'_>, [least, most]: [f64; 2]) -> Result<(), Box<dyn std::error::Error>> {
    const STEPS: i32 = 40;
    let (x, bottom) = (SIZE.0 as i32 - 108, 400);
    for step in 0..=STEPS {
        let peak = least + (most - least) * f64::from(step) / f64::from(STEPS);
        let y = bottom - 6 * step;
        let corners = [(x, y), (x + 16, y - 6)];
        area.draw(&Rectangle::new(corners, colour(peak, [least, most]).filled()))?;
    }
    let font = ("sans-serif", 12).into_font();
    for (peak, y) in [(least, bottom - 4), (most, bottom - 6 * STEPS - 4)] {
        area.draw(&Text::new(format!("{peak:.1} MiB"), (x + 22, y), font.clone()))?;
    }
    area.draw(&Text::new("peak memory", (x, bottom - 6 * STEPS - 26), font))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::results::sample;
    use super::*;

    #[test]
    fn a_plot_shows_every_level_and_the_optimal_ones() {
        let results = sample();
        let points = points(&results, "room");
        let optimal: Vec<_> = points.iter().map(|p| (&*p.name, p.is_optimal)).collect();
        let expected = [
            ("exact", false),
            ("alpha_min=1/64", false),
            ("alpha_min=1/32", false),
            ("sh_degree=0", true),
        ];
        assert_eq!(optimal, expected);
        let text = plot::svg(SIZE, |area| draw_points("title", &points, area)).unwrap();
        for words in ["title", "alpha_min=1/64", "sh_degree=0", "peak memory", "logarithmic"] {
            assert!(text.contains(words), "{words} is not in {text}");
        }
        assert_eq!(text.matches("<circle").count(), 4);
        assert!(super::points(&results, "nowhere").is_empty());
    }

    #[test]
    fn colours_cover_the_whole_scale() {
        assert_eq!(colour(1.0, [1.0, 3.0]), SCALE[0]);
        assert_eq!(colour(2.0, [1.0, 3.0]), SCALE[1]);
        assert_eq!(colour(3.0, [1.0, 3.0]), SCALE[2]);
        assert_eq!(colour(1.0, [1.0, 1.0]), SCALE[0]);
    }
}
