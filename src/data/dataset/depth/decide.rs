//! Decides whether depth is used: whether there is any, and whether it passes the checks.
//!
//! Some views are read. Their depth must have more than one value and agree with the points that the views
//! see; an error in scale of less than a fifth is corrected. With [relative](DepthUnit::Relative) depth, every view is
//! read, and its scale and offset are fitted to its points.

use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::super::normalise::Normalisation;
use super::super::{LoadError, LoadOptions, Note, PointCloud, View};
use super::check::check;
use super::fit::fit_views;
use super::points::{self, PointSet};
use super::{DepthChoice, DepthSource, Faults, From, Meaning};
use crate::error::{DepthRemedy, LoadRemedy};
use densify_core::numbers::grouped;

/// Error in scale that is ignored.
const SCALE_IGNORED: f64 = 0.02;
/// Spread of the scales of different views that is noted.
const SPREAD_NOTED: f64 = 0.05;

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
            (0, _) => "not compared with points, as there are too few others".to_owned(),
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
    /// True if the points are those of the [cloud](super::DepthOptions::points).
    pub(in super::super) is_seeded: bool,
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
        DepthChoice::Auto | DepthChoice::On => {
            prepare(&mut scene, options, notes).map_err(with_remedy)
        }
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

/// Adds to an error that the run needs no depth.
fn with_remedy(error: LoadError) -> LoadError {
    match error {
        LoadError::Remedied { remedy: LoadRemedy::Depth(_), .. } => error,
        other => refused(other.to_string(), DepthRemedy::LeaveOut),
    }
}

pub(super) fn refused(problem: String, remedy: DepthRemedy) -> LoadError {
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
    let checked = check(scene, options.depth.along, source)?;
    let faults = options.depth.drops_damaged.then(|| Arc::new(Faults::default()));
    for depth in scene.train.iter_mut().filter_map(|view| view.source.depth.as_mut()) {
        depth.faults.clone_from(&faults);
    }
    let views = scene.train.iter().filter(|view| view.source.depth.is_some()).count();
    let verdict = checked.verdict;
    let scale = verdict.map_or(1.0, |verdict| verdict.scale);
    let error = (scale - 1.0).abs();
    // A point cloud has the coordinates of the dataset.
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
    if checked.constant > 0 {
        notes.push(Note::Text(format!(
            "{} of {} checked depth maps have only one value each; such maps are not used",
            checked.constant, checked.views
        )));
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

/// The points of a cloud that seed a scene without points, even if its depth is not used.
pub(in super::super) fn first_points(
    options: &LoadOptions,
) -> Result<Option<PointCloud>, LoadError> {
    let cloud = options.depth.points.as_deref().map(points::read).transpose()?;
    Ok(cloud.filter(|cloud| cloud.positions.iter().any(|point: &DVec3| point.is_finite())))
}
