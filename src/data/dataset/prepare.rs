//! Turns the frames of any format into a dataset: sorts, splits and normalises them.

use std::collections::HashMap;
use std::path::Path;

use glam::DVec3;

use super::depth::{self, first_points};
use super::mask_files::unused_masks_note;
use super::normalise::{self, Normalisation};
use super::photographs::{Photograph, photographs};
use super::pose::POSE_REMEDY;
use super::view_list::{ViewList, select};
use super::{Dataset, FarCameras, Frame, LoadOptions, Note, PointCloud, Scene, Split, View};
use crate::error::{LoadError, LoadRemedy};
use densify_core::files::one_line;

/// Largest accepted fraction of unusable points.
const MAX_BAD_POINTS: f64 = 0.01;

/// Checks the frames that the reader of a format returned, and assembles the dataset.
pub(super) fn prepare(
    path: &Path,
    mut scene: Scene,
    options: &LoadOptions,
) -> Result<Dataset, LoadError> {
    let mut frames = std::mem::take(&mut scene.frames);
    // Sorted bytewise, as other trainers do for their test splits.
    frames.sort_by(|a, b| (a.name.as_bytes(), a.held_out).cmp(&(b.name.as_bytes(), b.held_out)));
    refuse_duplicates(&scene.listing, &frames)?;
    let mut notes = std::mem::take(&mut scene.notes);
    let photographs = photographs(&scene.listing, &frames, options, &mut notes)?;
    if frames.iter().all(|frame| frame.mask.is_none()) {
        notes.extend(unused_masks_note(path).map(Note::Text));
    }
    assemble(path, photographs, scene, notes, options)
}

/// Notes that name no option.
pub(super) fn text_notes(notes: Vec<String>) -> Vec<Note> {
    notes.into_iter().map(Note::Text).collect()
}

/// Divides photographs, which are sorted by name, into training and test views, and moves everything to normalised
/// coordinates.
pub(super) fn assemble(
    path: &Path,
    photographs: Vec<Photograph>,
    scene: Scene,
    mut notes: Vec<Note>,
    options: &LoadOptions,
) -> Result<Dataset, LoadError> {
    let Scene { listing, mut points, mut points_file, tracks, own_split, surface_bytes, .. } =
        scene;
    let mut is_seeded = false;
    if points.is_empty()
        && let Some(cloud) = first_points(options)?
    {
        points = cloud;
        points_file.clone_from(&options.depth.points);
        is_seeded = true;
    }
    let surface_bytes = surface_bytes.or_else(|| super::builtin::surface_bytes(path));
    let centres: Vec<_> =
        photographs.iter().map(|photograph| photograph.views[0].camera.centre()).collect();
    let is_far = normalise::outliers(&centres);
    let far = photographs.iter().zip(&is_far).filter(|(_, is_far)| **is_far);
    let far: Vec<&str> = far.map(|(photograph, _)| &*photograph.views[0].name).collect();
    notes.extend(far_note(&far, options.far_cameras));
    let every = match options.split {
        Split::Every(every) => Some(every.get() as usize),
        Split::Eval if !own_split => Some(Split::EVAL_EVERY as usize),
        Split::None | Split::Eval => None,
    };
    let mut view_list = options.views.as_deref().map(ViewList::read).transpose()?;
    // Indices of the training views of a photograph, by its id in tracks.
    let mut views_by_id = HashMap::new();
    let (mut train, mut test) = (Vec::<View>::new(), Vec::new());
    let mut hidden_names = Vec::new();
    let mut depth_fault = None;
    // Centres of the training cameras that are not outliers.
    let mut near = Vec::new();
    for (index, photograph) in photographs.into_iter().enumerate() {
        // Photographs that are left out count for the split, so that the others are split as if none were missing.
        if is_far[index] && options.far_cameras == FarCameras::LeaveOut {
            continue;
        }
        let Photograph { views, hidden, held_out, id, depth_fault: fault } = photograph;
        // Without a mask, `hidden` is empty.
        let hidden = hidden.into_iter().chain(std::iter::repeat(false));
        let (out, views): (Vec<_>, Vec<_>) =
            views.into_iter().zip(hidden).partition(|(_, hidden)| *hidden);
        hidden_names.extend(out.into_iter().map(|(view, _)| view.name));
        let views: Vec<View> = views.into_iter().map(|(view, _)| view).collect();
        let Some(views) = select(view_list.as_mut(), views) else { continue };
        if every.map_or(held_out, |every| index % every == 0) {
            test.extend(views);
        } else {
            let first = train.len() as u32;
            views_by_id.extend(id.map(|id| (id, first..first + views.len() as u32)));
            depth_fault = depth_fault.or(fault);
            near.extend((!is_far[index]).then(|| centres[index]));
            train.extend(views);
        }
    }
    view_list.map_or(Ok(()), |list| list.check(&train))?;
    check_left(&train, &test, &hidden_names, options, &mut notes)?;
    let points_path = points_file.as_deref().unwrap_or(path);
    drop_points(points_path, &mut points, &mut notes, "finite", DVec3::is_finite)?;
    let normalisation = Normalisation::fit(&near, &points.positions);
    for view in train.iter_mut().chain(&mut test) {
        view.camera = normalisation.scene_from_world_camera(&view.camera);
        if !view.camera.translation.as_vec3().is_finite() {
            let problem = "the camera is too far from the others";
            return Err(LoadError::malformed(&listing, &view.name, problem, POSE_REMEDY));
        }
    }
    for position in &mut points.positions {
        *position = normalisation.scene_from_world(*position);
    }
    drop_points(points_path, &mut points, &mut notes, "within the range of f32", |p| {
        p.as_vec3().is_finite()
    })?;
    // If a photograph has several views, a track is assigned to the first view that shows its point.
    let shows = |number: u32, point: DVec3| {
        train[number as usize].camera.depth_in_image(point, 0.0).is_some()
    };
    let tracks = tracks.in_training_views(&normalisation, |id, point| {
        let mut numbers = views_by_id.get(&id)?.clone();
        if numbers.len() == 1 { numbers.next() } else { numbers.find(|&view| shows(view, point)) }
    });
    let depth = depth::decide(
        depth::Scene {
            train: &mut train,
            test: &mut test,
            points: &points,
            normalisation: &normalisation,
            is_truth: surface_bytes.is_some(),
            is_seeded,
            fault: depth_fault,
        },
        options,
        &mut notes,
    )?;
    Ok(Dataset {
        root: path.to_owned(),
        unpacked: None,
        train,
        test,
        points,
        tracks,
        normalisation,
        surface_bytes,
        depth,
        notes,
    })
}

