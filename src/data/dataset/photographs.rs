//! Turns frames into photographs with their views: checks files against cameras, and cuts what lenses saw into
//! pinholes.

use std::path::Path;

use glam::{DMat3, DVec2};
use rayon::prelude::*;

use super::DatasetError;
use super::exif;
use super::images::{self, Hides, ImageHeader, ImageSource, Mask, SourceFile};
use super::lens::{Cut, CutFault, Lens};
use super::undistort::{Pinhole, Undistortion};
use super::{Frame, LoadOptions, MaskMode, Resolution, View};
use densify_core::camera::Camera;

/// Share of a photograph that may be cropped without a word.
const UNSAID: f64 = 0.005;

/// The views of one photograph, which stay together.
#[derive(Debug)]
pub(super) struct Photograph {
    /// At least one; several where the lens saw too wide a field for one.
    pub(super) views: Vec<View>,
    /// Which of them a mask hides wholly; empty if there is no mask.
    pub(super) hidden: Vec<bool>,
    /// Whether the dataset holds it out.
    pub(super) held_out: bool,
    /// The name that tracks have for it.
    pub(super) id: Option<u32>,
}

/// The photographs of frames in their order, in the dataset's own coordinates.
pub(super) fn photographs(
    listing: &Path,
    frames: &[Frame],
    options: &LoadOptions,
    notes: &mut Vec<String>,
) -> Result<Vec<Photograph>, DatasetError> {
    let carves = options.mask_mode == MaskMode::Background;
    let flag = if options.invert_masks { "--invert-masks" } else { "--mask-mode background" };
    if (options.invert_masks || carves) && frames.iter().all(|frame| frame.mask.is_none()) {
        let problem = "no photograph has a mask";
        let remedy =
            "put masks into `masks/`, each as NAME.png after its photograph, or leave the flag out";
        return Err(DatasetError::malformed(listing, flag, problem, remedy));
    }
    // All first, then the first error: the message does not depend on the threads.
    let checked: Vec<_> = frames.par_iter().map(|frame| checked(listing, frame)).collect();
    let checked: Vec<Checked> = checked.into_iter().collect::<Result<_, _>>()?;
    notes.extend(turned_note(frames, &checked));
    notes.extend(unsure_note(frames, &checked));
    notes.extend(masks_note(frames));
    if let (Some(Resolution::Width(width)), Some(first)) = (options.resolution, frames.first())
        && checked.iter().any(|checked| checked.header.width < width)
    {
        let first = &first.name;
        notes.push(format!("images narrower than {width} px are not enlarged ({first})"));
    }
    // Photographs of one camera mostly follow each other, and are cut alike.
    let mut runs = Vec::new();
    let mut first = 0;
    for run in checked.chunk_by(|a, b| a.lens == b.lens) {
        runs.push((first, run));
        first += run.len();
    }
    let cut = |&(first, run): &(usize, &[Checked])| -> Result<_, DatasetError> {
        let lens = &run[0].lens;
        if !lens.is_distorted() {
            return Ok(None);
        }
        Cut::of(lens, options.keep_fov)
            .map(Some)
            .map_err(|fault| refusal(&frames[first], lens, fault))
    };
    let cuts: Vec<Result<Option<Cut>, _>> = runs.par_iter().map(cut).collect();
    let cuts: Vec<Option<Cut>> = cuts.into_iter().collect::<Result<_, _>>()?;
    notes.extend(cut_notes(runs.iter().map(|(_, run)| run.len()).zip(&cuts), options.keep_fov));
    let cut_of = runs.iter().zip(&cuts).flat_map(|((_, run), cut)| run.iter().map(move |_| cut));
    let each = frames.iter().zip(&checked).zip(cut_of);
    each.map(|((frame, checked), cut)| photograph(frame, checked, cut.as_ref(), options)).collect()
}

/// What is known of a photograph whose image fits its camera.
#[derive(Debug)]
struct Checked {
    header: ImageHeader,
    /// At the image's size.
    lens: Lens,
    /// Whether EXIF turns the image by a quarter, and nothing says whether the poses mean that.
    is_unsure: bool,
}

