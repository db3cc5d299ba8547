//! Decides whether depth is used: whether there is any, and whether it passes the checks.
//!
//! Up to [`CHECKED`] views are read. Their depth must have more than one value and agree with the points that the views
//! see; an error in scale of less than a fifth is corrected. With [relative](DepthUnit::Relative) depth, every view is
//! read, and its scale and offset are fitted to its points.

use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::super::normalise::{Normalisation, median};
use super::super::{LoadError, LoadOptions, Note, PointCloud, View};
use super::agreement::{Agreement, Fault, SeenPoint, Verdict, seen_points};
use super::points::{self, PointSet};
use super::{DepthAlong, DepthChoice, DepthSource, From, Meaning};
use crate::error::{DepthRemedy, LoadRemedy};
use densify_core::numbers::grouped;

/// Number of views, at equal intervals, whose depth is checked before training.
const CHECKED: usize = 24;
/// Error in scale that is ignored, and the one from which on depth is refused.
const SCALE_IGNORED: f64 = 0.02;
const SCALE_REFUSED: f64 = 0.2;
/// Spread of the scales of different views that is noted.
const SPREAD_NOTED: f64 = 0.05;
/// A relative map needs this many points; its scale must be within this range of multiples of the median.
const FIT_POINTS: usize = 10;
const FIT_SCALES: [f64; 2] = [0.2, 5.0];
/// Repetitions of the fit, each with the pairs whose errors are at most this multiple of the median error.
const FIT_ROUNDS: usize = 4;
const FIT_WIDTH: f64 = 2.0;
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

/// The depth that a run uses, and the evidence for it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthFinding {
    /// Kind of the source.
    pub source: DepthOrigin,
    /// Number of training views with depth.
    pub views: usize,
    /// Number of training views.
    pub of_views: usize,
    /// Share of the pixels of the checked views whose depth is known and counts, in `[0, 1]`.
    pub known: f64,
    /// Number of points that were compared with the depth; 0 if there were too few.
    pub points: usize,
    /// Ratio of the given depth to that of the points, before a correction; 1 if it is not known.
    pub scale: f64,
    /// True if the depth was multiplied by 1/scale.
    pub is_corrected: bool,
}

/// The kind of a source of depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DepthOrigin {
    /// Depth maps.
    Maps,
    /// Maps of inverse depth, whose scale and offset are fitted for each view.
    RelativeMaps,
    /// A point cloud.
    Points,
    /// The surface of a built-in scene.
    Surface,
}

impl DepthFinding {
    /// One line for the user.
    pub fn describe(&self) -> String {
        let source = match self.source {
            DepthOrigin::Maps => "depth maps",
            DepthOrigin::RelativeMaps => "depth maps fitted to the points of each view",
            DepthOrigin::Points => "a point cloud",
            DepthOrigin::Surface => "the scene's surface",
        };
        let scale = match (self.points, self.is_corrected) {
            (0, _) => "not compared with points, of which there are too few".to_owned(),
            (points, false) => {
                format!("{:.3} times that of {} points", self.scale, grouped(points))
            }
            (points, true) => format!(
                "{:.3} times that of {} points, which is corrected",
                self.scale,
                grouped(points)
            ),
        };
        format!(
            "{source} for {} of {} views, {:.1} % of the pixels; {scale}",
            self.views,
            self.of_views,
            100.0 * self.known
        )
    }
}

/// The parts of a dataset that the decision needs; the views and points are in the units of the scene.
pub(in super::super) struct Scene<'a> {
    pub(in super::super) train: &'a mut [View],
    pub(in super::super) test: &'a mut [View],
    pub(in super::super) points: &'a PointCloud,
    pub(in super::super) normalisation: &'a Normalisation,
    /// True if densify rendered the depth as ground truth.
    pub(in super::super) is_truth: bool,
    /// The first fault met so far.
    pub(in super::super) fault: Option<LoadError>,
}

/// Decides about the depth of all views and prepares it. If it is not used, it is removed from the views.
///
/// # Errors
/// When depth is required, and there is none or it fails a check.
pub(in super::super) fn decide(
    mut scene: Scene<'_>,
    options: &LoadOptions,
    notes: &mut Vec<Note>,
) -> Result<Option<DepthFinding>, LoadError> {
    for view in scene.test.iter_mut() {
        view.source.depth = None;
    }
    let choice = options.depth.choice;
    let used = match choice {
        DepthChoice::Off => Ok(None),
        DepthChoice::Auto if scene.is_truth && options.depth.points.is_none() => Ok(None),
        DepthChoice::Auto | DepthChoice::On => prepare(&mut scene, options, notes),
    };
    let finding = match used {
        Ok(Some(finding)) => return Ok(Some(finding)),
        Err(error) if choice == DepthChoice::On => return Err(error),
        Err(error) => {
            notes.push(Note::DepthLeftOut(Box::new(error)));
            None
        }
        Ok(None) if choice == DepthChoice::On => {
            let problem = "no training view has depth: it is looked for in `depth_file_path` of transforms.json, in \
                           `depth/` and `depths/` under the names of the photographs, and in `stereo/depth_maps/`";
            return Err(refused(problem.to_owned(), DepthRemedy::AddFiles));
        }
        Ok(None) => None,
    };
    for view in scene.train.iter_mut() {
        view.source.depth = None;
    }
    Ok(finding)
}

