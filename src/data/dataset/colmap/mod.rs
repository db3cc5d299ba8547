//! Reads COLMAP sparse models: `images/` beside `sparse/N/{cameras,images,points3D}.{bin,txt}`.
//!
//! The rig and frame files of newer COLMAP versions are ignored, because `images.bin` still contains the poses.

mod bin;
mod camera;
mod split;
mod txt;

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};

use super::depth::add_params;
use super::folders::Folders;
use super::formats::DatasetFormat;
use super::lens::Lens;
use super::mask_files::Listed;
use super::paths::{DataPath, Root, relative};
use super::pose::{checked_pose, checked_quaternion};
use super::prepare::text_notes;
use super::tracks::{TrackSampler, Tracks};
use super::{
    Frame, LoadError, LoadOptions, LoadRemedy, Note, PointCloud, Scene, Split, TrackReading,
    transforms,
};

pub(super) const FORMAT: DatasetFormat = DatasetFormat {
    name: "colmap",
    title: "COLMAP",
    file: "sparse/0/cameras.bin",
    files: "sparse/0/cameras.bin or .txt, also in sparse/, sparse/N/ or colmap/sparse/",
    read,
};

const REMEDY: &str = "export the model again with COLMAP";
/// Remedy for names of images that are not UTF-8.
const RENAME: &str = "rename the image and reconstruct the model again";

/// Largest accepted numbers of images and points.
const MAX_IMAGES: u64 = 1_000_000;
const MAX_POINTS: u64 = 1 << 28;
/// Largest difference between the copies of a pose that two programs wrote: of each entry of the rotation matrix, and
/// of the camera's position, relative to 1 plus its distance from the origin.
const SAME_POSE: f64 = 1e-5;

/// One registered image.
#[derive(Debug)]
struct Image {
    id: u32,
    name: String,
    camera: u32,
    rotation: DMat3,
    translation: DVec3,
}

impl Image {
    fn checked(
        file: &Path,
        id: u32,
        name: String,
        camera: u32,
        q: [f64; 4],
        t: [f64; 3],
    ) -> Result<Self, LoadError> {
        let frame = format!("image {name}");
        let rotation = checked_quaternion(file, &frame, q)?;
        let (rotation, translation) = checked_pose(file, &frame, rotation, t.into())?;
        Ok(Self { id, name, camera, rotation, translation })
    }
}

/// The contents of a model's three files.
#[derive(Debug, Default)]
struct Model {
    cameras: HashMap<u32, Lens>,
    images: Vec<Image>,
    points: PointCloud,
    tracks: Tracks,
}

/// Folders of models, in order of precedence; the second is nerfstudio's.
const PARENTS: [&str; 2] = ["sparse", "colmap/sparse"];

/// Returns true if a folder contains a file of a model.
fn is_model(folder: &Path) -> bool {
    let files = ["cameras.bin", "cameras.txt", "images.bin", "images.txt"];
    files.iter().any(|name| folder.join(name).is_file())
}

/// The folders of a dataset's models, relative to the dataset. COLMAP writes several models, numbered from 0, if it
/// cannot connect all images.
fn models(root: &Path) -> Vec<String> {
    for parent in PARENTS {
        let entries = fs::read_dir(root.join(parent)).into_iter().flatten().flatten();
        let mut names: Vec<String> =
            entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
        names.sort_by_cached_key(|name| (name.parse().unwrap_or(u32::MAX), name.clone()));
        let folders = names.iter().map(|name| format!("{parent}/{name}"));
        let folders = folders.chain([parent.to_owned()]);
        let models: Vec<String> = folders.filter(|folder| is_model(&root.join(folder))).collect();
        // nerfstudio's own file takes precedence over the model that it was made from.
        if !models.is_empty() && (parent == PARENTS[0] || !root.join(transforms::SINGLE).exists()) {
            return models;
        }
    }
    Vec::new()
}

/// The model to read (the user's choice, or the first of those with the most images) and a note about the other models.
#[derive(Debug)]
struct ChosenModel {
    folder: PathBuf,
    /// Folder that the model's files may not leave.
    root: Root,
    others: Option<Note>,
}

