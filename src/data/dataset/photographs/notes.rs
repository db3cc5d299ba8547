//! Notes on photographs that are not used as they are stored.

use super::super::lens::Pinholes;
use super::super::{Frame, LoadOptions, Note, Resolution};
use super::Checked;
use densify_core::numbers::counted;

/// Share of a photograph that may be cropped without a note.
const SILENTLY_CROPPED: f64 = 0.005;

/// Notes on photographs that are rotated, converted, masked or not enlarged.
pub(super) fn photograph_notes(
    frames: &[Frame],
    checked: &[Checked],
    options: &LoadOptions,
) -> Vec<Note> {
    let texts = [
        turned_note(frames, checked),
        orientation_note(frames, checked),
        colours_note(frames, checked),
        masks_note(frames),
        narrow_note(frames, checked, options.resolution),
    ];
    texts.into_iter().flatten().map(Note::Text).collect()
}

/// Note about photographs that are converted to sRGB.
fn colours_note(frames: &[Frame], checked: &[Checked]) -> Option<String> {
    let other = || {
        let each = frames.iter().zip(checked);
        each.filter_map(|(frame, checked)| Some((&frame.name, checked.colours.as_ref()?)))
    };
    let (first, colours) = other().next()?;
    let count = counted(other().count(), "photograph");
    Some(format!("{count} converted to sRGB (first: {first}, from {colours})"))
}

/// Note about images that are narrower than the requested width.
fn narrow_note(
    frames: &[Frame],
    checked: &[Checked],
    resolution: Option<Resolution>,
) -> Option<String> {
    let Some(Resolution::Width(width)) = resolution else { return None };
    let narrow = || frames.iter().zip(checked).filter(|(_, checked)| checked.header.width < width);
    let first = &narrow().next()?.0.name;
    let count = counted(narrow().count(), "image");
    Some(format!("{count} narrower than {width} px not enlarged (first: {first})"))
}

/// Note about photographs that are turned to match their cameras.
fn turned_note(frames: &[Frame], checked: &[Checked]) -> Option<String> {
    let turned = || frames.iter().zip(checked).filter(|(_, checked)| checked.header.turn.is_some());
    let (first, _) = turned().next()?;
    Some(format!(
        "{} rotated by 90 degrees as EXIF says, to match the image sizes of the cameras (first: {})",
        counted(turned().count(), "photograph"),
        first.name
    ))
}

/// Note about photographs whose EXIF orientation may or may not be part of the poses.
fn orientation_note(frames: &[Frame], checked: &[Checked]) -> Option<String> {
    let ambiguous = || frames.iter().zip(checked).filter(|(_, checked)| checked.is_turn_ambiguous);
    let first = &ambiguous().next()?.0.name;
    Some(format!(
        "{} used as stored, although EXIF asks for a rotation by 90 degrees (first: {first}): the pose file states no \
         image size that would show whether its poses include the rotation. If the model is poor, rotate the files",
        counted(ambiguous().count(), "photograph")
    ))
}

/// Note about the number of photographs with masks.
fn masks_note(frames: &[Frame]) -> Option<String> {
    let masked = frames.iter().filter(|frame| frame.mask.is_some()).count();
    (masked > 0).then(|| format!("{masked} of {} photographs have a mask", frames.len()))
}

/// Notes about photographs that become several views or are cropped. For each lens, `all` has the number of its
/// photographs and its pinholes.
pub(super) fn pinhole_notes<'a>(
    all: impl Iterator<Item = (usize, &'a Option<Pinholes>)> + Clone,
    keep_fov: bool,
) -> Vec<Note> {
    let all = all.filter_map(|(count, pinholes)| Some((count, pinholes.as_ref()?)));
    let mut notes = Vec::new();
    let wide = || all.clone().filter(|(_, pinholes)| pinholes.faces.len() > 1);
    if let Some(widest) = wide().max_by_key(|(_, pinholes)| pinholes.faces.len()) {
        let names: Vec<&str> = widest.1.faces.iter().map(|(name, _)| *name).collect();
        notes.push(Note::Text(format!(
            "the field of view of {} photographs is too wide for one pinhole camera; each becomes up to {} views: {}",
            wide().map(|(count, _)| count).sum::<usize>(),
            names.len(),
            names.join(", ")
        )));
    }
    let lost = all.clone().filter(|(_, pinholes)| pinholes.cropped > SILENTLY_CROPPED);
    let most = lost.clone().map(|(_, pinholes)| pinholes.cropped).fold(0.0, f64::max);
    if most > 0.0 {
        let percent = (100.0 * most).max(1.0);
        let photographs = lost.map(|(count, _)| count).sum();
        notes.push(if keep_fov {
            Note::Text(format!(
                "up to {percent:.0} % of each of {photographs} photographs is beyond what the lens model can invert, and \
                 is not used"
            ))
        } else {
            Note::Cropped { percent, photographs }
        });
    }
    notes
}