fn refused(problem: String, remedy: DepthRemedy) -> LoadError {
    LoadError::Remedied { problem, remedy: LoadRemedy::Depth(remedy) }
}

/// Reads what is needed, and checks it; `None` if no view has depth.
fn prepare(
    scene: &mut Scene<'_>,
    options: &LoadOptions,
    notes: &mut Vec<Note>,
) -> Result<Option<DepthFinding>, LoadError> {
    if let Some(fault) = scene.fault.take() {
        return Err(fault);
    }
    if let Some(path) = &options.depth.points {
        let points = Arc::new(PointSet::new(&points::read(path)?, scene.normalisation));
        for view in scene.train.iter_mut() {
            view.source.depth = Some(Box::new(DepthSource::of_points(&points)));
        }
    }
    let to_scene = scene.normalisation.scale;
    for view in scene.train.iter_mut() {
        if let Some(depth) = &mut view.source.depth {
            depth.place(view.camera, to_scene);
        }
    }
    let Some(first) = scene.train.iter().find_map(|view| view.source.depth.as_ref()) else {
        return Ok(None);
    };
    let is_relative = first.meaning == Meaning::Unfitted;
    let source = match &first.from {
        From::File(_) if is_relative => DepthOrigin::RelativeMaps,
        From::File(_) => DepthOrigin::Maps,
        From::Points(_) => DepthOrigin::Points,
        From::Rendered(_) => DepthOrigin::Surface,
    };
    if is_relative {
        fit_views(scene, notes)?;
    }
    let checked = check(scene, &options.depth.along, source)?;
    let views = scene.train.iter().filter(|view| view.source.depth.is_some()).count();
    let verdict = checked.verdict;
    let scale = verdict.map_or(1.0, |verdict| verdict.scale);
    let error = (scale - 1.0).abs();
    // A point cloud has the coordinates of the dataset, and its points may be those compared with.
    let is_corrected = error > SCALE_IGNORED && source != DepthOrigin::Points;
    if is_corrected {
        for depth in scene.train.iter_mut().filter_map(|view| view.source.depth.as_mut()) {
            depth.to_scene /= scale;
        }
        notes.push(Note::Text(format!(
            "depth is {:.1} % too {} compared with {} points that the views see; it is corrected",
            100.0 * error,
            if scale > 1.0 { "large" } else { "small" },
            grouped(verdict.map_or(0, |verdict| verdict.pairs))
        )));
    }
    let of_views = scene.train.len();
    if views < of_views {
        notes.push(Note::Text(format!("{} of {of_views} views have no depth", of_views - views)));
    }
    if checked.empty > 0 {
        notes.push(Note::Text(format!(
            "{} of {} checked depth maps have no known depth",
            checked.empty, checked.views
        )));
    }
    if let Some(verdict) = verdict.filter(|verdict| verdict.between_views > SPREAD_NOTED) {
        notes.push(Note::DepthScalesDiffer { percent: 100.0 * verdict.between_views });
    }
    Ok(Some(DepthFinding {
        source,
        views,
        of_views,
        known: checked.known,
        points: verdict.map_or(0, |verdict| verdict.pairs),
        scale,
        is_corrected,
    }))
}

/// The result of reading some of the views.
struct Checked {
    /// Number of views that were read.
    views: usize,
    /// Those of them without any known depth.
    empty: usize,
    /// Share of pixels that count.
    known: f64,
    verdict: Option<Verdict>,
}

/// Reads the depth of some views and compares it with the points.
fn check(scene: &Scene<'_>, along: &DepthAlong, source: DepthOrigin) -> Result<Checked, LoadError> {
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
                constant += usize::from(source != DepthOrigin::Points && is_constant(first))
            }
        }
        let counts = |(x, weight): &(&f32, &u8)| known(x) && **weight > 0;
        counted += sampled.inverse.iter().zip(&sampled.confidence).filter(counts).count();
        pixels += sampled.inverse.len();
        // Edges do not count, here as in training: points lie on either side of them.
        let inverse: Vec<f32> = { sampled.inverse.iter().zip(&sampled.confidence) }
            .map(|(x, weight)| if *weight > 0 { *x } else { 0.0 })
            .collect();
        agreement.add(&view.camera, &seen(scene, view), &inverse);
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

