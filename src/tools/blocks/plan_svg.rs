//! Draws the plan from above as SVG: points, cameras and cells.

use std::fmt::Write as _;

use super::BlockPlan;
use densify_data::dataset::Dataset;

/// Longer side of the drawing `[px]`.
const SIDE: f64 = 900.0;
/// Border around the drawing `[px]`.
const BORDER: f64 = 20.0;
/// Maximum number of points drawn.
const MAX_POINTS: usize = 4_000;

pub(super) fn draw(plan: &BlockPlan, points: &[[f64; 2]], dataset: &Dataset) -> String {
    let cameras: Vec<[f64; 2]> = dataset
        .train
        .iter()
        .map(|view| dataset.normalisation.world_from_scene(view.camera.centre()))
        .map(|centre| plan.ground.project(centre))
        .collect();
    let range = |axis: usize| {
        // Outlying points do not count, as they would shrink the rest of the drawing.
        let mut values: Vec<f64> = points.iter().map(|at| at[axis]).collect();
        values.sort_by(f64::total_cmp);
        let cut = values.len() / 100;
        let ends = [values.get(cut), values.get(values.len().saturating_sub(cut + 1))];
        let own = cameras.iter().map(|at| at[axis]);
        own.chain(ends.into_iter().flatten().copied())
            .fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], x| [a.min(x), b.max(x)])
    };
    let [[left, right], [bottom, top]] = [range(0), range(1)];
    let scale = SIDE / (right - left).max(top - bottom).max(f64::MIN_POSITIVE);
    let x = |u: f64| BORDER + (u.clamp(left, right) - left) * scale;
    let y = |v: f64| BORDER + (top - v.clamp(bottom, top)) * scale;
    let [width, height] = [right - left, top - bottom].map(|size| 2.0 * BORDER + size * scale);
    let circle = |at: &[f64; 2], radius: u32| {
        format!("<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{radius}\"/>\n", x(at[0]), y(at[1]))
    };
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.0} {height:.0}\" \
         font-family=\"sans-serif\" font-size=\"13\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <g fill=\"#999\">\n"
    );
    let within =
        |at: &&[f64; 2]| (left..=right).contains(&at[0]) && (bottom..=top).contains(&at[1]);
    let stride = points.len().div_ceil(MAX_POINTS).max(1);
    for at in points.iter().step_by(stride).filter(within) {
        svg += &circle(at, 1);
    }
    svg += "</g>\n<g fill=\"#c33\">\n";
    for at in &cameras {
        svg += &circle(at, 2);
    }
    svg += "</g>\n<g fill=\"none\" stroke=\"#06c\">\n";
    for block in &plan.block {
        let [x0, x1] = [block.cell.low[0], block.cell.high[0]].map(x);
        let [y0, y1] = [block.cell.high[1], block.cell.low[1]].map(y);
        let (w, h) = (x1 - x0, y1 - y0);
        let _ = writeln!(
            svg,
            "<rect x=\"{x0:.1}\" y=\"{y0:.1}\" width=\"{w:.1}\" height=\"{h:.1}\"/>\n\
             <text x=\"{:.1}\" y=\"{:.1}\" fill=\"#06c\" stroke=\"none\">{}</text>",
            x0 + 4.0,
            y0 + 15.0,
            block.name
        );
    }
    svg + "</g>\n</svg>\n"
}
