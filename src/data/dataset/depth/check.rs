//! Checks given depth before training: some views are read, and their depth is compared with the points that they see.

use super::super::LoadError;
use super::agreement::{Agreement, Fault, Verdict, seen_points};
use super::decide::{Scene, refused};
use super::{DepthAlong, DepthOrigin, Meaning};
use crate::error::DepthRemedy;
use densify_core::image::depth::nearest_valid;
use densify_core::numbers::grouped;

/// Number of views, at equal intervals, whose depth is checked before training.
const CHECKED: usize = 24;
/// Error in scale from which on depth is refused.
const SCALE_REFUSED: f64 = 0.2;
/// Depth is refused if the shortest interval with half of the ratios is longer than this, relatively: in a room it is
/// 0.31 to 0.62 with maps of other views, and 0.08 with the right ones at 5 % noise.
const SPREAD_REFUSED: f64 = 0.25;
/// Unless it is shorter than this share of that of unrelated depths: behind thin leaves, most points are hidden. The share
/// is 0.1 there with the right maps (0.32 of 3.1), and 0.5 or more with maps of neighbouring views wherever these are
/// beyond the first limit.
const SPREAD_OF_UNRELATED: f64 = 0.25;
/// Distance at which a point of the cloud is compared with one that the views see `[px]`.
const CLOUD_REACH: f64 = 3.0;
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
    /// Those of them with only one value, whose depth is removed.
    pub(super) constant: usize,
    /// Share of pixels that count.
    pub(super) known: f64,
    /// The comparison; `None` if there are too few points, or they are those of the cloud that is the depth.
    pub(super) verdict: Option<Verdict>,
}

/// Reads the depth of some views and compares it with the points. Removes maps with only one value.
pub(super) fn check(
    scene: &mut Scene<'_>,
    along: DepthAlong,
    source: DepthOrigin,
) -> Result<Checked, LoadError> {
    let is_file = matches!(source, DepthOrigin::Maps | DepthOrigin::RelativeMaps);
    let with: Vec<usize> =
        (0..scene.train.len()).filter(|&view| scene.train[view].source.depth.is_some()).collect();
    let first = with.first().and_then(|&view| scene.train[view].source.depth.as_ref());
    let example = first.and_then(|depth| depth.path());
    let example = example.map_or_else(String::new, |path| format!("{}: ", path.display()));
    let unit = first.and_then(|depth| match depth.meaning {
        Meaning::Depth(unit) => Some(unit),
        Meaning::Inverse(_) | Meaning::Unfitted => None,
    });
    let mut agreement = Agreement::default();
    let (mut views, mut empty, mut constant, mut counted, mut pixels) = (0, 0, 0, 0, 0);
    let mut negative = 0.0;
    for &number in with.iter().step_by(with.len().div_ceil(CHECKED).max(1)) {
        let view = &scene.train[number];
        let Some(depth) = &view.source.depth else { continue };
        let sampled = depth.sampled(&view.source)?;
        let known = |x: &f32| *x > 0.0 && x.is_finite();
        views += 1;
        negative += sampled.negative;
        empty += usize::from(!sampled.inverse.iter().any(known));
        pixels += sampled.inverse.len();
        if is_file && sampled.is_constant() {
            constant += 1;
            scene.train[number].source.depth = None;
            continue;
        }
        let counts = |(x, weight): &(&f32, &u8)| known(x) && **weight > 0;
        counted += sampled.inverse.iter().zip(&sampled.confidence).filter(counts).count();
        // Edges do not count, here as in training: points lie on either side of them.
        let inverse: Vec<f32> = { sampled.inverse.iter().zip(&sampled.confidence) }
            .map(|(x, weight)| if *weight > 0 { *x } else { 0.0 })
            .collect();
        let inverse = match source {
            DepthOrigin::Points => widened((view.camera.width, view.camera.height), &inverse),
            _ => inverse,
        };
        agreement.add(&view.camera, &seen_points(&scene.points.positions, &view.camera), &inverse);
    }
    if negative > 0.5 * views as f64 {
        let problem = format!(
            "{example}most depths of the {views} checked views are negative; depth is measured along the viewing \
             direction, in front of the camera"
        );
        return Err(refused(problem, DepthRemedy::Repair));
    }
    if empty == views {
        let (problem, remedy) = match source {
            DepthOrigin::Points => (
                format!("none of the {views} checked views shows a point of the cloud"),
                DepthRemedy::Align,
            ),
            _ => (
                format!(
                    "{example}no depth is known in any of {views} views: all values are 0, negative or not finite"
                ),
                DepthRemedy::Repair,
            ),
        };
        return Err(refused(problem, remedy));
    }
    if constant > 0 && constant + empty == views {
        let problem = format!(
            "{example}the depth maps of all {views} checked views have only one value each"
        );
        return Err(refused(problem, DepthRemedy::Repair));
    }
    if counted == 0 {
        let problem = format!(
            "{example}no depth of the {views} checked views counts: all confidences are 0, or all neighbours differ by \
             more than 5 %"
        );
        return Err(refused(problem, DepthRemedy::Repair));
    }
    let verdict = if scene.is_seeded { None } else { agreement.verdict() };
    match &verdict {
        Some(verdict) if source == DepthOrigin::Points => judge_cloud(verdict)?,
        Some(verdict) => {
            judge(verdict, along, &example)?;
            let remedy = match source {
                DepthOrigin::RelativeMaps => DepthRemedy::MorePoints,
                _ if unit.is_none() => DepthRemedy::Params,
                _ => DepthRemedy::Unit,
            };
            judge_scale(verdict, unit, &example, remedy)?;
        }
        None => {}
    }
    Ok(Checked { views, empty, constant, known: counted as f64 / pixels.max(1) as f64, verdict })
}