/// Chooses the model, if there is one.
fn choose_model(root: &Root, requested: Option<&Path>) -> Result<Option<ChosenModel>, LoadError> {
    let models = models(root.path());
    if let Some(folder) = requested {
        let folder = root.path().join(folder);
        if !is_model(&folder) {
            let existing = if models.is_empty() { "none".to_owned() } else { models.join(", ") };
            let problem = format!(
                "{}: this is not a COLMAP model (the dataset has {existing})",
                folder.display()
            );
            return Err(LoadError::Remedied { problem, remedy: LoadRemedy::ColmapModel });
        }
        return Ok(Some(ChosenModel { root: Root::new(&folder)?, folder, others: None }));
    }
    let several = models.len() > 1;
    // The images of a single model need not be counted, as there is nothing to choose.
    let count = |model: &String| if several { image_count(root, model) } else { Ok(0) };
    let counts = models.iter().map(count).collect::<Result<Vec<u64>, _>>()?;
    let mut counted: Vec<(String, u64)> = models.into_iter().zip(counts).collect();
    let most = counted.iter().map(|(_, count)| *count).max();
    let Some(largest) = counted.iter().position(|(_, count)| Some(*count) == most) else {
        return Ok(None);
    };
    let (model, images) = counted.remove(largest);
    let folder = root.path().join(&model);
    let others = several.then_some(Note::OtherModels { model, images, others: counted });
    Ok(Some(ChosenModel { folder, root: root.clone(), others }))
}

/// Number of images in a model.
fn image_count(root: &Root, model: &str) -> Result<u64, LoadError> {
    let images = file(root, &root.path().join(model), "images")?;
    if !images.is_file() {
        return Ok(0);
    }
    if is_binary(&images) {
        bin::image_count(&images)
    } else {
        Ok(txt::images(&images)?.len() as u64)
    }
}

/// The path of a model's file: the binary file if it exists, otherwise the text file. Links out of `root` are errors.
fn file(root: &Root, folder: &Path, name: &str) -> Result<PathBuf, LoadError> {
    let [binary, text] = ["bin", "txt"].map(|ending| folder.join(format!("{name}.{ending}")));
    // If neither exists, the kind of the model's other files decides which path is returned.
    let others = ["cameras.bin", "images.bin"].map(|name| folder.join(name));
    let is_binary = binary.is_file() || !text.is_file() && others.iter().any(|file| file.is_file());
    let path = if is_binary { binary } else { text };
    let inside = path.strip_prefix(root.path()).unwrap_or(&path).to_string_lossy();
    root.existing(DataPath { file: &path, field: "the file", value: &inside })?;
    Ok(path)
}

fn is_binary(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending == "bin")
}

/// Reads the COLMAP model of a dataset, if there is one.
///
/// # Errors
/// When a file is missing, damaged, or contradicts another.
fn read(root: &Root, options: &LoadOptions) -> Result<Option<Scene>, LoadError> {
    let Some(chosen) = choose_model(root, options.sparse.as_deref())? else { return Ok(None) };
    let folders = Folders::new(root, options, true)?;
    let ([cameras, images, points], model) = model(&chosen, options.tracks)?;
    let names: Vec<String> = model.images.iter().map(|image| image.name.clone()).collect();
    let places = [&folders];
    let photographs = Listed::new(&places, &images, names.iter().map(String::as_str));
    let mut frames = Vec::with_capacity(model.images.len());
    let mut reduced_missing = 0;
    for image in model.images {
        let field = format!("image {}", image.name);
        let Some(lens) = model.cameras.get(&image.camera) else {
            let problem = format!("its camera {} is not in {}", image.camera, cameras.display());
            return Err(LoadError::malformed(&images, field, problem, REMEDY));
        };
        let named = DataPath { file: &images, field: &field, value: &image.name };
        let found = folders.image(named)?.ok_or_else(|| folders.missing(named))?;
        reduced_missing += usize::from(found.fell_back);
        let mask = folders.mask(&found, named, &photographs)?;
        let depth = folders.depth(&found, named);
        frames.push(Frame {
            name: found.name,
            id: Some(image.id),
            origin: format!("{}: {field}", images.display()),
            listed: relative(&image.name),
            image: found.path,
            reduced: found.reduced,
            mask,
            depth,
            lens: *lens,
            header: None,
            rotation: image.rotation,
            translation: image.translation,
            held_out: false,
        });
    }
    let mut notes: Vec<Note> = chosen.others.iter().cloned().collect();
    let (posed, others) = (frames.len(), folders.count_others(&frames));
    if others > 0 {
        let is_one_of_several = chosen.others.is_some() || options.sparse.is_some();
        let folder = chosen.folder.strip_prefix(root.path()).unwrap_or(&chosen.folder);
        let model = match is_one_of_several {
            true => format!("{} has", folder.display()),
            false => "COLMAP has found".to_owned(),
        };
        notes.push(Note::Text(format!(
            "{model} the poses of {posed} of {} images; the others are not used",
            posed + others
        )));
    }
    if reduced_missing > 0 {
        notes.push(Note::Text(folders.fell_back_note(reduced_missing)));
    }
    let mut texts = Vec::new();
    add_params(root, &chosen.folder, &mut frames, &mut texts);
    notes.extend(text_notes(texts));
    let mut own_split = false;
    if options.split == Split::Eval {
        let mut texts = Vec::new();
        own_split = split::apply(root, (&chosen.root, &chosen.folder), &mut frames, &mut texts)?;
        notes.extend(text_notes(texts));
    }
    if !points.is_file() {
        notes.push(Note::Text(format!("{} does not exist: there are no points", points.display())));
    }
    Ok(Some(Scene {
        listing: images,
        frames,
        points: model.points,
        points_file: Some(points),
        tracks: model.tracks,
        own_split,
        notes,
        ..Scene::default()
    }))
}

