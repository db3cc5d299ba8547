//! Reads COLMAP sparse models: `images/` beside `sparse/0/{cameras,images,points3D}.{bin,txt}`.
//!
//! Rigs and frames of newer COLMAP versions are ignored, because `images.bin` still contains the poses.

mod bin;
mod camera;
mod txt;

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};

use super::folders::Folders;
use super::formats::DatasetFormat;
use super::lens::Lens;
use super::paths::{DataPath, Root, relative};
use super::pose::{checked_pose, checked_quaternion};
use super::tracks::{TrackSampler, Tracks};
use super::{Frame, LoadError, LoadOptions, PointCloud, Scene};

pub(super) const FORMAT: DatasetFormat = DatasetFormat {
    name: "colmap",
    title: "COLMAP",
    file: "sparse/0/cameras.bin",
    files: "sparse/0/cameras.bin or .txt, or sparse/cameras.bin or .txt",
    read,
};

const REMEDY: &str = "export the model again with COLMAP";
/// Remedy for names of images that are not UTF-8.
const RENAME: &str = "rename the image and reconstruct the model again";

/// Largest accepted numbers of images and points.
const MAX_IMAGES: u64 = 1_000_000;
const MAX_POINTS: u64 = 1 << 28;
/// Largest difference between two copies of one pose that different programs wrote.
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

/// The folder of the model, if there is one: `sparse/0`, else `sparse`.
fn find(root: &Path) -> Option<PathBuf> {
    ["sparse/0", "sparse"].iter().map(|folder| root.join(folder)).find(|folder| {
        ["cameras.bin", "cameras.txt", "images.bin", "images.txt"]
            .iter()
            .any(|name| folder.join(name).is_file())
    })
}

/// Reads the model in a folder, if there is one.
///
/// # Errors
/// When a file is missing, damaged, or contradicts another.
fn read(root: &Root, options: &LoadOptions) -> Result<Option<Scene>, LoadError> {
    let Some(folder) = find(root.path()) else { return Ok(None) };
    let folders = Folders::new(root, options, true)?;
    let ([cameras, images, points], model) = model(root, &folder, options.tracks)?;
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
        let mask = folders.mask(&found, named)?;
        frames.push(Frame {
            name: found.name,
            id: Some(image.id),
            origin: format!("{}: {field}", images.display()),
            listed: relative(&image.name),
            image: found.path,
            reduced: found.reduced,
            mask,
            lens: *lens,
            header: None,
            rotation: image.rotation,
            translation: image.translation,
            held_out: false,
        });
    }
    let mut notes = Vec::new();
    let (posed, there) = (frames.len(), folders.count());
    if posed < there {
        notes.push(format!(
            "COLMAP has found the poses of {posed} of {there} images; the others are not used"
        ));
    }
    if reduced_missing > 0 {
        notes.push(folders.fell_back_note(reduced_missing));
    }
    Ok(Some(Scene {
        listing: images,
        frames,
        points: model.points,
        points_file: Some(points),
        tracks: model.tracks,
        notes,
        ..Scene::default()
    }))
}

/// The paths and contents of a model's three files.
fn model(
    root: &Root,
    folder: &Path,
    with_tracks: bool,
) -> Result<([PathBuf; 3], Model), LoadError> {
    let binary = ["cameras.bin", "images.bin"].iter().any(|name| folder.join(name).is_file());
    let ending = if binary { "bin" } else { "txt" };
    let file = |name: &str| folder.join(format!("{name}.{ending}"));
    let (cameras, images, points) = (file("cameras"), file("images"), file("points3D"));
    // These files may not be links out of the dataset either.
    for path in [&cameras, &images, &points] {
        let inside = path.strip_prefix(root.path()).unwrap_or(path).to_string_lossy();
        root.existing(DataPath { file: path, field: "the file", value: &inside })?;
    }
    let mut sampler = with_tracks.then(TrackSampler::new);
    let tracks = sampler.as_mut();
    let (lenses, posed, cloud) = if binary {
        (bin::cameras(&cameras)?, bin::images(&images)?, bin::points(&points, tracks)?)
    } else {
        (txt::cameras(&cameras)?, txt::images(&images)?, txt::points(&points, tracks)?)
    };
    let tracks = sampler.map(TrackSampler::finish).unwrap_or_default();
    Ok(([cameras, images, points], Model { cameras: lenses, images: posed, points: cloud, tracks }))
}

/// Adds the tracks of the COLMAP model in a folder to a scene of another format, if the images that both list have the
/// same poses, as `densify scenegen` writes them. Otherwise the model is ignored, as it may belong to another scene.
pub(super) fn adopt_tracks(root: &Root, scene: &mut Scene) {
    let Some(folder) = find(root.path()) else { return };
    let Ok((_, model)) = model(root, &folder, true) else { return };
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
        let here = centre(frame.rotation, frame.translation);
        let there = centre(image.rotation, image.translation);
        let moved = here.distance(there) > SAME_POSE * (1.0 + there.length());
        let turned = frame.rotation.abs_diff_eq(image.rotation, SAME_POSE);
        if moved || !turned {
            return;
        }
        frame.id = Some(image.id);
        matched = true;
    }
    if matched {
        scene.tracks = model.tracks;
    }
}
