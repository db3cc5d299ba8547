//! Reads `transforms.json` (nerfstudio, instant-ngp) and `transforms_{train,test}.json`
//! (NeRF-synthetic).
//!
//! Poses are `world_from_camera` with OpenGL axes (x right, y up, looking along −z). Intrinsics are
//! at the top level or in the frame; those in the frame take precedence.
//! This module reads both formats, because their frames have the same fields.

mod fields;
mod lens;
mod listing;
mod matrix;
mod named_files;
mod not_honoured;

use std::collections::HashSet;
use std::path::PathBuf;

use serde_json::Value;

use super::folders::Folders;
use super::formats::DatasetFormat;
use super::frame_lists::FrameLists;
use super::json;
use super::mask_files::Listed;
use super::paths::{DataPath, Root, existing_namesake, relative};
use super::prepare::text_notes;
use super::{Frame, LoadError, LoadOptions, Note, Scene, Split, TrackReading, colmap};
use fields::Fields;
use named_files::points_file;
pub(super) use named_files::usual_points;

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

const REMEDY: &str = "correct the file or export it again";

/// Reads `transforms_train.json` and `transforms_test.json`, with the tracks of a COLMAP model of the same scene.
fn read_pair(root: &Root, options: &LoadOptions) -> Result<Option<Scene>, LoadError> {
    if !PAIR.iter().all(|name| root.path().join(name).is_file()) {
        return Ok(None);
    }
    let folders = Folders::new(root, options, false)?;
    // A photograph of one file is no mask of one in the other.
    let names: Vec<String> = PAIR.iter().flat_map(|name| photographs(root, name)).collect();
    let mut scene = read(root, &folders, (PAIR[0], &names), DeclaredSplit::Train)?;
    let test = read(root, &folders, (PAIR[1], &names), DeclaredSplit::Test)?;
    scene.frames.extend(test.frames);
    scene.notes.extend(test.notes);
    scene.own_split = true;
    if options.tracks != TrackReading::Nothing {
        colmap::adopt_tracks(root, &mut scene, options.tracks);
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
    read(root, &Folders::new(root, options, false)?, (SINGLE, &[]), declared).map(Some)
}

/// The photographs that a file lists. Faults are found where it is [`read`].
fn photographs(root: &Root, name: &str) -> Vec<String> {
    let path = root.path().join(name);
    let is_inside = root.existing(DataPath { file: &path, field: "the file", value: name }).is_ok();
    let read = is_inside.then(|| json::read(&path).ok()).flatten().unwrap_or_default();
    let frames = read.get("frames").and_then(Value::as_array).into_iter().flatten();
    let names = frames.filter_map(|frame| frame.get("file_path")?.as_str().map(str::to_owned));
    names.collect()
}

/// The source of the division of a file's frames into those for training and those for tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum DeclaredSplit {
    /// All are for training.
    Train,
    /// All are for tests.
    Test,
    /// The [lists](FrameLists) in the file, or its `test_frames`.
    InLists,
}

