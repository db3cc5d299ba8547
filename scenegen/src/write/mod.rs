//! Writes a scene as files for trainers.
//!
//! Everything is written into a temporary folder next to the target, which is then renamed, so that there is
//! either a complete scene or none. Only one image is held in memory at a time.

mod colmap;
mod exr;
mod npy;
mod ply;
mod record;
mod transforms;

use std::fs;
use std::path::Path;

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};

use crate::error::Error;
use crate::points::InitPoints;
use crate::resource::folder_of;
use crate::scene::{Scene, Split};
use crate::trace::Frame;

pub(crate) use ply::mesh_header;
pub(crate) use record::NAME as SCENE_FILE;

/// A summary of the files written.
#[derive(Debug, Clone, PartialEq)]
pub struct Written {
    /// Number of views.
    pub views: usize,
    /// Number of initial points.
    pub points: usize,
}

/// Renders all views of a scene and writes it to the folder `target`, which must be missing or empty. With
/// `overwrite` it may hold a scene, which is replaced. `progress` is called with the index of each finished view.
///
/// # Errors
/// When the folder holds anything else, or a file cannot be written.
pub fn write(
    scene: &Scene,
    target: &Path,
    overwrite: bool,
    mut progress: impl FnMut(usize),
) -> Result<Written, Error> {
    let replaces = holds_scene(target, overwrite)?;
    let parent = folder_of(target);
    fs::create_dir_all(parent).map_err(Error::write(parent))?;
    let folder_beside = |prefix: &str| {
        tempfile::Builder::new().prefix(prefix).tempdir_in(parent).map_err(Error::write(parent))
    };
    let folder = folder_beside(".densify-scene-")?;
    let root = folder.path();
    let mut collector = scene.point_collector();
    for (number, view) in scene.views.iter().enumerate() {
        let frame = scene.render(number);
        if view.split == Split::Train {
            collector.observe(number, &frame);
        }
        write_frame(root, &view.name, &frame, &scene.written_depth(number, &frame))?;
        if scene.options.passers_by > 0.0 {
            write_mask(root, &view.name, &frame)?;
        }
        progress(number);
    }
    let points = collector.finish();
    write_other_files(scene, root, &points)?;
    make_readable(root)?;
    if replaces {
        let old = folder_beside(".densify-old-")?;
        let aside = old.path().join("scene");
        fs::rename(target, &aside).map_err(Error::write(target))?;
        if let Err(error) = fs::rename(folder.path(), target) {
            if fs::rename(&aside, target).is_err() {
                // Keeps the earlier scene in the temporary folder.
                let _ = old.keep();
            }
            return Err(Error::write(target)(error));
        }
    } else {
        // On some systems an empty folder prevents renaming.
        if target.is_dir() {
            fs::remove_dir(target).map_err(Error::write(target))?;
        }
        fs::rename(folder.path(), target).map_err(Error::write(target))?;
    }
    // The temporary folder has been renamed, so it must not be deleted.
    let _ = folder.keep();
    Ok(Written { views: scene.views.len(), points: points.positions.len() })
}

/// True if the target holds an earlier scene; false if it is empty or missing. An error if the scene must not be
/// overwritten, or if the target holds anything else.
fn holds_scene(target: &Path, overwrite: bool) -> Result<bool, Error> {
    let refuse =
        |problem: &str| Err(Error::option("--output", format!("{} {problem}", target.display())));
    let holds_files = match fs::read_dir(target) {
        Ok(mut entries) => entries.next().is_some(),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => false,
        Err(error) => return Err(Error::write(target)(error)),
    };
    if !holds_files {
        return Ok(false);
    }
    match (target.join(record::NAME).is_file(), overwrite) {
        (true, true) => Ok(true),
        (true, false) => refuse("holds a scene; add --overwrite to replace it"),
        (false, _) => refuse("is not empty and holds no scene.json; choose another folder"),
    }
}

