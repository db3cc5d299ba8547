//! Renders built-in scenes in memory, or reads them from the cache.

mod scene_cache;

use std::path::Path;

pub use densify_scenegen::GroundTruth;
use densify_scenegen::{
    Frame, InitPoints, Options, PresetSpec, Scene, Source, Split, View as RenderedView,
};
use serde::{Deserialize, Serialize};

use super::PREFIX;
use crate::dataset::depth::{DepthChoice, DepthSource};
use crate::dataset::images::ImageSource;
use crate::dataset::photographs::{Photograph, target_size};
use crate::dataset::prepare::{assemble, text_notes};
use crate::dataset::tracks::TrackSampler;
use crate::dataset::{self, Dataset, LoadError, LoadOptions, PointCloud, TrackReading, View};
use densify_core::camera::Camera;
use densify_core::image::Image8;
use scene_cache::Entry;
pub use scene_cache::{cache_folder, set_program_file};

/// Upper bound on the memory for building a surface's search tree, as a multiple of the size of the surface or its
/// file: a triangle takes 86 bytes in the file, up to 200 while the tree is built, and 100 afterwards.
const BUILD_FACTOR: u64 = 4;

/// A rendered built-in scene.
#[derive(Debug, PartialEq)]
struct Rendered {
    summary: Summary,
    /// The images of all views, in the order of `summary.views`.
    frames: Vec<Frame>,
    points: InitPoints,
}

/// Views and notes of a scene, which the cache holds in addition to images and points.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Summary {
    views: Vec<RenderedView>,
    notes: Vec<String>,
    /// As [`Dataset::surface_bytes`].
    surface_bytes: u64,
}

/// Renders a built-in scene, or reads it from the cache.
///
/// # Errors
/// When there is no such scene, or the options leave no view to train on.
pub(in crate::dataset) fn load(
    path: &Path,
    name: &str,
    options: &LoadOptions,
) -> Result<Dataset, LoadError> {
    let (source, parameters) = (Source::Preset(name.to_owned()), Options::default());
    // The name is checked before it becomes part of a file name.
    let preset: PresetSpec = name.parse()?;
    let entry = options.cache.as_deref();
    let entry = entry.and_then(|folder| Entry::new(folder, &preset.to_string(), &parameters));
    let hit = entry.as_ref().and_then(Entry::read);
    // Another program may have written an entry in which images are missing.
    if let Some(hit) = hit.filter(|hit| hit.frames.len() == hit.summary.views.len()) {
        let truth = if options.depth.choice == DepthChoice::On && options.depth.points.is_none() {
            Some(GroundTruth::of_scene(Scene::prepare(&source, &parameters)?))
        } else {
            None
        };
        return dataset(path, hit, truth.as_ref(), options);
    }
    let scene = Scene::prepare(&source, &parameters)?;
    let (frames, points) = render(&scene);
    let surface_bytes = BUILD_FACTOR * scene.surface.bytes() as u64;
    let (views, notes) = (scene.views.clone(), scene.model.notes.clone());
    let truth = (options.depth.choice == DepthChoice::On && options.depth.points.is_none())
        .then(|| GroundTruth::of_scene(scene));
    let rendered = Rendered { summary: Summary { views, notes, surface_bytes }, frames, points };
    if let Some(entry) = entry {
        entry.write(&rendered);
    }
    dataset(path, rendered, truth.as_ref(), options)
}

/// Renders all views and collects points. Depths, normals and triangles are then dropped, as nothing else needs them.
fn render(scene: &Scene) -> (Vec<Frame>, InitPoints) {
    let mut collector = scene.point_collector();
    let mut frames = Vec::with_capacity(scene.views.len());
    for (i, view) in scene.views.iter().enumerate() {
        let frame = scene.render(i);
        if view.split == Split::Train {
            collector.observe(i, &frame);
        }
        let (depth, normals, triangles) = (Vec::new(), Vec::new(), Vec::new());
        frames.push(Frame { depth, normals, triangles, ..frame });
    }
    let points = collector.finish();
    (frames, points)
}

impl Dataset {
    /// The surface that the images were rendered from, in the dataset's own coordinates. It is known for
    /// built-in scenes and for folders written by `densify scenegen`.
    ///
    /// # Errors
    /// When the surface exists but cannot be read.
    pub fn ground_truth(&self) -> Result<Option<GroundTruth>, LoadError> {
        if let Some(unpacked) = &self.unpacked {
            let surface = GroundTruth::open(unpacked.folder());
            return surface
                .map_err(|error| LoadError::Data(unpacked.with_archive_name(&error.to_string())));
        }
        let Some(name) = super::name(&self.root) else { return Ok(GroundTruth::open(&self.root)?) };
        let scene = Scene::prepare(&Source::Preset(name.to_owned()), &Options::default())?;
        Ok(Some(GroundTruth::of_scene(scene)))
    }
}

/// Peak memory for reading the surface in a folder `[bytes]`; `None` if there is none.
pub(in crate::dataset) fn surface_bytes(root: &Path) -> Option<u64> {
    let mesh = std::fs::metadata(root.join("mesh.ply"));
    GroundTruth::is_in(root).then(|| BUILD_FACTOR * mesh.map_or(0, |mesh| mesh.len()))
}