/// Checks an image's header against its camera. An image that lies on its side for this camera, and says so in its
/// EXIF, is turned: some programs do so before they find poses, and others do not.
fn checked(listing: &Path, frame: &Frame) -> Result<Checked, DatasetError> {
    let mut header = images::probe(&frame.image)?;
    let lens = &frame.lens;
    let k = frame.reduced.unwrap_or(1);
    let expected = (divided(lens.width, k), divided(lens.height, k));
    let fits = |size: (u32, u32)| match frame.reduced {
        Some(_) => size.0.abs_diff(expected.0) <= 1 && size.1.abs_diff(expected.1) <= 1,
        None => proportional(size, (lens.width, lens.height)),
    };
    let (width, height) = (header.height, header.width);
    if !fits((header.width, header.height))
        && fits((width, height))
        && let turn @ Some(_) = exif::quarter_turn(&frame.image)
    {
        header = ImageHeader { width, height, turn, ..header };
    }
    let size = (header.width, header.height);
    if !fits(size) {
        return Err(DatasetError::size(&frame.image, size, expected));
    }
    if let Some(mask) = &frame.mask {
        let mask = &mask.path;
        let found = images::probe(mask)?;
        let found = (found.width, found.height);
        if !proportional(found, size) {
            return Err(DatasetError::size(mask, found, size));
        }
    }
    let lens = lens.resized(header.width, header.height);
    // Cut-outs of a photograph have it outside, but hardly by more than their own size.
    let extent = lens.size();
    if !(lens.principal.cmpge(-extent) & lens.principal.cmple(2.0 * extent)).all() {
        let DVec2 { x, y } = lens.principal;
        let problem = format!("the principal point ({x}, {y}) px is far outside the image");
        let remedy = "repair the camera or remove the frame";
        return Err(DatasetError::malformed(listing, &frame.name, problem, remedy));
    }
    let is_unsure = !frame.is_sized && exif::quarter_turn(&frame.image).is_some();
    Ok(Checked { header, lens, is_unsure })
}

/// What is said about photographs that are turned.
fn turned_note(frames: &[Frame], checked: &[Checked]) -> Option<String> {
    let turned = || frames.iter().zip(checked).filter(|(_, checked)| checked.header.turn.is_some());
    let (first, _) = turned().next()?;
    Some(format!(
        "{} photographs lie on their side for their cameras, and are turned as their EXIF says ({} is the first)",
        turned().count(),
        first.name
    ))
}

/// What is said about photographs that EXIF turns by a quarter while nothing says whether the poses mean that.
fn unsure_note(frames: &[Frame], checked: &[Checked]) -> Option<String> {
    let unsure = || frames.iter().zip(checked).filter(|(_, checked)| checked.is_unsure);
    let first = &unsure().next()?.0.name;
    Some(format!(
        "{} photographs are to be turned by a quarter, as their EXIF says, but the pose file has no size that would \
         tell whether its poses mean that; they are taken as they are stored ({first} is the first). If the model is \
         poor, turn the files themselves",
        unsure().count()
    ))
}

/// How many photographs have masks, if any.
fn masks_note(frames: &[Frame]) -> Option<String> {
    let masked = frames.iter().filter(|frame| frame.mask.is_some()).count();
    (masked > 0).then(|| format!("{masked} of {} photographs have a mask", frames.len()))
}

/// Why a lens cannot be cut, with the remedy.
fn refusal(frame: &Frame, lens: &Lens, fault: CutFault) -> DatasetError {
    let problem = format!("{fault} ({})", lens.distortion());
    let remedy = match fault {
        CutFault::Folds(degrees) if degrees > 1.0 => {
            "train on that field alone with --keep-fov, or calibrate again with fewer terms, or undistort the \
             images first, e.g. with `colmap image_undistorter`"
        }
        _ => "calibrate again, or undistort the images first, e.g. with `colmap image_undistorter`",
    };
    DatasetError::malformed(&frame.image, &frame.origin, problem, remedy)
}

/// What is said about the pinholes of so many photographs each.
fn cut_notes<'a>(
    cuts: impl Iterator<Item = (usize, &'a Option<Cut>)> + Clone,
    keep: bool,
) -> Vec<String> {
    let cuts = cuts.filter_map(|(count, cut)| Some((count, cut.as_ref()?)));
    let mut notes = Vec::new();
    let wide = || cuts.clone().filter(|(_, cut)| cut.faces.len() > 1);
    if let Some(most) = wide().max_by_key(|(_, cut)| cut.faces.len()) {
        let names: Vec<&str> = most.1.faces.iter().map(|(name, _)| *name).collect();
        notes.push(format!(
            "the field of view of {} photographs is too wide for one pinhole; each becomes up to {} views: {}",
            wide().map(|(count, _)| count).sum::<usize>(),
            names.len(),
            names.join(", ")
        ));
    }
    let lost = cuts.clone().filter(|(_, cut)| cut.cropped > UNSAID);
    let most = lost.clone().map(|(_, cut)| cut.cropped).fold(0.0, f64::max);
    if most > 0.0 {
        let what = match keep {
            true => "is beyond what their lens is known to image, and is not used",
            false => "is cropped by undistortion (--keep-fov keeps what the lens saw)",
        };
        notes.push(format!(
            "up to {:.0} % of {} photographs {what}",
            (100.0 * most).max(1.0),
            lost.map(|(count, _)| count).sum::<usize>()
        ));
    }
    notes
}