/// Checks before rendering that [`write()`] can use a folder.
///
/// # Errors
/// When the folder holds a scene and `overwrite` is false, or holds anything else.
pub fn check_target(target: &Path, overwrite: bool) -> Result<(), Error> {
    holds_scene(target, overwrite).map(|_| ())
}

/// Gives the folder the permissions of its subfolders, as only their owner can access temporary folders.
fn make_readable(folder: &Path) -> Result<(), Error> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let subfolder = folder.join("sparse");
        let mode = fs::metadata(&subfolder).map_err(Error::write(&subfolder))?.permissions().mode();
        let permissions = fs::Permissions::from_mode(mode);
        fs::set_permissions(folder, permissions).map_err(Error::write(folder))?;
    }
    let _ = folder;
    Ok(())
}

/// Writes the files of a view; `depth` is the one for trainers.
fn write_frame(root: &Path, name: &str, frame: &Frame, depth: &[f32]) -> Result<(), Error> {
    let path = root.join("images").join(format!("{name}.png"));
    write_png(&path, frame.width, frame.height, frame.photograph(), ExtendedColorType::Rgba8)?;
    exr::write_depth(&root.join("depth").join(format!("{name}.exr")), frame)?;
    let size = (frame.width, frame.height);
    npy::write_depth(&root.join("depth").join(format!("{name}.npy")), size, depth)?;
    exr::write_normals(&root.join("normals").join(format!("{name}.exr")), frame)
}

/// Writes the mask of a view; all white without passers-by, as nerfstudio needs masks for all views or none.
fn write_mask(root: &Path, name: &str, frame: &Frame) -> Result<(), Error> {
    let path = root.join(mask_path(name));
    let white = || vec![255; frame.depth.len()];
    let mask = frame.mask.clone().unwrap_or_else(white);
    write_png(&path, frame.width, frame.height, &mask, ExtendedColorType::L8)
}

/// The file of a view's mask.
fn mask_path(name: &str) -> String {
    format!("masks/{name}.png")
}

fn write_other_files(scene: &Scene, root: &Path, points: &InitPoints) -> Result<(), Error> {
    transforms::write(scene, root)?;
    colmap::write(scene, root, points)?;
    ply::write_points(&root.join("points3d.ply"), points)?;
    ply::write_mesh(&root.join("mesh.ply"), scene)?;
    record::write(scene, root, points)
}

fn write_png(
    path: &Path,
    width: u32,
    height: u32,
    pixels: &[u8],
    colours: ExtendedColorType,
) -> Result<(), Error> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(pixels, width, height, colours)
        .map_err(|error| Error::write(path)(std::io::Error::other(error)))?;
    write_file(path, &bytes)
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).map_err(Error::write(parent))?;
    }
    fs::write(path, bytes).map_err(Error::write(path))
}

/// Renders eight evenly spaced training views over light grey into one image: width, height and RGBA pixels.
pub fn contact_sheet(scene: &Scene) -> (u32, u32, Vec<u8>) {
    const COLUMNS: usize = 4;
    const GREY: f32 = 224.0;
    let train = scene.views.iter().filter(|view| view.split == Split::Train).count();
    let (width, height) = (scene.rig.width as usize, scene.rig.height as usize);
    let mut sheet = vec![255_u8; 4 * COLUMNS * width * 2 * height];
    for place in 0..2 * COLUMNS {
        let frame = scene.render((place * train / (2 * COLUMNS)).min(train - 1));
        let (left, top) = (place % COLUMNS * width, place / COLUMNS * height);
        for (i, pixel) in frame.photograph().chunks_exact(4).enumerate() {
            let at = 4 * ((top + i / width) * COLUMNS * width + left + i % width);
            let alpha = f32::from(pixel[3]) / 255.0;
            for channel in 0..3 {
                let value = alpha * f32::from(pixel[channel]) + (1.0 - alpha) * GREY;
                sheet[at + channel] = (value + 0.5) as u8;
            }
        }
    }
    ((COLUMNS * width) as u32, 2 * height as u32, sheet)
}

#[cfg(test)]
mod tests;
