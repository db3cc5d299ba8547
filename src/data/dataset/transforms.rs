//! Reads `transforms.json` (nerfstudio, instant-ngp) and `transforms_{train,test}.json`
//! (NeRF-synthetic).
//!
//! Poses are `world_from_camera` with OpenGL axes (x right, y up, looking along −z). Intrinsics are
//! at the top level or in the frame; those in the frame take precedence.
//! This module reads both formats, because their frames have the same fields.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec2, DVec3};
use serde_json::{Map, Value};

use super::folders::{Folders, ImageFile};
use super::formats::DatasetFormat;
use super::frame_lists::{self, FrameLists};
use super::images::{self, ImageHeader};
use super::json;
use super::lens::models::{FISHEYE_FIELDS, OPENCV_FIELDS};
use super::lens::{Distortion, Lens, Projection};
use super::mask_files::MaskFile;
use super::paths::{DataPath, Root, relative};
use super::pose::{check_lens, checked_pose};
use super::prepare::text_notes;
use super::{Frame, LoadError, LoadOptions, Note, Scene, Split, colmap};

/// The format with a pair of files, which defines its own test split.
pub(super) const SPLIT_FORMAT: DatasetFormat = DatasetFormat {
    name: "nerf-synthetic",
    title: "NeRF-synthetic",
    file: PAIR[0],
    files: "transforms_train.json and transforms_test.json",
    read: read_pair,
};
/// The format with the single file `transforms.json`.
pub(super) const FORMAT: DatasetFormat = DatasetFormat {
    name: "transforms",
    title: "nerfstudio or instant-ngp",
    file: SINGLE,
    files: SINGLE,
    read: read_single,
};

const PAIR: [&str; 2] = ["transforms_train.json", "transforms_test.json"];
pub(super) const SINGLE: &str = "transforms.json";

const MAX_FRAMES: usize = 1_000_000;
const REMEDY: &str = "correct the file or export it again";

/// File names that 3DGS and nerfstudio use for initial points without naming them in the JSON.
const POINT_FILES: [&str; 3] = ["points3d.ply", "sparse_pc.ply", "points3D.ply"];
/// Names of camera models that are pinholes with OpenCV's distortion.
const PINHOLES: [&str; 7] = [
    "OPENCV",
    "FULL_OPENCV",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "RADIAL",
    "SIMPLE_RADIAL",
    "PERSPECTIVE",
];
/// Name of the camera model that is a fisheye with k1 to k4.
const FISHEYE: &str = "OPENCV_FISHEYE";

/// Reads `transforms_train.json` and `transforms_test.json`, with the tracks of a COLMAP model of the same scene.
fn read_pair(root: &Root, options: &LoadOptions) -> Result<Option<Scene>, LoadError> {
    if !PAIR.iter().all(|name| root.path().join(name).is_file()) {
        return Ok(None);
    }
    let folders = Folders::new(root, options, false)?;
    let mut scene = read(root, &folders, PAIR[0], DeclaredSplit::Train)?;
    let test = read(root, &folders, PAIR[1], DeclaredSplit::Test)?;
    scene.frames.extend(test.frames);
    scene.notes.extend(test.notes);
    scene.own_split = true;
    if options.tracks {
        colmap::adopt_tracks(root, &mut scene);
    }
    Ok(Some(scene))
}

/// Reads `transforms.json`.
fn read_single(root: &Root, options: &LoadOptions) -> Result<Option<Scene>, LoadError> {
    if !root.path().join(SINGLE).is_file() {
        return Ok(None);
    }
    let declared = match options.split {
        Split::Every(_) => DeclaredSplit::Train,
        Split::None | Split::Eval => DeclaredSplit::InLists,
    };
    read(root, &Folders::new(root, options, false)?, SINGLE, declared).map(Some)
}

/// The source of the division of a file's frames into those for training and those for tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum DeclaredSplit {
    /// All are for training.
    Train,
    /// All are for tests.
    Test,
    /// The [lists](FrameLists) in the file.
    InLists,
}