/// The paths and contents of a model's three files. The points file may be missing.
fn model(
    ChosenModel { folder, root, .. }: &ChosenModel,
    reading: TrackReading,
) -> Result<([PathBuf; 3], Model), LoadError> {
    let path = |name: &str| file(root, folder, name);
    let (cameras, images, points) = (path("cameras")?, path("images")?, path("points3D")?);
    let mut sampler = (reading != TrackReading::Nothing).then(TrackSampler::new);
    let tracks = sampler.as_mut();
    let lenses = if is_binary(&cameras) { bin::cameras } else { txt::cameras }(&cameras)?;
    let posed = if is_binary(&images) { bin::images } else { txt::images }(&images)?;
    let cloud = match points.is_file() {
        false => PointCloud::default(),
        true if is_binary(&points) => bin::points(&points, tracks)?,
        true => txt::points(&points, tracks)?,
    };
    let tracks = match sampler {
        None => Tracks::default(),
        Some(sampler) if reading == TrackReading::Views => sampler.finish(),
        Some(sampler) => with_directions(sampler, &images, &posed, &lenses)?,
    };
    Ok(([cameras, images, points], Model { cameras: lenses, images: posed, points: cloud, tracks }))
}

/// The tracks with the directions in which the photographs show their points.
fn with_directions(
    sampler: TrackSampler,
    images: &Path,
    posed: &[Image],
    lenses: &HashMap<u32, Lens>,
) -> Result<Tracks, LoadError> {
    let by_id: HashMap<u32, &Image> = posed.iter().map(|image| (image.id, image)).collect();
    let read = if is_binary(images) { bin::observations } else { txt::observations };
    sampler.finish_with_directions(|see| {
        read(images, &mut |id, observation, pixel| {
            let image = by_id.get(&id);
            let lens = image.and_then(|image| lenses.get(&image.camera));
            let local = lens.and_then(|lens| lens.unproject(pixel).ok());
            if let Some((image, local)) = image.zip(local) {
                see(id, observation, image.rotation.transpose() * local.normalize());
            }
        })
    })
}

/// Adds the tracks of the COLMAP model in a folder to a scene of another format, if the images listed in both formats
/// have the same poses, as in datasets that `densify scenegen` writes. Otherwise the model is ignored, as it may belong
/// to another scene.
pub(super) fn adopt_tracks(root: &Root, scene: &mut Scene, reading: TrackReading) {
    let Ok(Some(chosen)) = choose_model(root, None) else { return };
    let Ok((_, model)) = model(&chosen, reading) else { return };
    let by_name: HashMap<String, &Image> =
        model.images.iter().map(|image| (relative(&image.name), image)).collect();
    let mut matched = false;
    for frame in &mut scene.frames {
        let path = frame.image.strip_prefix(root.path()).unwrap_or(&frame.image);
        let path = relative(&path.to_string_lossy());
        let inside = path.match_indices('/').map(|(at, _)| &path[at + 1..]);
        let Some(image) = std::iter::once(&*path).chain(inside).find_map(|name| by_name.get(name))
        else {
            continue;
        };
        let centre = |rotation: DMat3, t: DVec3| -(rotation.transpose() * t);
        let frame_at = centre(frame.rotation, frame.translation);
        let image_at = centre(image.rotation, image.translation);
        let moved = frame_at.distance(image_at) > SAME_POSE * (1.0 + image_at.length());
        let same_rotation = frame.rotation.abs_diff_eq(image.rotation, SAME_POSE);
        if moved || !same_rotation {
            return;
        }
        frame.id = Some(image.id);
        matched = true;
    }
    if matched {
        scene.tracks = model.tracks;
    }
}
