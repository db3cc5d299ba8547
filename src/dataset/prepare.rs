//! Turns the frames of any format into views: checks sizes and lenses, splits, normalises.

use std::collections::HashMap;
use std::path::Path;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::error::DatasetError;
use super::images::{self, ImageHeader, ImageSource, SourceFile};
use super::normalise::{self, Normalisation};
use super::pose::POSE_REMEDY;
use super::{Dataset, FarCameras, Frame, LoadOptions, PointCloud, Resolution, Scene, Split, View};
use crate::camera::Camera;

/// Fraction of the points that may be unusable.
const MAX_BAD_POINTS: f64 = 0.01;

/// Checks every frame of a format's reader, splits, and moves all into normalised coordinates.
pub(super) fn prepare(
    path: &Path,
    mut scene: Scene,
    options: &LoadOptions,
) -> Result<Dataset, DatasetError> {
    let mut frames = std::mem::take(&mut scene.frames);
    // Bytewise, as other trainers sort names for their test splits.
    frames.sort_by(|a, b| (a.name.as_bytes(), a.held_out).cmp(&(b.name.as_bytes(), b.held_out)));
    refuse_duplicates(&scene.listing, &frames)?;
    // All views first, then the first error: the message does not depend on the threads.
    let views: Vec<Result<View, DatasetError>> =
        frames.par_iter().map(|frame| view(&scene.listing, frame, options.resolution)).collect();
    let views: Vec<View> = views.into_iter().collect::<Result<_, _>>()?;
    if let (Some(Resolution::Width(width)), Some(first)) = (options.resolution, views.first())
        && views.iter().any(|view| view.source.header.width < width)
    {
        let first = &first.name;
        scene.notes.push(format!("images narrower than {width} px are not enlarged ({first})"));
    }
    let views = views.into_iter().zip(&frames);
    let views = views.map(|(view, frame)| (view, frame.held_out, frame.id));
    assemble(path, views.collect(), scene, options)
}

/// Splits views, which are sorted by name, and moves all into normalised coordinates. Each view comes with
/// whether the dataset holds it out, and with the id that tracks use.
pub(super) fn assemble(
    path: &Path,
    views: Vec<(View, bool, Option<u32>)>,
    scene: Scene,
    options: &LoadOptions,
) -> Result<Dataset, DatasetError> {
    let Scene {
        listing, mut points, points_file, tracks, own_split, surface_bytes, mut notes, ..
    } = scene;
    let surface_bytes = surface_bytes.or_else(|| super::builtin::surface_bytes(path));
    let centres: Vec<_> = views.iter().map(|(view, ..)| view.camera.centre()).collect();
    let is_far = normalise::far(&centres);
    let far = views.iter().zip(&is_far).filter(|(_, is_far)| **is_far);
    let far: Vec<&str> = far.map(|((view, ..), _)| &*view.name).collect();
    notes.extend(far_note(&far, options.far_cameras));
    #[cfg(not(feature = "scenegen"))]
    notes.extend(super::builtin::left_out(path));
    let every = match options.split {
        Split::Every(every) => Some(every.get() as usize),
        Split::Eval if !own_split => Some(Split::EVAL_EVERY as usize),
        Split::None | Split::Eval => None,
    };
    // Number of a training view by the id that tracks use.
    let mut number_of = HashMap::new();
    let (mut train, mut test) = (Vec::<View>::new(), Vec::new());
    // Centres of the training cameras that are not far from all others.
    let mut near = Vec::new();
    for (index, (view, held_out, id)) in views.into_iter().enumerate() {
        // It keeps its place in the order: the others are split as without it.
        if is_far[index] && options.far_cameras == FarCameras::LeaveOut {
            continue;
        }
        if every.map_or(held_out, |every| index % every == 0) {
            test.push(view);
        } else {
            number_of.extend(id.map(|id| (id, train.len() as u32)));
            near.extend((!is_far[index]).then(|| centres[index]));
            train.push(view);
        }
    }
    if train.is_empty() {
        return Err(DatasetError(format!(
            "no view is left to train on: the test split takes all {}; use a larger --test-every, or leave it \
             out",
            test.len()
        )));
    }
    let points_path = points_file.as_deref().unwrap_or(path);
    drop_bad(points_path, &mut points, &mut notes, "finite", DVec3::is_finite)?;
    let normalisation = Normalisation::fit(&near, &points.positions);
    for view in train.iter_mut().chain(&mut test) {
        view.camera = normalisation.scene_from_world_camera(&view.camera);
        if !view.camera.translation.as_vec3().is_finite() {
            let problem = "the camera is too far from the others";
            return Err(DatasetError::malformed(&listing, &view.name, problem, POSE_REMEDY));
        }
    }
    for position in &mut points.positions {
        *position = normalisation.scene_from_world(*position);
    }
    drop_bad(points_path, &mut points, &mut notes, "within reach of f32", |p| {
        p.as_vec3().is_finite()
    })?;
    let tracks = tracks.in_training_views(&normalisation, |id| number_of.get(&id).copied());
    let root = path.to_owned();
    Ok(Dataset { root, train, test, points, tracks, normalisation, surface_bytes, notes })
}

/// Names the views whose camera is far from all others.
fn far_note(names: &[&str], what: FarCameras) -> Option<String> {
    const SHOWN: usize = 5;
    let more = names.len().saturating_sub(SHOWN);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    let shown = names.get(..SHOWN).unwrap_or(names).join(", ");
    let fate = match what {
        FarCameras::LeaveOut => "left out (use --far-cameras keep to train on them)",
        FarCameras::Keep => "kept, but not counted for the extent of the scene",
    };
    (!names.is_empty())
        .then(|| format!("cameras far from all others, {} {fate}: {shown}{more}", names.len()))
}