/// Reads the file `name`.
fn read(
    root: &Root,
    folders: &Folders,
    name: &str,
    declared: DeclaredSplit,
) -> Result<Scene, LoadError> {
    let path = root.path().join(name);
    root.existing(DataPath { file: &path, field: "the file", value: name })?;
    let Value::Object(top) = json::read(&path)? else {
        return Err(LoadError::malformed(&path, "the file", "it is not a JSON object", REMEDY));
    };
    let top = Fields { path: &path, place: String::new(), frame: None, top: &top };
    let Some(Value::Array(list)) = top.top.get("frames") else {
        return Err(top.fault("frames", "the list is missing"));
    };
    if list.len() > MAX_FRAMES {
        return Err(top.fault("frames", "there are more than a million"));
    }
    let mut lists = FrameLists::default();
    if declared == DeclaredSplit::InLists {
        top.frame_lists(folders, &mut lists)?;
    }
    let (mut frames, mut missing, mut fell_back) = (Vec::new(), Vec::new(), 0);
    let mut first_missing = None;
    for (index, entry) in list.iter().enumerate() {
        let place = format!("frames[{index}].");
        let Value::Object(entry) = entry else {
            return Err(top.fault(&format!("frames[{index}]"), "it is not an object"));
        };
        let fields = Fields { path: &path, place, frame: Some(entry), top: top.top };
        let Some(file) = fields.text("file_path")? else {
            return Err(fields.fault("file_path", "it is missing"));
        };
        let field = fields.full("file_path");
        let named = DataPath { file: &path, field: &field, value: file };
        let found = folders.image(named)?;
        let (trained, tested) = match declared {
            DeclaredSplit::Train => (true, false),
            DeclaredSplit::Test => (false, true),
            DeclaredSplit::InLists => lists.splits(file, found.as_ref()),
        };
        let Some(found) = found else {
            first_missing.get_or_insert_with(|| folders.shown_path(named));
            missing.push(file.to_owned());
            continue;
        };
        fell_back += usize::from(found.fell_back);
        let (rotation, translation) = fields.pose(file)?;
        let mask = match fields.text("mask_path")? {
            Some(value) => Some(fields.mask(root, folders, &found, value)?),
            None => folders.mask(&found, named)?,
        };
        let (lens, header) = fields.lens(&found.path, found.reduced)?;
        let frame = Frame {
            name: found.name,
            id: None,
            origin: format!("{}: frame {file}", path.display()),
            listed: relative(file),
            image: found.path,
            reduced: found.reduced,
            mask,
            lens,
            header,
            rotation,
            translation,
            held_out: tested,
        };
        frames.extend((trained && tested).then(|| Frame { held_out: false, ..frame.clone() }));
        frames.extend((trained || tested).then_some(frame));
    }
    if let Some((field, problem)) = lists.fault() {
        return Err(top.fault(field, problem));
    }
    let mut notes = lists.notes(name);
    if let Some(first) = missing.first() {
        let count = missing.len();
        notes.push(format!("{name}: {count} of {} frames have no image file and are skipped ({first} is the first)", list.len()));
    }
    if fell_back > 0 {
        notes.push(folders.fell_back_note(fell_back));
    }
    let points_file = points_file((root, folders), &top, declared, &mut notes)?;
    let (own_split, listing) = (lists.define_the_split(), path.clone());
    let (notes, rest) = (text_notes(notes), Scene::default());
    let mut scene = Scene { frames, first_missing, notes, points_file, listing, own_split, ..rest };
    if declared != DeclaredSplit::Test
        && let Some(file) = &scene.points_file
    {
        let (points, note) = crate::points::read_points(file)?;
        scene.points = points;
        scene.notes.extend(note.map(Note::Text));
    }
    Ok(scene)
}

/// The file of the initial points: the one named in the JSON, or one of [`POINT_FILES`].
fn points_file(
    (root, folders): (&Root, &Folders),
    top: &Fields<'_>,
    declared: DeclaredSplit,
    notes: &mut Vec<String>,
) -> Result<Option<PathBuf>, LoadError> {
    if let Some(value) = top.text("ply_file_path")? {
        let named = DataPath { file: top.path, field: "ply_file_path", value };
        if folders.folder_for_absolute(value).is_none() {
            let missing =
                || top.fault("ply_file_path", format!("the file {value:?} does not exist"));
            return Ok(Some(root.existing_on_any_system(named)?.ok_or_else(missing)?));
        }
        // The path is from another machine; the file may have been copied along with the photographs.
        for value in named.suffixes()? {
            if let Some(found) = root.existing(DataPath { value: &value, ..named })? {
                return Ok(Some(found));
            }
        }
        let file = top.path.file_name().unwrap_or_default().display();
        notes.push(densify_core::files::one_line(&format!(
            "{file}: the initial points {value:?} are not in the dataset's folder and are left out"
        )));
    }
    if declared == DeclaredSplit::Test { Ok(None) } else { usual_points(root, top.path, notes) }
}

