//! Built-in scenes as datasets: `scene:spheres` is rendered in memory, or taken from the cache. The images are those that `densify scenegen --preset NAME` writes by default.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use densify_scenegen::{
    Frame, Generated, GroundTruth, InitPoints, Options, PRESETS, Scene, Source, generate,
};

use super::images::{Image8, ImageHeader, ImageSource, SourceFile};
use super::prepare::{assemble, target_size};
use super::scene_cache::Entry;
use super::tracks::TrackSampler;
use super::{Dataset, DatasetError, LoadOptions, PointCloud, View};
use crate::camera::Camera;

/// Prefix of the path of a built-in scene.
pub const PREFIX: &str = "scene:";

/// The name of a built-in scene, if the path is one.
#[must_use]
pub fn name(path: &Path) -> Option<&str> {
    path.to_str()?.strip_prefix(PREFIX)
}

/// Renders a built-in scene, or takes it from the cache.
///
/// # Errors
/// When there is no such scene, or the options leave no view to train on.
pub(super) fn load(
    path: &Path,
    name: &str,
    options: &LoadOptions,
) -> Result<Dataset, DatasetError> {
    let (source, parameters) = (Source::Preset(name.to_owned()), Options::default());
    let is_known = PRESETS.iter().any(|preset| preset.name == name);
    let entry = options.cache.as_deref().filter(|_| is_known);
    let entry = entry.and_then(|folder| Entry::of(folder, name, &parameters));
    if let Some((frames, points)) = entry.as_ref().and_then(Entry::read) {
        let scene = Scene::prepare(&source, &parameters)?;
        // A scene has as many images as views, unless somebody else has made the entry.
        if frames.len() == scene.views.len() {
            return dataset(path, &scene, frames, points, options);
        }
    }
    let Generated { scene, frames, points } = generate(&source, &parameters)?;
    if let Some(entry) = entry {
        entry.write(&frames, &points);
    }
    dataset(path, &scene, frames, points, options)
}

/// The geometry of a built-in scene, as [`load`] renders it.
pub(super) fn ground_truth(name: &str) -> Result<GroundTruth, DatasetError> {
    let scene = Scene::prepare(&Source::Preset(name.to_owned()), &Options::default())?;
    Ok(GroundTruth::of_scene(scene))
}

/// A rendered scene as a dataset named `path`. `frames` are the images of all its views, in order.
///
/// # Errors
/// When the options leave no view to train on.
pub fn dataset(
    path: &Path,
    scene: &Scene,
    frames: Vec<Frame>,
    points: InitPoints,
    options: &LoadOptions,
) -> Result<Dataset, DatasetError> {
    let mut views: Vec<(View, bool, Option<u32>)> = (0..)
        .zip(&scene.views)
        .zip(frames)
        .map(|((number, view), frame)| {
            let camera = camera(&view.camera);
            let held_out = view.split == densify_scenegen::Split::Test;
            (dataset_view(&view.name, camera, frame, options), held_out, Some(number))
        })
        .collect();
    views.sort_by(|a, b| a.0.name.as_bytes().cmp(b.0.name.as_bytes()));
    let mut sampler = TrackSampler::new();
    let found = points.positions.iter().zip(&points.colours);
    for ((&position, &colour), seen_by) in found.zip(&points.seen_by) {
        if options.tracks && sampler.wants(seen_by.len() as u64) {
            sampler.add(position, colour, seen_by.iter().copied());
        }
    }
    let read = super::Scene {
        points: PointCloud { positions: points.positions, colours: points.colours },
        tracks: sampler.finish(),
        own_split: true,
        notes: scene.model.notes.clone(),
        ..super::Scene::default()
    };
    assemble(path, views, read, options)
}

/// The trainer's camera of a rendered view.
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
    let has_alpha = alpha.iter().any(|&a| a < 255);
    let image = Image8 {
        width: frame.width,
        height: frame.height,
        rgb,
        alpha: has_alpha.then_some(alpha),
        mask: None,
    };
    let header = ImageHeader {
        width: frame.width,
        height: frame.height,
        has_alpha,
        decoded_bytes: image.bytes(),
        file_bytes: 0,
    };
    let (width, height) = target_size(&header, options.resolution, false);
    View {
        name: format!("{name}.png"),
        camera: camera.resized(width, height),
        source: ImageSource {
            file: SourceFile::rendered(PathBuf::from(format!("{PREFIX}{name}"))),
            mask: None,
            width,
            height,
            undistortion: None,
            header,
            rendered: Some(Arc::new(image)),
        },
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
