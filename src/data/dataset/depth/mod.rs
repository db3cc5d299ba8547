//! Depth given beside photographs: finding it, reading it, and bringing it to the views.
//!
//! Each source of depth is a file here: the formats of depth maps, a point cloud, the surface of a built-in scene. A
//! source is read together with the photograph of its view, and sampled at the centres of the view's pixels, so that
//! turns, windows, undistortion and scaling are those of the photograph.

mod agreement;
mod check;
mod colmap;
mod decide;
mod exr;
mod faults;
mod files;
mod fit;
mod npy;
mod options;
mod params;
mod png;
mod points;
mod raw;
mod sample;
#[cfg(test)]
mod tests;

use std::path::Path;
use std::sync::Arc;

use image::metadata::Orientation;

use super::LoadError;
use super::images::{ImageHeader, ImageSource, SourceFile};
pub use decide::{DepthFinding, DepthOrigin};
pub(super) use decide::{Scene, decide, first_points};
use densify_core::camera::Camera;
use densify_core::image::depth::{DepthMap, SharedDepth};
use faults::Faults;
pub(super) use files::{DepthFile, DepthKind};
pub use options::{DepthAlong, DepthChoice, DepthOptions, DepthUnit};
pub(super) use params::add_params;
pub(super) use points::PointSet;
use raw::{DepthHeader, Values};

/// Largest relative difference of the width-to-height ratios of a depth map and its photograph: sensors of depth and of
/// colour have sides of other ratios by up to this much, such as 640x480 and 1296x968.
const SAME_SHAPE: f64 = 0.015;

/// The source of a view's depth, and its conversion to the units of the scene.
#[derive(Debug, Clone)]
pub struct DepthSource {
    from: From,
    meaning: Meaning,
    along: DepthAlong,
    /// Scene units per world unit, after any correction.
    to_scene: f64,
    /// The view's camera.
    camera: Camera,
    /// Faults met in training, shared by all views; `None` if they are errors.
    faults: Option<Arc<Faults>>,
}

/// The origin of the values.
#[derive(Debug, Clone)]
enum From {
    File(Box<MapFile>),
    /// A point cloud in scene units, projected into the view.
    Points(Arc<PointSet>),
    /// Depths in memory, of the size of the whole photograph `[world units]`.
    Rendered(Arc<Values>),
}

/// A file with a depth map.
#[derive(Debug, Clone)]
struct MapFile {
    file: SourceFile,
    kind: DepthKind,
    header: DepthHeader,
    confidence: Option<(SourceFile, ImageHeader)>,
    /// The turn that brings the map to the orientation of the photograph.
    turn: Option<Orientation>,
}

/// The meaning of a value.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Meaning {
    /// Depth in multiples of this length `[world units]`.
    Depth(f64),
    /// Inverse depth is the value times the first number, plus the second `[1/world units]`.
    Inverse([f64; 2]),
    /// Inverse depth up to an unknown scale and offset.
    Unfitted,
}

impl Meaning {
    /// Returns true if 0 is a value rather than unknown.
    fn keeps_zero(self) -> bool {
        !matches!(self, Self::Depth(_))
    }
}

impl DepthSource {
    /// The depth of a photograph in a file, before its camera is known. The header is read and compared with the
    /// photograph.
    ///
    /// # Errors
    /// When the file cannot be read, or has other proportions than the photograph.
    pub(super) fn of_file(
        found: &DepthFile,
        photograph: ImageHeader,
        options: &DepthOptions,
    ) -> Result<Self, LoadError> {
        let DepthFile { path, kind, unit, inverse, confidence } = found;
        let file = SourceFile::existing(path.clone())?;
        let header = raw::read_header(&file, *kind)?;
        let confidence = confidence.clone().map(|path| {
            let header = super::images::read_header(&path)?;
            Ok::<_, LoadError>((SourceFile::existing(path)?, header))
        });
        let confidence = confidence.transpose()?;
        let size = (photograph.width, photograph.height);
        let turn = turn_of(path, (header.width, header.height), size, photograph.turn)?;
        if let Some((file, confidence)) = &confidence
            && (confidence.width, confidence.height) != (header.width, header.height)
        {
            let sizes = (confidence.width, confidence.height);
            let (width, height) = sizes;
            let problem = format!(
                "{width}x{height} px instead of the depth map's {}x{} px",
                header.width, header.height
            );
            let remedy = "export them at the size of the depth map, or remove them";
            return Err(LoadError::malformed(&file.path, "the confidences", problem, remedy));
        }
        let meaning = match (options.unit, inverse, unit) {
            (Some(DepthUnit::Relative), ..) => Meaning::Unfitted,
            (Some(DepthUnit::World(unit)), ..) => Meaning::Depth(unit),
            (None, Some([scale, offset]), _) => Meaning::Inverse([scale / 65_536.0, *offset]),
            (None, None, unit) => Meaning::Depth(unit.unwrap_or(kind.unit())),
        };
        let map = MapFile { file, kind: *kind, header, confidence, turn };
        Ok(Self::new(From::File(Box::new(map)), meaning, options.along))
    }

    /// Depths of a rendered photograph `[world units]`, 0 where nothing is seen. Shape: `[height, width]`.
    pub(super) fn rendered((width, height): (u32, u32), depth: Vec<f32>) -> Option<Self> {
        let unknown = |z: f32| if z > 0.0 { z } else { f32::NAN };
        let values = depth.into_iter().map(unknown).collect();
        let values = Arc::new(Values::from_raw(width, height, values)?);
        Some(Self::new(From::Rendered(values), Meaning::Depth(1.0), DepthAlong::Axis))
    }

    fn of_points(points: &Arc<PointSet>) -> Self {
        Self::new(From::Points(Arc::clone(points)), Meaning::Depth(1.0), DepthAlong::Axis)
    }