/// The file of initial points under one of the [usual names](POINT_FILES), for pose files that name none.
pub(super) fn usual_points(
    root: &Root,
    file: &Path,
    notes: &mut Vec<String>,
) -> Result<Option<PathBuf>, LoadError> {
    for value in POINT_FILES {
        if let Some(found) = root.existing(DataPath { file, field: "initial points", value })? {
            notes.push(format!("initial points are taken from {value}"));
            return Ok(Some(found));
        }
    }
    Ok(None)
}

/// The fields of one frame, with those at the top level as defaults.
struct Fields<'a> {
    path: &'a Path,
    /// Prefix of field names in messages that names the frame, such as `frames[3].`; empty at the top level.
    place: String,
    frame: Option<&'a Map<String, Value>>,
    top: &'a Map<String, Value>,
}

impl<'a> Fields<'a> {
    fn full(&self, field: &str) -> String {
        format!("{}{field}", self.place)
    }

    fn fault(&self, field: &str, problem: impl Display) -> LoadError {
        LoadError::malformed(self.path, self.full(field), problem, REMEDY)
    }

    /// A field of the frame itself, or of the top level if there is no frame.
    fn own(&self, field: &str) -> Option<&'a Value> {
        self.frame.unwrap_or(self.top).get(field).filter(|value| !value.is_null())
    }

    fn text(&self, field: &str) -> Result<Option<&'a str>, LoadError> {
        match self.own(field) {
            None => Ok(None),
            Some(Value::String(text)) => Ok(Some(text)),
            Some(_) => Err(self.fault(field, "it is not a string")),
        }
    }

    /// Reads the lists of frames in the file.
    fn frame_lists(&self, folders: &Folders, lists: &mut FrameLists) -> Result<(), LoadError> {
        for (list, field) in frame_lists::FIELDS.into_iter().enumerate() {
            let Some(value) = self.own(field) else { continue };
            let fault = || self.fault(field, "it is not a list of file names");
            let names = value.as_array().ok_or_else(fault)?.iter();
            let named = |value: &'a Value| {
                let value = value.as_str().ok_or_else(fault)?;
                Ok(DataPath { file: self.path, field, value })
            };
            lists.add(folders, list, &names.map(named).collect::<Result<Vec<_>, LoadError>>()?)?;
        }
        Ok(())
    }

    /// The mask that a frame names.
    fn mask(
        &self,
        root: &Root,
        folders: &Folders,
        image: &ImageFile,
        value: &str,
    ) -> Result<MaskFile, LoadError> {
        let field = self.full("mask_path");
        let named = DataPath { file: self.path, field: &field, value };
        if folders.folder_for_absolute(value).is_none() {
            let missing = || {
                let place = root.path().join(relative(value));
                LoadError::missing_image(self.path, &field, &place)
            };
            return Ok(MaskFile::black_hides(
                root.existing_on_any_system(named)?.ok_or_else(missing)?,
            ));
        }
        // The path is from another machine: its suffixes are looked for in the dataset's folder, then the usual places
        // of masks are searched. The bare file name does not count, as a photograph may have the same name.
        for value in named.suffixes()?.filter(|end| end.contains('/')) {
            if let Some(found) = root.existing(DataPath { value: &value, ..named })? {
                return Ok(MaskFile::black_hides(found));
            }
        }
        folders.mask(image, named)?.ok_or_else(|| {
            let problem = format!("the mask {value:?} is not in the dataset's folder");
            let remedy =
                "put it into `masks/` there, under the photograph's name, or remove the field";
            LoadError::malformed(self.path, &field, problem, remedy)
        })
    }

    fn inherited(&self, field: &str) -> Option<&'a Value> {
        self.own(field).or_else(|| self.top.get(field)).filter(|value| !value.is_null())
    }

    fn number(&self, field: &str) -> Result<Option<f64>, LoadError> {
        let Some(value) = self.inherited(field) else {
            return Ok(None);
        };
        value.as_f64().map(Some).ok_or_else(|| self.fault(field, "it is not a number"))
    }

    fn side(&self, field: &str) -> Result<Option<u32>, LoadError> {
        let Some(value) = self.number(field)? else {
            return Ok(None);
        };
        if value >= 1.0 && value <= f64::from(u32::MAX) && value.fract().abs() < f64::EPSILON {
            return Ok(Some(value as u32));
        }
        Err(self.fault(field, format!("{value} px is not an image size")))
    }

    /// The pose `camera_from_world`, with OpenCV axes.
    fn pose(&self, file: &str) -> Result<(DMat3, DVec3), LoadError> {
        const FIELD: &str = "transform_matrix";
        let shape = || self.fault(FIELD, "it is not a matrix of 3 or 4 rows of 4 numbers");
        let rows = self.own(FIELD).and_then(Value::as_array).ok_or_else(shape)?;
        let mut m = [[0.0; 4]; 3];
        if !(3..=4).contains(&rows.len()) {
            return Err(shape());
        }
        for (row, values) in m.iter_mut().zip(rows) {
            let values = values.as_array().filter(|values| values.len() == 4).ok_or_else(shape)?;
            for (entry, value) in row.iter_mut().zip(values) {
                *entry = value.as_f64().ok_or_else(shape)?;
            }
        }
        // In OpenCV, y and z point the opposite way.
        let column = |j: usize| DVec3::new(m[0][j], m[1][j], m[2][j]);
        let world_from_camera = DMat3::from_cols(column(0), -column(1), -column(2));
        let frame = format!("{} ({file})", self.full(FIELD));
        let (rotation, centre) =
            checked_pose(self.path, &frame, world_from_camera.transpose(), column(3))?;
        Ok((rotation, -(rotation * centre)))
    }

    /// The image size that the intrinsics are for, if the file states it.
    fn size(&self) -> Result<Option<(u32, u32)>, LoadError> {
        Ok(self.side("w")?.zip(self.side("h")?))
    }

    /// The lens at the image size stated in the file. If none is stated, the lens has the size of the image, whose
    /// header is then returned as well.
    fn lens(
        &self,
        image: &Path,
        reduced: Option<u32>,
    ) -> Result<(Lens, Option<ImageHeader>), LoadError> {
        let distortion = self.distortion()?;
        let ((width, height), header) = match self.size()? {
            Some(size) => (size, None),
            None => {
                // Without a stated size, the intrinsics are those of the image at full size.
                let header = images::read_header(image)?;
                let k = reduced.unwrap_or(1);
                ((header.width * k, header.height * k), Some(header))
            }
        };
        let from_angle = |side: u32, angle: f64| 0.5 * f64::from(side) / (0.5 * angle).tan();
        let fx = match (self.number("fl_x")?, self.number("camera_angle_x")?) {
            (Some(fx), _) => fx,
            (None, Some(angle)) => from_angle(width, angle),
            (None, None) => {
                return Err(self.fault("fl_x", "both fl_x and camera_angle_x are missing"));
            }
        };
        let fy = match (self.number("fl_y")?, self.number("camera_angle_y")?) {
            (Some(fy), _) => fy,
            (None, Some(angle)) if self.inherited("fl_x").is_none() => from_angle(height, angle),
            _ => fx,
        };
        let cx = self.number("cx")?.unwrap_or(0.5 * f64::from(width));
        let cy = self.number("cy")?.unwrap_or(0.5 * f64::from(height));
        let (focal, principal) = (DVec2::new(fx, fy), DVec2::new(cx, cy));
        let lens = Lens::new((width, height), focal, principal, distortion);
        check_lens(self.path, &self.full("intrinsics"), &lens)?;
        Ok((lens, header))
    }

    /// The lens model and its coefficients.
    fn distortion(&self) -> Result<Distortion, LoadError> {
        let named = match self.inherited("camera_model") {
            None => None,
            Some(Value::String(model)) => Some(model.as_str()),
            Some(_) => return Err(self.fault("camera_model", "it is not a string")),
        };
        let is_fisheye = named == Some(FISHEYE)
            || self.inherited("is_fisheye").is_some_and(|value| value.as_bool() != Some(false));
        if let Some(model) = named.filter(|model| *model != FISHEYE && !PINHOLES.contains(model)) {
            let supported = format!("{}, {FISHEYE}", PINHOLES.join(", "));
            let field = self.full("camera_model");
            return Err(LoadError::lens_model(self.path, &field, model, &supported));
        }
        let (plane, fields) = if is_fisheye {
            (Projection::Equidistant, &FISHEYE_FIELDS[..])
        } else {
            (Projection::Perspective, &OPENCV_FIELDS[..])
        };
        let mut distortion = Distortion::none(plane);
        for (field, _) in OPENCV_FIELDS {
            let value = self.number(field)?.unwrap_or(0.0);
            match fields.iter().find(|(name, _)| *name == field) {
                Some(&(_, term)) => distortion.set(term, value),
                // nerfstudio writes all fields, with zeros for those that the model does not have.
                None if value == 0.0 => {}
                None => {
                    let problem = format!("{field} = {value}, but a fisheye has only k1 to k4");
                    return Err(LoadError::lens(self.path, &self.full(field), problem));
                }
            }
        }
        Ok(distortion)
    }
}