/// The points that a view sees.
fn seen(scene: &Scene<'_>, view: &View) -> Vec<SeenPoint> {
    seen_points(&scene.points.positions, &view.camera)
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

/// Fits scale and offset of each view's relative map to the points that the view sees. Views whose fit is unreliable lose their depth.
fn fit_views(scene: &mut Scene<'_>, notes: &mut Vec<Note>) -> Result<(), LoadError> {
    let to_scene = scene.normalisation.scale;
    let mut fits = Vec::new();
    for view in scene.train.iter() {
        let Some(depth) = &view.source.depth else {
            fits.push(None);
            continue;
        };
        let sampled = depth.sampled(&view.source)?;
        let width = view.camera.width as usize;
        let pairs: Vec<[f64; 2]> = seen(scene, view)
            .into_iter()
            .filter_map(|SeenPoint { pixel, depth }| {
                let at = pixel.y as usize * width + pixel.x as usize;
                let is_counted = sampled.inverse[at].is_finite() && sampled.confidence[at] > 0;
                is_counted.then(|| [f64::from(sampled.inverse[at]), 1.0 / depth])
            })
            .collect();
        fits.push(fit(&pairs));
    }
    let scales = fits.iter().flatten().map(|fit| fit[0]);
    let Some(middle) = median(scales.clone().collect()) else {
        let problem = format!(
            "relative depth needs {FIT_POINTS} points in each view to fit its scale and offset, but no view sees them"
        );
        return Err(refused(problem, DepthRemedy::Unit));
    };
    if scales.clone().filter(|scale| *scale <= 0.0).count() * 2 > scales.count() {
        let problem =
            "the values grow where the points are farther away: they are depth, not inverse depth";
        return Err(refused(problem.to_owned(), DepthRemedy::NotRelative));
    }
    let mut dropped = 0;
    for (view, fit) in scene.train.iter_mut().zip(fits) {
        let Some(depth) = &mut view.source.depth else { continue };
        match fit {
            Some([s, t]) if (FIT_SCALES[0] * middle..=FIT_SCALES[1] * middle).contains(&s) => {
                depth.meaning = Meaning::Inverse([s * to_scene, t * to_scene]);
            }
            _ => {
                view.source.depth = None;
                dropped += 1;
            }
        }
    }
    if dropped > 0 {
        notes.push(Note::Text(format!(
            "the relative depth of {dropped} views could not be fitted to their points, and is not used"
        )));
    }
    Ok(())
}

/// Scale and offset that map the first numbers to the second; the scale is negative if one falls where the other grows.
///
/// Some pairs are points that the view does not see. The fit therefore starts with the median of the slopes between
/// distant pairs, and is repeated with the pairs that it describes best, by least squares.
fn fit(pairs: &[[f64; 2]]) -> Option<[f64; 2]> {
    if pairs.len() < FIT_POINTS {
        return None;
    }
    let mut sorted = pairs.to_vec();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let (low, high) = sorted.split_at(sorted.len() / 2);
    let slopes = low.iter().zip(high).filter(|(a, b)| b[0] > a[0]);
    let mut scale = median(slopes.map(|(a, b)| (b[1] - a[1]) / (b[0] - a[0])).collect())?;
    let mut offset = median(pairs.iter().map(|[a, b]| b - scale * a).collect())?;
    for _ in 0..FIT_ROUNDS {
        let error = |[a, b]: &[f64; 2]| (b - scale * a - offset).abs();
        let limit = FIT_WIDTH * median(pairs.iter().map(error).collect())?;
        let kept: Vec<[f64; 2]> =
            pairs.iter().filter(|&pair| error(pair) <= limit).copied().collect();
        let count = kept.len() as f64;
        let mean = |number: usize| kept.iter().map(|pair| pair[number]).sum::<f64>() / count;
        let means = [mean(0), mean(1)];
        let moment = |x: usize, y: usize| -> f64 {
            kept.iter().map(|pair| (pair[x] - means[x]) * (pair[y] - means[y])).sum()
        };
        scale = moment(0, 1) / moment(0, 0);
        offset = means[1] - scale * means[0];
    }
    (scale.is_finite() && offset.is_finite()).then_some([scale, offset])
}

/// The points of a cloud that seed a scene without points.
pub(in super::super) fn first_points(
    options: &LoadOptions,
) -> Result<Option<PointCloud>, LoadError> {
    if options.depth.choice == DepthChoice::Off {
        return Ok(None);
    }
    let cloud = options.depth.points.as_deref().map(points::read).transpose()?;
    Ok(cloud.filter(|cloud| cloud.positions.iter().any(|point: &DVec3| point.is_finite())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relative_depth_is_fitted_with_the_sign_of_the_relation() {
        // A quarter of the points is hidden behind what the map shows.
        let hidden = |i: i32| if i % 4 == 0 { 30.0 } else { 0.0 };
        let pairs = |s: f64| -> Vec<[f64; 2]> {
            (0..21).map(|i| [f64::from(i), s * f64::from(i) + 3.0 + hidden(i)]).collect()
        };
        for s in [0.5, -2.0] {
            let [scale, offset] = fit(&pairs(s)).unwrap();
            assert!((scale - s).abs() < 1e-9 && (offset - 3.0).abs() < 1e-9, "{scale} {offset}");
        }
        assert_eq!(fit(&pairs(1.0)[..9]), None);
        assert_eq!(fit(&[[1.0, 2.0]; 12]), None, "a constant map has no scale");
    }

    #[test]
    fn ratios_have_three_digits() {
        assert_eq!([1000.4, 0.001_234_9, 1.05].map(significant), ["1000", "0.00123", "1.05"]);
    }
}