/// Reads the file `name`. `others` are photographs besides those that it lists.
fn read(
    root: &Root,
    folders: &Folders,
    (name, others): (&str, &[String]),
    declared: DeclaredSplit,
) -> Result<Scene, LoadError> {
    let path = root.path().join(name);
    root.existing(DataPath { file: &path, field: "the file", value: name })?;
    let Value::Object(top) = json::read(&path)? else {
        return Err(LoadError::malformed(&path, "the file", "it is not a JSON object", REMEDY));
    };
    let top = Fields { path: &path, place: String::new(), frame: None, top: &top };
    let listed = top.frames(declared)?;
    let mut lists = FrameLists::default();
    if declared == DeclaredSplit::InLists {
        top.frame_lists(folders, &mut lists)?;
    }
    let names = listed.iter().filter_map(|(fields, _)| fields.text("file_path").ok().flatten());
    let places = [folders];
    let names = names.chain(others.iter().map(String::as_str));
    let photographs = Listed::new(&places, &path, names);
    let (mut frames, mut missing, mut fell_back) = (Vec::new(), Vec::new(), 0);
    let (mut first_missing, mut bad) = (None, Vec::new());
    for (fields, split) in &listed {
        fields.check_honoured()?;
        let Some(file) = fields.text("file_path")? else {
            return Err(fields.fault("file_path", "it is missing"));
        };
        let field = fields.full("file_path");
        let named = DataPath { file: &path, field: &field, value: file };
        let found = folders.image(named)?;
        let (trained, tested) = match split {
            DeclaredSplit::Train => (true, false),
            DeclaredSplit::Test => (false, true),
            DeclaredSplit::InLists => lists.splits(file, found.as_ref()),
        };
        if fields.flag("is_bad")? {
            bad.push(file);
            continue;
        }
        let Some(found) = found else {
            first_missing.get_or_insert_with(|| folders.shown_path(named));
            missing.push(file.to_owned());
            continue;
        };
        fell_back += usize::from(found.fell_back);
        let (rotation, translation) = fields.pose(file)?;
        let mask = match fields.text("mask_path")? {
            Some(value) => Some(fields.mask((root, folders, &photographs), &found, value)?),
            None => folders.mask(&found, named, &photographs)?,
        };
        let depth = fields.depth((root, folders), &found, named);
        let (lens, header) = fields.lens(&found.path, found.reduced)?;
        let frame = Frame {
            name: found.name,
            id: None,
            origin: format!("{}: frame {file}", path.display()),
            listed: relative(file),
            image: found.path,
            reduced: found.reduced,
            mask,
            depth,
            lens,
            header,
            rotation,
            translation,
            held_out: tested,
        };
        frames.extend((trained && tested).then(|| Frame { held_out: false, ..frame.clone() }));
        frames.extend((trained || tested).then_some(frame));
    }
    if frames.is_empty() && bad.len() == listed.len() && !bad.is_empty() {
        return Err(top.fault("is_bad", "it marks all frames"));
    }
    if let Some((field, problem)) = lists.fault() {
        return Err(top.fault(field, problem));
    }
    let lists_tests = listed.iter().any(|(_, split)| *split != declared);
    if lists_tests {
        refuse_shared_images(&top, &frames)?;
    }
    let mut notes = lists.notes(name);
    notes.extend(top.notes(&listed)?);
    let missing = missing.first().zip(first_missing.as_deref()).map(|(first, path)| {
        let (count, all, other) = (missing.len(), listed.len(), existing_namesake(path));
        format!("{name}: {count} of {all} frames have no image file and are skipped ({first} is the first{other})")
    });
    notes.extend(missing);
    notes.extend(bad_note(name, &bad, listed.len()));
    if fell_back > 0 {
        notes.push(folders.fell_back_note(fell_back));
    }
    let points_file = points_file((root, folders), &top, declared, &mut notes)?;
    let (own_split, listing) = (lists.define_the_split() || lists_tests, path.clone());
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

/// Says how many of `all` frames are left out because the file marks them as bad, if any are.
fn bad_note(name: &str, bad: &[&str], all: usize) -> Option<String> {
    let (first, count) = (bad.first()?, bad.len());
    Some(format!(
        "{name}: {count} of {all} frames are marked is_bad and are left out (first: {first})"
    ))
}

/// Refuses an image that is both trained on and tested on.
fn refuse_shared_images(top: &Fields<'_>, frames: &[Frame]) -> Result<(), LoadError> {
    let trained = frames.iter().filter(|frame| !frame.held_out);
    let trained: HashSet<&PathBuf> = trained.map(|frame| &frame.image).collect();
    let shared = frames.iter().find(|frame| frame.held_out && trained.contains(&frame.image));
    shared.map_or(Ok(()), |frame| {
        Err(top.fault("test_frames", format!("{} is in `frames`, too", frame.listed)))
    })
}