/// Gives pixels without depth that of the nearest pixel with one.
fn widened(size: (u32, u32), inverse: &[f32]) -> Vec<f32> {
    let (columns, rows) = (0..size.0, 0..size.1);
    let centres =
        rows.flat_map(|y| columns.clone().map(move |x| [f64::from(x) + 0.5, f64::from(y) + 0.5]));
    let known = |pixel: usize| inverse[pixel] > 0.0;
    let nearest = |at| nearest_valid(size, at, [CLOUD_REACH; 2], known);
    centres.map(|at| nearest(at).map_or(0.0, |pixel| inverse[pixel])).collect()
}

/// True if the depth of the maps rises and falls with that of the points.
fn follows(verdict: &Verdict) -> bool {
    verdict.spread <= SPREAD_REFUSED.max(SPREAD_OF_UNRELATED * verdict.unrelated_spread)
}

/// Refuses a cloud that disagrees with the points: it has other coordinates.
fn judge_cloud(verdict: &Verdict) -> Result<(), LoadError> {
    if !follows(verdict) {
        let problem = format!(
            "the cloud's depth does not follow that of {} points that the views see: half of the ratios differ by more \
             than {:.0} %",
            grouped(verdict.pairs),
            100.0 * SPREAD_REFUSED
        );
        return Err(refused(problem, DepthRemedy::Align));
    }
    judge_scale(verdict, None, "the cloud: ", DepthRemedy::Align)
}

/// Refuses depth that disagrees with the points.
fn judge(verdict: &Verdict, along: DepthAlong, example: &str) -> Result<(), LoadError> {
    let points = points_of(verdict);
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
    if follows(verdict) {
        return Ok(());
    }
    let problem = format!(
        "{example}depth does not follow that of {points}: half of the ratios differ by more than {:.0} %, as if the maps \
         belonged to other views",
        100.0 * SPREAD_REFUSED
    );
    Err(refused(problem, DepthRemedy::OtherViews))
}

fn points_of(verdict: &Verdict) -> String {
    format!("{} points that the views see", grouped(verdict.pairs))
}

/// Refuses depth of another scale than that of the points.
fn judge_scale(
    verdict: &Verdict,
    unit: Option<f64>,
    example: &str,
    remedy: DepthRemedy,
) -> Result<(), LoadError> {
    let points = points_of(verdict);
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
    Err(refused(problem, remedy))
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