fn refuse_duplicates(listing: &Path, frames: &[Frame]) -> Result<(), DatasetError> {
    for pair in frames.windows(2) {
        if pair[0].name == pair[1].name && pair[0].held_out == pair[1].held_out {
            let (problem, remedy) = ("the image is listed twice", "remove one of the two");
            return Err(DatasetError::malformed(listing, &pair[0].name, problem, remedy));
        }
    }
    Ok(())
}

fn drop_bad(
    path: &Path,
    points: &mut PointCloud,
    notes: &mut Vec<String>,
    what: &str,
    keep: impl Fn(DVec3) -> bool,
) -> Result<(), DatasetError> {
    let total = points.len();
    let bad = points.retain(keep);
    if bad as f64 > MAX_BAD_POINTS * total as f64 {
        let path = path.display();
        return Err(DatasetError(format!(
            "{path}: {bad} of {total} points are not finite, more than 1 %; repair the reconstruction"
        )));
    }
    if bad > 0 {
        notes.push(format!(
            "{}: {bad} of {total} points are not {what} and are dropped",
            path.display()
        ));
    }
    Ok(())
}

/// Checks an image's header against its camera and plans how it will be loaded.
fn view(
    listing: &Path,
    frame: &Frame,
    resolution: Option<Resolution>,
) -> Result<View, DatasetError> {
    let header = images::probe(&frame.image)?;
    let lens = &frame.lens;
    let size = (header.width, header.height);
    let k = frame.reduced.unwrap_or(1);
    let expected = (divided(lens.width, k), divided(lens.height, k));
    let fits = match frame.reduced {
        Some(_) => size.0.abs_diff(expected.0) <= 1 && size.1.abs_diff(expected.1) <= 1,
        None => proportional(size, (lens.width, lens.height)),
    };
    if !fits {
        return Err(DatasetError::size(&frame.image, size, expected));
    }
    if let Some(mask) = &frame.mask {
        let found = images::probe(mask)?;
        let found = (found.width, found.height);
        if !proportional(found, size) {
            return Err(DatasetError::size(mask, found, size));
        }
    }
    let lens = lens.resized(header.width, header.height);
    // Cut-outs of a photograph have it outside, but hardly by more than their own size.
    let extent = DVec2::new(f64::from(header.width), f64::from(header.height));
    if !(lens.principal.cmpge(-extent) & lens.principal.cmple(2.0 * extent)).all() {
        let DVec2 { x, y } = lens.principal;
        let problem = format!("the principal point ({x}, {y}) px is far outside the image");
        let remedy = "repair the camera or remove the frame";
        return Err(DatasetError::malformed(listing, &frame.name, problem, remedy));
    }
    let undistortion = if lens.is_distorted() {
        Some(lens.undistortion().map_err(|problem| {
            let problem = format!("{problem} (k1, k2, p1, p2 = {:?})", lens.distortion);
            DatasetError::lens(&frame.image, &frame.origin, problem)
        })?)
    } else {
        None
    };
    let pinhole = undistortion.as_ref().map_or(&lens, |undistortion| undistortion.pinhole());
    let (width, height) = target_size(&header, resolution, frame.reduced.is_some());
    let camera = Camera {
        width: header.width,
        height: header.height,
        fx: pinhole.focal.x,
        fy: pinhole.focal.y,
        cx: pinhole.principal.x,
        cy: pinhole.principal.y,
        rotation: frame.rotation,
        translation: frame.translation,
    };
    Ok(View {
        name: frame.name.clone(),
        camera: camera.resized(width, height),
        source: ImageSource {
            file: SourceFile::found(frame.image.clone())?,
            mask: frame.mask.clone().map(SourceFile::found).transpose()?,
            width,
            height,
            undistortion,
            header,
            rendered: None,
        },
    })
}

/// The size to train at.
pub(super) fn target_size(
    header: &ImageHeader,
    resolution: Option<Resolution>,
    reduced: bool,
) -> (u32, u32) {
    match resolution {
        Some(Resolution::Divisor(k)) if !reduced => {
            (divided(header.width, k), divided(header.height, k))
        }
        Some(Resolution::Width(width)) if width < header.width => {
            let height = f64::from(header.height) * f64::from(width) / f64::from(header.width);
            (width.max(1), (height.round() as u32).max(1))
        }
        _ => (header.width, header.height),
    }
}

/// side / k, rounded as image tools do, at least 1.
fn divided(side: u32, k: u32) -> u32 {
    ((f64::from(side) / f64::from(k.max(1))).round() as u32).max(1)
}

/// Whether scaling `of` by one factor gives `size` within 1 px along both axes.
fn proportional(size: (u32, u32), of: (u32, u32)) -> bool {
    let range = |side: u32, of: u32| {
        let (side, of) = (f64::from(side), f64::from(of));
        ((side - 1.0) / of, (side + 1.0) / of)
    };
    let ((x0, x1), (y0, y1)) = (range(size.0, of.0), range(size.1, of.1));
    size == of || x0.max(y0) < x1.min(y1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rescales_are_told_from_other_sizes() {
        for (size, fits) in [
            ((1237, 822), true),
            ((619, 411), true),
            ((618, 411), true),
            ((309, 205), true),
            ((2474, 1644), true),
            ((822, 1237), false),
            ((1237, 800), false),
            ((619, 420), false),
            ((1280, 822), false),
        ] {
            assert_eq!(proportional(size, (1237, 822)), fits, "{size:?}");
        }
        assert_eq!((divided(1237, 2), divided(3, 8)), (619, 1));
    }
}
