//! Checks given depth before training: some views are read, and their depth is compared with the points that they see.

use super::super::{LoadError, View};
use super::agreement::{Agreement, Fault, Verdict, seen_points};
use super::decide::{Scene, refused};
use super::{DepthAlong, DepthOrigin, Meaning};
use crate::error::DepthRemedy;
use densify_core::numbers::grouped;

/// Number of views, at equal intervals, whose depth is checked before training.
const CHECKED: usize = 24;
/// Error in scale from which on depth is refused.
const SCALE_REFUSED: f64 = 0.2;
/// Units that files have, to be suggested instead of a wrong one `[world units]`.
const USUAL_UNITS: [(f64, &str); 9] = [
    (1.0, "1"),
    (0.1, "0.1"),
    (0.01, "0.01"),
    (0.001, "0.001"),
    (1e-4, "0.0001"),
    (1e-6, "0.000001"),
    (1.0 / 5000.0, "1/5000"),
    (1.0 / 6553.5, "1/6553.5"),
    (1.0 / 4000.0, "1/4000"),
];

/// The result of reading some of the views.
pub(super) struct Checked {
    /// Number of views that were read.
    pub(super) views: usize,
    /// Those of them without any known depth.
    pub(super) empty: usize,
    /// Share of pixels that count.
    pub(super) known: f64,
    pub(super) verdict: Option<Verdict>,
}

/// Reads the depth of some views and compares it with the points.
pub(super) fn check(
    scene: &Scene<'_>,
    along: &DepthAlong,
    source: DepthOrigin,
) -> Result<Checked, LoadError> {
    let with: Vec<&View> = scene.train.iter().filter(|view| view.source.depth.is_some()).collect();
    let mut agreement = Agreement::default();
    let (mut views, mut empty, mut constant, mut counted, mut pixels) = (0, 0, 0, 0, 0);
    for view in with.iter().step_by(with.len().div_ceil(CHECKED).max(1)) {
        let Some(depth) = &view.source.depth else { continue };
        let sampled = depth.sampled(&view.source)?;
        let known = |x: &f32| *x > 0.0 && x.is_finite();
        let mut values = sampled.inverse.iter().copied().filter(known);
        let first = values.next();
        let mut is_constant = |first: f32| values.all(|x| (x - first).abs() <= 1e-6 * first);
        views += 1;
        match first {
            None => empty += 1,
            Some(first) => {
                constant += usize::from(source != DepthOrigin::Points && is_constant(first));
            }
        }
        let counts = |(x, weight): &(&f32, &u8)| known(x) && **weight > 0;
        counted += sampled.inverse.iter().zip(&sampled.confidence).filter(counts).count();
        pixels += sampled.inverse.len();
        // Edges do not count, here as in training: points lie on either side of them.
        let inverse: Vec<f32> = { sampled.inverse.iter().zip(&sampled.confidence) }
            .map(|(x, weight)| if *weight > 0 { *x } else { 0.0 })
            .collect();
        agreement.add(&view.camera, &seen_points(&scene.points.positions, &view.camera), &inverse);
    }
    let example = with.first().and_then(|view| view.source.depth.as_ref()?.path());
    let example = example.map_or_else(String::new, |path| format!("{}: ", path.display()));
    if empty == views {
        let problem = format!(
            "{example}no depth is known in any of {views} views: all values are 0 or not finite"
        );
        return Err(refused(problem, DepthRemedy::Repair));
    }
    if constant > 0 && constant + empty == views {
        let problem = format!(
            "{example}the depth maps of all {views} checked views have only one value each"
        );
        return Err(refused(problem, DepthRemedy::Repair));
    }
    let verdict = agreement.verdict();
    if let Some(verdict) = verdict.filter(|_| source != DepthOrigin::Points) {
        let unit = with.iter().find_map(|view| match view.source.depth.as_ref()?.meaning {
            Meaning::Depth(unit) => Some(unit),
            Meaning::Inverse(_) | Meaning::Unfitted => None,
        });
        judge(&verdict, *along, unit, &example)?;
    }
    Ok(Checked { views, empty, known: counted as f64 / pixels.max(1) as f64, verdict })
}

/// Refuses depth that disagrees with the points.
fn judge(
    verdict: &Verdict,
    along: DepthAlong,
    unit: Option<f64>,
    example: &str,
) -> Result<(), LoadError> {
    let points = format!("{} points that the views see", grouped(verdict.pairs));
    match verdict.fault {
        Some(Fault::AlongRays) if along == DepthAlong::Axis => {
            let problem = format!(
                "{example}depth grows towards the corners of the pictures, compared with {points}: the values are \
                 distances along rays, not along the optical axis"
            );
            return Err(refused(problem, DepthRemedy::AlongRay));
        }
        Some(Fault::AlongAxis) if along == DepthAlong::Ray => {
            let problem = format!(
                "{example}depth shrinks towards the corners of the pictures, compared with {points}: the values are \
                 measured along the optical axis, not along rays"
            );
            return Err(refused(problem, DepthRemedy::AlongAxis));
        }
        Some(Fault::Inverse) => {
            let problem = format!(
                "{example}the values fall where {points} are farther away: they are inverse depth (disparity)"
            );
            return Err(refused(problem, DepthRemedy::Relative));
        }
        Some(Fault::Shifted(x, y)) => {
            let problem = format!(
                "{example}depth is shifted by ({x}, {y}) px against {points}: it belongs to another camera than the \
                 photographs"
            );
            return Err(refused(problem, DepthRemedy::Register));
        }
        Some(Fault::AlongRays | Fault::AlongAxis) | None => {}
    }
    if (verdict.scale.ln()).abs() <= (1.0 + SCALE_REFUSED).ln() {
        return Ok(());
    }
    let fitting = unit.map(|unit| {
        let unit = unit / verdict.scale;
        let usual =
            USUAL_UNITS.iter().find(|(usual, _)| (unit / usual - 1.0).abs() < SCALE_REFUSED / 2.0);
        let text = usual.map_or_else(|| format!("{unit:.3e}"), |(_, text)| (*text).to_owned());
        format!("; a unit of {text} would fit")
    });
    let problem = format!(
        "{example}depth is {} times that of {points}{}",
        significant(verdict.scale),
        fitting.unwrap_or_default()
    );
    Err(refused(problem, DepthRemedy::Unit))
}

/// A positive number with three digits.
fn significant(value: f64) -> String {
    let digits = (2.0 - value.log10().floor()).clamp(0.0, 9.0) as usize;
    format!("{value:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_have_three_digits() {
        assert_eq!([1000.4, 0.001_234_9, 1.05].map(significant), ["1000", "0.00123", "1.05"]);
    }
}