impl From<densify_scenegen::Error> for LoadError {
    fn from(error: densify_scenegen::Error) -> Self {
        Self::Data(error.to_string())
    }
}

/// Turns a rendered scene into the dataset named `path`; its training views have the depth of `truth`, if it is given.
///
/// # Errors
/// When the options leave no view to train on.
fn dataset(
    path: &Path,
    Rendered { summary, frames, points }: Rendered,
    truth: Option<&GroundTruth>,
    options: &LoadOptions,
) -> Result<Dataset, LoadError> {
    let mut photographs: Vec<Photograph> = (0..)
        .zip(&summary.views)
        .zip(frames)
        .map(|((number, view), frame)| {
            let camera = camera(&view.camera);
            let held_out = view.split == Split::Test;
            let mut shown = dataset_view(&view.name, camera, frame, options);
            if let Some(truth) = truth.filter(|_| !held_out) {
                let seen = truth.g_buffer(&view.name, &view.camera)?;
                let source = DepthSource::rendered((seen.width, seen.height), seen.depth);
                shown.source.depth = source.map(Box::new);
            }
            let (views, hidden) = (vec![shown], Vec::new());
            Ok(Photograph { views, hidden, held_out, id: Some(number), depth_fault: None })
        })
        .collect::<Result<_, LoadError>>()?;
    let name = |photograph: &Photograph| photograph.views[0].name.clone();
    photographs.sort_by_cached_key(name);
    let mut sampler = TrackSampler::new();
    let mut found_at = Vec::new();
    let coloured = points.positions.iter().zip(&points.colours).zip(&points.found_at);
    for (((&position, &colour), &at), seen_by) in coloured.zip(&points.seen_by) {
        if options.tracks != TrackReading::Nothing && sampler.wants(seen_by.len() as u64) {
            let number = found_at.len() as u32;
            sampler.add(position, colour, seen_by.iter().map(|&view| (view, number)));
            found_at.push((at, seen_by));
        }
    }
    let tracks = if options.tracks == TrackReading::Directions {
        sampler.finish_with_directions(|see| {
            for (number, (at, seen_by)) in (0..).zip(&found_at) {
                for &view in *seen_by {
                    let centre = summary.views[view as usize].camera.centre;
                    see(view, number, (*at - centre).normalize());
                }
            }
            Ok::<_, LoadError>(())
        })?
    } else {
        sampler.finish()
    };
    let read = dataset::Scene {
        points: PointCloud { positions: points.positions, colours: points.colours },
        tracks,
        own_split: true,
        surface_bytes: Some(summary.surface_bytes),
        ..dataset::Scene::default()
    };
    assemble(path, photographs, read, text_notes(summary.notes), options)
}

/// Converts the camera of a rendered view.
fn camera(from: &densify_scenegen::Camera) -> Camera {
    let rotation = from.world_from_camera.transpose();
    Camera {
        width: from.width,
        height: from.height,
        fx: from.fx,
        fy: from.fy,
        cx: from.cx,
        cy: from.cy,
        rotation,
        translation: -(rotation * from.centre),
    }
}

fn dataset_view(name: &str, camera: Camera, frame: Frame, options: &LoadOptions) -> View {
    let pixels = frame.rgba.chunks_exact(4);
    let rgb = pixels.clone().flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    let alpha: Vec<u8> = pixels.map(|pixel| pixel[3]).collect();
    let alpha = alpha.iter().any(|&a| a < 255).then_some(alpha);
    let (width, height) = (frame.width, frame.height);
    let image = Image8 { width, height, rgb, alpha, mask: None };
    let (width, height) = target_size((width, height), width, options.resolution, false);
    View {
        name: format!("{name}.png"),
        camera: camera.resized(width, height),
        source: ImageSource::rendered(format!("{PREFIX}{name}").into(), image, (width, height)),
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3};

    use super::*;

    #[test]
    fn pixels_and_rays_agree_with_the_trainers_projection() {
        let turned = densify_scenegen::Camera::looking(
            DVec3::new(3.0, -2.0, 5.5),
            DVec3::new(0.1, 0.4, -0.3),
            DVec3::new(0.1, 1.0, 0.2),
            0.9,
            (1920, 1080),
        );
        let shifted =
            densify_scenegen::Camera { cx: 900.5, cy: 500.25, fy: turned.fx * 1.1, ..turned };
        for from in [turned, shifted] {
            let camera = camera(&from);
            for (x, y, depth) in
                [(0.5, 0.5, 0.01), (1919.5, 3.5, 1.0), (7.25, 1079.9, 1e4), (960.0, 540.0, 7.0)]
            {
                let world = from.centre + depth * from.direction(DVec2::new(x, y));
                let (pixel, z) = camera.project(world);
                assert!((pixel - DVec2::new(x, y)).length() < 1e-4, "{pixel} for {x}, {y}");
                assert!((z / depth - 1.0).abs() < 1e-9, "{z} for {depth}");
            }
        }
    }
}