/// Fails if no view is left to train on; notes the views that masks hide.
fn check_left(
    train: &[View],
    test: &[View],
    hidden_names: &[String],
    options: &LoadOptions,
    notes: &mut Vec<Note>,
) -> Result<(), LoadError> {
    if train.is_empty() && test.is_empty() && !hidden_names.is_empty() {
        let ignored = if options.invert_masks { "white" } else { "black" };
        let problem = format!(
            "no view is left to train on: masks hide every pixel of all {} views ({ignored} is \
             ignored)",
            hidden_names.len()
        );
        let remedy = LoadRemedy::InvertMasks(!options.invert_masks);
        return Err(LoadError::Remedied { problem, remedy });
    }
    if let Some(shown) = first_names(hidden_names) {
        notes.push(Note::Text(format!(
            "masks hide every pixel of {} views, which are left out: {shown}",
            hidden_names.len()
        )));
    }
    if train.is_empty() {
        let problem =
            format!("no view is left to train on: the test split takes all {} views", test.len());
        return Err(LoadError::Remedied { problem, remedy: LoadRemedy::LargerTestEvery });
    }
    Ok(())
}

/// Note about views whose camera is far from all others.
fn far_note(names: &[&str], treatment: FarCameras) -> Option<Note> {
    let (count, shown) = (names.len(), first_names(names)?);
    Some(match treatment {
        FarCameras::LeaveOut => Note::FarCamerasLeftOut { count, names: shown },
        FarCameras::Keep => Note::Text(format!(
            "{count} cameras far from all others are kept, but do not count for the extent of the \
             scene: {shown}"
        )),
    })
}

/// The first names of a list and the number of further ones; `None` if the list is empty.
fn first_names(names: &[impl AsRef<str>]) -> Option<String> {
    const SHOWN: usize = 5;
    let shown: Vec<&str> = names.iter().take(SHOWN).map(AsRef::as_ref).collect();
    let more = names.len().saturating_sub(SHOWN);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    (!names.is_empty()).then(|| shown.join(", ") + &more)
}

fn refuse_duplicates(listing: &Path, frames: &[Frame]) -> Result<(), LoadError> {
    // Absolute paths are matched by suffix. Two of them may therefore lead to one file, which could then be both
    // trained on and held out.
    let mut by_image = HashMap::new();
    for frame in frames {
        let first = *by_image.entry(&frame.image).or_insert(frame);
        if first.listed != frame.listed {
            let image = frame.image.display();
            let problem = one_line(&format!(
                "{} and {} are the same file, {image}",
                first.origin, frame.origin
            ));
            return Err(LoadError::Remedied { problem, remedy: LoadRemedy::ImagesFolderOfBoth });
        }
    }
    let mut by_mask = HashMap::new();
    for frame in frames {
        let Some(mask) = &frame.mask else { continue };
        let Some(listed) = &mask.listed else { continue };
        let first: &String = by_mask.entry(&mask.path).or_insert(listed);
        if first != listed {
            let problem = format!("the masks {first:?} and {listed:?} are {}", mask.path.display());
            let remedy = "copy the folders of both into the dataset's folder, or correct the paths";
            return Err(LoadError::malformed(listing, "mask_path", problem, remedy));
        }
    }
    for pair in frames.windows(2) {
        if pair[0].name == pair[1].name && pair[0].held_out == pair[1].held_out {
            let (problem, remedy) = ("the image is listed twice", "remove one of the two");
            return Err(LoadError::malformed(listing, &pair[0].name, problem, remedy));
        }
    }
    Ok(())
}

/// Drops the points that `keep` refuses, and notes their number; too many are an error.
fn drop_points(
    path: &Path,
    points: &mut PointCloud,
    notes: &mut Vec<Note>,
    condition: &str,
    keep: impl Fn(DVec3) -> bool,
) -> Result<(), LoadError> {
    let total = points.len();
    let bad = points.retain(keep);
    if bad as f64 > MAX_BAD_POINTS * total as f64 {
        let path = path.display();
        return Err(LoadError::Data(format!(
            "{path}: {bad} of {total} points are not {condition}, more than 1 %; repair the reconstruction"
        )));
    }
    if bad > 0 {
        notes.push(Note::Text(format!(
            "{}: {bad} of {total} points are not {condition} and are dropped",
            path.display()
        )));
    }
    Ok(())
}