    fn new(from: From, meaning: Meaning, along: DepthAlong) -> Self {
        let none = Camera::centred((1, 1), (1.0, 1.0), glam::DMat3::IDENTITY, glam::DVec3::ZERO);
        Self { from, meaning, along, to_scene: 1.0, camera: none, faults: None }
    }

    /// Sets the view's camera, and the scene units per world unit.
    fn place(&mut self, camera: Camera, to_scene: f64) {
        self.camera = camera;
        self.to_scene = to_scene;
    }

    /// The files that the depth is read from, for archives.
    pub(super) fn files_mut(&mut self) -> impl Iterator<Item = &mut SourceFile> {
        let map = match &mut self.from {
            From::File(map) => Some(map),
            From::Points(_) | From::Rendered(_) => None,
        };
        map.into_iter().flat_map(|map| {
            let MapFile { file, confidence, .. } = &mut **map;
            std::iter::once(file).chain(confidence.as_mut().map(|(file, _)| file))
        })
    }

    /// Bytes that this view's depth holds all the time, and each copy of it again `[bytes]`.
    pub fn held_bytes(&self) -> u64 {
        let file = if matches!(self.from, From::File(_)) { size_of::<MapFile>() } else { 0 };
        (size_of::<Self>() + file) as u64
    }

    /// Bytes of pixels in memory, which copies share `[bytes]`.
    pub fn pixel_bytes(&self) -> u64 {
        match &self.from {
            From::Rendered(values) => 4 * values.len() as u64,
            From::File(_) | From::Points(_) => 0,
        }
    }

    /// Bytes of the point cloud that the views share `[bytes]`.
    pub fn shared_bytes(&self) -> u64 {
        match &self.from {
            From::Points(points) => points.bytes(),
            From::File(_) | From::Rendered(_) => 0,
        }
    }

    /// A text that changes with the depth, for fingerprints: the lengths of its files, and its units.
    pub fn fingerprint(&self) -> String {
        let from = match &self.from {
            From::File(map) => {
                let confidence = map.confidence.as_ref().map(|(file, _)| file.length());
                format!("{} {confidence:?} {:?}", map.file.length(), map.header)
            }
            From::Points(points) => format!("{} points", points.len()),
            From::Rendered(values) => format!("{:?}", values.dimensions()),
        };
        format!("{from} {:?} {:?} {}", self.meaning, self.along, self.to_scene)
    }

    /// Memory for reading the depth of a view of `pixels` pixels, including the result `[bytes]`.
    pub(super) fn working_bytes(&self, pixels: u64) -> u64 {
        // Inverse depths in f32 and confidences, and the map; the median takes another copy.
        let sampled = pixels * (4 + 1 + 4 + 3);
        match &self.from {
            From::File(map) => {
                let DepthHeader { width, height, file_bytes, decoded_bytes } = map.header;
                let values = 4 * u64::from(width) * u64::from(height);
                let turned = if map.turn.is_some() { 2 * values } else { values };
                let confidence = map
                    .confidence
                    .as_ref()
                    .map_or(0, |(_, header)| header.file_bytes + 3 * header.decoded_bytes);
                (file_bytes + decoded_bytes + turned).max(values + confidence + sampled)
            }
            From::Points(_) => 2 * sampled,
            From::Rendered(_) => sampled,
        }
    }

    /// The depth map of a view; `None` if no depth is known.
    ///
    /// # Errors
    /// When a file cannot be read, or is no longer what its header said, unless such [faults](Self::take_faults) are kept.
    pub(super) fn load(&self, view: &ImageSource) -> Result<Option<SharedDepth>, LoadError> {
        let sampled = match (self.sampled(view), &self.faults) {
            (Err(fault), Some(faults)) => {
                faults.add(fault);
                return Ok(None);
            }
            (sampled, _) => sampled?,
        };
        // As in the checks before training, which read only some of the views.
        if self.path().is_some() && sampled.is_constant() {
            return Ok(None);
        }
        let size = (self.camera.width, self.camera.height);
        Ok(DepthMap::quantised(size, &sampled.inverse, sampled.confidence).map(Arc::new))
    }

    /// The faults met since the last call, of this view and those that share the list.
    pub(super) fn take_faults(&self) -> Vec<LoadError> {
        self.faults.as_ref().map_or_else(Vec::new, |faults| faults.take())
    }

    /// The path for messages.
    fn path(&self) -> Option<&Path> {
        match &self.from {
            From::File(map) => Some(&map.file.path),
            From::Points(_) | From::Rendered(_) => None,
        }
    }
}

/// The turn of a depth map that brings it to the proportions of its photograph: none, or that of the photograph.
fn turn_of(
    path: &Path,
    (width, height): (u32, u32),
    photograph: (u32, u32),
    turn: Option<Orientation>,
) -> Result<Option<Orientation>, LoadError> {
    let ratio = |(width, height): (u32, u32)| f64::from(width) / f64::from(height);
    let expected = ratio(photograph);
    let fits = |size: (u32, u32)| (ratio(size) / expected - 1.0).abs() <= SAME_SHAPE;
    if turn.is_some() && fits((height, width)) {
        return Ok(turn);
    }
    if fits((width, height)) {
        Ok(None)
    } else {
        Err(another_size(path, (width, height), photograph))
    }
}

fn another_size(path: &Path, (width, height): (u32, u32), expected: (u32, u32)) -> LoadError {
    let (w, h) = expected;
    let problem = format!(
        "{width}x{height} px do not have the proportions of the photograph, {w}x{h} px: it shows another part of the scene"
    );
    LoadError::malformed(path, "the depth map", problem, "register depth and colour first")
}