/// The views of a frame whose image and lens are checked.
fn photograph(
    frame: &Frame,
    Checked { header, lens, .. }: &Checked,
    cut: Option<&Cut>,
    options: &LoadOptions,
) -> Result<Photograph, DatasetError> {
    let file = SourceFile::found(frame.image.clone())?;
    let mask = frame.mask.as_ref().map(|mask| {
        let hides = match (mask.hides_all_but_black, options.invert_masks) {
            (false, false) | (true, true) => Hides::Black,
            (false, true) => Hides::White,
            (true, false) => Hides::AllButBlack,
        };
        let file = SourceFile::found(mask.path.clone())?;
        Ok::<_, DatasetError>(Mask { file, hides, mode: options.mask_mode })
    });
    let mask = mask.transpose()?;
    let view = |face: &str, undistortion: Option<Undistortion>| {
        let whole = Pinhole {
            width: lens.width,
            height: lens.height,
            focal: lens.focal,
            principal: lens.principal,
        };
        let pinhole = undistortion.as_ref().map_or(whole, |undistortion| *undistortion.pinhole());
        // A rotation changes nothing if there is none, to the last bit.
        let looks =
            undistortion.as_ref().map(|undistortion| undistortion.lens_from_pinhole().transpose());
        let (rotation, translation) = match looks.filter(|looks| *looks != DMat3::IDENTITY) {
            Some(looks) => (looks * frame.rotation, looks * frame.translation),
            None => (frame.rotation, frame.translation),
        };
        let camera = Camera {
            width: pinhole.width,
            height: pinhole.height,
            fx: pinhole.focal.x,
            fy: pinhole.focal.y,
            cx: pinhole.principal.x,
            cy: pinhole.principal.y,
            rotation,
            translation,
        };
        let size = (pinhole.width, pinhole.height);
        let (width, height) =
            target_size(size, header.width, options.resolution, frame.reduced.is_some());
        View {
            name: face_name(&frame.name, face),
            camera: camera.resized(width, height),
            source: ImageSource {
                file: file.clone(),
                mask: mask.clone(),
                width,
                height,
                undistortion,
                header: *header,
                rendered: None,
                window: None,
            },
        }
    };
    let views = match cut {
        None => vec![view("", None)],
        Some(cut) => cut.faces.iter().map(|&(name, face)| view(name, Some(face))).collect(),
    };
    let hidden = hidden(&views, lens)?;
    Ok(Photograph { views, hidden, held_out: frame.held_out, id: frame.id })
}

/// Which views of a photograph its mask hides wholly. One mask at a time is decoded, which a run has room for.
fn hidden(views: &[View], lens: &Lens) -> Result<Vec<bool>, DatasetError> {
    /// Most pixels along a side of a mask that are asked which of several views they are in.
    const ASKED: u32 = 512;
    let Some(mask) = views.first().and_then(|view| view.source.mask.as_ref()) else {
        return Ok(Vec::new());
    };
    let mask = mask.weights()?;
    let (width, height) = mask.dimensions();
    let lens = lens.resized(width, height);
    let stride = if views.len() > 1 { (width.max(height) / ASKED).max(1) } else { 1 };
    let places = || {
        (0..height)
            .step_by(stride as usize)
            .flat_map(|y| (0..width).step_by(stride as usize).map(move |x| (x, y)))
    };
    let counted = || places().filter(|&(x, y)| mask.get_pixel(x, y).0 != [0]);
    let is_hidden = |view: &View| match &view.source.undistortion {
        None => counted().next().is_none(),
        Some(undistortion) => !counted().any(|(x, y)| {
            let ray = lens.unproject(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
            ray.is_ok_and(|ray| undistortion.shows(ray))
        }),
    };
    Ok(views.iter().map(is_hidden).collect())
}

/// The name of one view of several: `a/b@left.png`.
fn face_name(name: &str, face: &str) -> String {
    if face.is_empty() {
        return name.to_owned();
    }
    let file = name.rfind('/').map_or(0, |slash| slash + 1);
    let dot = name[file..].rfind('.').filter(|&dot| dot > 0).map_or(name.len(), |dot| file + dot);
    format!("{}@{face}{}", &name[..dot], &name[dot..])
}

/// The size to train at of a pinhole of this size, from a file of this width.
pub(super) fn target_size(
    (width, height): (u32, u32),
    file_width: u32,
    resolution: Option<Resolution>,
    reduced: bool,
) -> (u32, u32) {
    match resolution {
        Some(Resolution::Divisor(k)) if !reduced => (divided(width, k), divided(height, k)),
        Some(Resolution::Width(wanted)) if wanted < file_width => {
            let scaled = |side: u32| {
                let side = f64::from(side) * f64::from(wanted) / f64::from(file_width);
                (side.round() as u32).max(1)
            };
            (scaled(width), scaled(height))
        }
        _ => (width, height),
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

    #[test]
    fn faces_are_named_before_the_ending() {
        for (name, named) in
            [("a/b.c.png", "a/b.c@up.png"), ("a.b/c", "a.b/c@up"), (".png", ".png@up")]
        {
            assert_eq!((face_name(name, "up"), face_name(name, "")), (named.into(), name.into()));
        }
    }
}
