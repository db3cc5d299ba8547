//! Turns frames into photographs with their views: checks image files against cameras, and replaces distorted
//! lenses by pinhole cameras.

mod notes;

use std::cell::OnceCell;
use std::path::Path;

use glam::{DMat3, DVec2};
use image::GrayImage;
use rayon::prelude::*;

use super::depth::DepthSource;
use super::exif::Exif;
use super::images::{self, Hides, ImageHeader, ImageSource, Mask, SourceFile};
use super::lens::{Lens, PinholeError, Pinholes};
use super::undistort::{Pinhole, Undistortion};
use super::{Frame, LoadOptions, MaskMode, Note, Resolution, View};
use crate::error::{LoadError, LoadRemedy};
use densify_core::camera::Camera;

/// The views of one photograph, which are never split between training and test.
#[derive(Debug)]
pub(super) struct Photograph {
    /// One view, or several if the field of view of the lens is too wide for one pinhole camera.
    pub(super) views: Vec<View>,
    /// True for views that the mask hides completely; empty without a mask. Shape: `[views]`.
    pub(super) hidden: Vec<bool>,
    /// True if the dataset's own split holds the photograph out.
    pub(super) held_out: bool,
    /// Id of the photograph in tracks.
    pub(super) id: Option<u32>,
    /// Fault of the depth that was found for the photograph.
    pub(super) depth_fault: Option<LoadError>,
}

/// The photographs of frames, in the same order and in the dataset's own coordinates.
pub(super) fn photographs(
    listing: &Path,
    frames: &[Frame],
    options: &LoadOptions,
    notes: &mut Vec<Note>,
) -> Result<Vec<Photograph>, LoadError> {
    let masks_become_background = options.mask_mode == MaskMode::Background;
    let needs_masks = options.invert_masks || masks_become_background;
    if needs_masks && frames.iter().all(|frame| frame.mask.is_none()) {
        let listing = listing.to_owned();
        return Err(LoadError::NoMasks { listing, inverted: options.invert_masks });
    }
    // All frames are checked before the first error is reported, so that the message does not depend on timing.
    let checked: Vec<_> = frames.par_iter().map(|frame| check(listing, frame)).collect();
    let checked: Vec<Checked> = checked.into_iter().collect::<Result<_, _>>()?;
    notes.extend(notes::photograph_notes(frames, &checked, options));
    // Here a run is a sequence of photographs with the same lens, and thus the same pinholes.
    let mut runs = Vec::new();
    let mut first = 0;
    for run in checked.chunk_by(|a, b| a.lens == b.lens) {
        runs.push((first, run));
        first += run.len();
    }
    let pinholes = |&(first, run): &(usize, &[Checked])| -> Result<_, LoadError> {
        let lens = &run[0].lens;
        if !lens.is_distorted() {
            return Ok(None);
        }
        Pinholes::covering(lens, options.keep_fov)
            .map(Some)
            .map_err(|error| lens_error(&frames[first], lens, error))
    };
    let all: Vec<Result<Option<Pinholes>, _>> = runs.par_iter().map(pinholes).collect();
    let all: Vec<Option<Pinholes>> = all.into_iter().collect::<Result<_, _>>()?;
    notes.extend(notes::pinhole_notes(
        runs.iter().map(|(_, run)| run.len()).zip(&all),
        options.keep_fov,
    ));
    let by_frame = runs.iter().zip(&all).flat_map(|((_, run), all)| run.iter().map(move |_| all));
    let by_frame: Vec<&Option<Pinholes>> = by_frame.collect();
    let each = frames.iter().zip(checked).zip(by_frame);
    each.map(|((frame, checked), pinholes)| photograph(frame, checked, pinholes.as_ref(), options))
        .collect()
}

/// A photograph's header and lens, after they were checked against each other.
#[derive(Debug)]
struct Checked {
    header: ImageHeader,
    /// The lens at the image's size.
    lens: Lens,
    /// EXIF fields, if they were needed.
    exif: Option<Exif>,
    /// True if EXIF asks for a quarter turn, and the pose file does not say whether its poses include it.
    is_turn_ambiguous: bool,
    /// Name of the image's colour space; `None` if it is sRGB.
    colours: Option<String>,
}

/// Checks an image's header against its camera. An image that fits only after the quarter turn in its EXIF is turned:
/// some programs turn images before they estimate poses, others do not.
fn check(listing: &Path, frame: &Frame) -> Result<Checked, LoadError> {
    let mut header = frame.header.map_or_else(|| images::read_header(&frame.image), Ok)?;
    let colours = images::read_colours(&frame.image)?.map(|colours| colours.name);
    let exif = OnceCell::new();
    let quarter_turn = || exif.get_or_init(|| Exif::open(&frame.image)).quarter_turn();
    let lens = &frame.lens;
    let k = frame.reduced.unwrap_or(1);
    let expected = (divided(lens.width, k), divided(lens.height, k));
    let fits = |size: (u32, u32)| match frame.reduced {
        Some(_) => size.0.abs_diff(expected.0) <= 1 && size.1.abs_diff(expected.1) <= 1,
        None => is_proportional(size, (lens.width, lens.height)),
    };
    let (width, height) = (header.height, header.width);
    if !fits((header.width, header.height))
        && fits((width, height))
        && let turn @ Some(_) = quarter_turn()
    {
        header = ImageHeader { width, height, turn, ..header };
    }
    let size = (header.width, header.height);
    if !fits(size) {
        return Err(LoadError::size(&frame.image, size, expected));
    }
    let lens = lens.resized(header.width, header.height);
    // The principal point of a cropped image may lie outside it, but hardly by more than the image's size.
    let extent = lens.size();
    if !(lens.principal.cmpge(-extent) & lens.principal.cmple(2.0 * extent)).all() {
        let DVec2 { x, y } = lens.principal;
        let problem = format!("the principal point ({x}, {y}) px is far outside the image");
        let remedy = "repair the camera or remove the frame";
        return Err(LoadError::malformed(listing, &frame.name, problem, remedy));
    }
    let is_turn_ambiguous = frame.header.is_some() && quarter_turn().is_some();
    Ok(Checked { header, lens, exif: exif.into_inner(), is_turn_ambiguous, colours })
}

/// The error for a lens that no pinhole camera can replace, with the remedy.
fn lens_error(frame: &Frame, lens: &Lens, error: PinholeError) -> LoadError {
    let problem = format!("{error} ({})", lens.distortion);
    let (image, origin) = (&frame.image, &frame.origin);
    if matches!(error, PinholeError::Folds(degrees) if degrees > 1.0) {
        return LoadError::remedied(image, origin, problem, LoadRemedy::KeepFieldOfView);
    }
    let remedy =
        "calibrate again, or undistort the images first, e.g. with `colmap image_undistorter`";
    LoadError::malformed(image, origin, problem, remedy)
}

/// The views of a frame whose image and lens have been checked.
fn photograph(
    frame: &Frame,
    Checked { header, lens, exif, .. }: Checked,
    pinholes: Option<&Pinholes>,
    options: &LoadOptions,
) -> Result<Photograph, LoadError> {
    let file = SourceFile::existing(frame.image.clone())?.with_exif(exif);
    let mask = frame.mask.as_ref().map(|mask| {
        let hides = match (mask.hides_all_but_black, options.invert_masks) {
            (false, false) | (true, true) => Hides::Black,
            (false, true) => Hides::White,
            (true, false) => Hides::AllButBlack,
        };
        let file = SourceFile::existing(mask.path.clone())?;
        Ok::<_, LoadError>(Mask { file, hides, mode: options.mask_mode })
    });
    let mask = mask.transpose()?;
    let depth = frame.depth.as_ref().map_err(LoadError::clone).and_then(|found| {
        let found = found.as_ref();
        found.map(|found| DepthSource::of_file(found, header, &options.depth)).transpose()
    });
    let (depth, depth_fault) = match depth {
        Ok(depth) => (depth.map(Box::new), None),
        Err(fault) => (None, Some(fault)),
    };
    let view = |face: &str, undistortion: Option<Undistortion>| {
        let whole = Pinhole {
            width: lens.width,
            height: lens.height,
            focal: lens.focal,
            principal: lens.principal,
        };
        let pinhole = undistortion.as_ref().map_or(whole, |undistortion| undistortion.to);
        // Multiplying by an identity matrix could still change the last bits.
        let turn =
            undistortion.as_ref().map(|undistortion| undistortion.lens_from_pinhole.transpose());
        let (rotation, translation) = match turn.filter(|turn| *turn != DMat3::IDENTITY) {
            Some(turn) => (turn * frame.rotation, turn * frame.translation),
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
                header,
                rendered: None,
                window: None,
                depth: depth.clone(),
            },
        }
    };
    let views = match pinholes {
        None => vec![view("", None)],
        Some(pinholes) => {
            pinholes.faces.iter().map(|&(name, face)| view(name, Some(face))).collect()
        }
    };
    let hidden = match &mask {
        None => Vec::new(),
        // Masks are decoded one at a time; the memory that a training run plans includes one.
        Some(mask) => {
            let weights = mask.read_weights(|found| check_mask(mask, found, header))?;
            views.iter().map(|view| is_hidden(view, views.len() > 1, &weights, &lens)).collect()
        }
    };
    Ok(Photograph { views, hidden, held_out: frame.held_out, id: frame.id, depth_fault })
}

/// Checks that a mask has the proportions of its photograph.
fn check_mask(mask: &Mask, header: ImageHeader, image: ImageHeader) -> Result<(), LoadError> {
    let (size, expected) = ((header.width, header.height), (image.width, image.height));
    if is_proportional(size, expected) {
        return Ok(());
    }
    Err(LoadError::size(&mask.file.path, size, expected))
}

/// Returns true if a mask hides all of a view; `several` is true if its photograph has more than one view.
fn is_hidden(view: &View, several: bool, mask: &GrayImage, lens: &Lens) -> bool {
    /// If a photograph has several views, at least this many pixels along the longer side of its mask (or all, if the
    /// mask is smaller) are tested, and at most twice as many.
    const SAMPLED_SIDE: u32 = 512;
    let (width, height) = mask.dimensions();
    let stride = if several { (width.max(height) / SAMPLED_SIDE).max(1) } else { 1 } as usize;
    let rows = (0..height).step_by(stride);
    let pixels = rows.flat_map(|y| (0..width).step_by(stride).map(move |x| (x, y)));
    let mut visible = pixels.filter(|&(x, y)| mask.get_pixel(x, y).0 != [0]);
    let Some(undistortion) = &view.source.undistortion else { return visible.next().is_none() };
    let lens = lens.resized(width, height);
    !visible.any(|(x, y)| {
        let ray = lens.unproject(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
        ray.is_ok_and(|ray| undistortion.shows(ray))
    })
}

/// The name of one of several views: `a/b@left.png`.
fn face_name(name: &str, face: &str) -> String {
    if face.is_empty() {
        return name.to_owned();
    }
    let file = name.rfind('/').map_or(0, |slash| slash + 1);
    let dot = name[file..].rfind('.').filter(|&dot| dot > 0).map_or(name.len(), |dot| file + dot);
    format!("{}@{face}{}", &name[..dot], &name[dot..])
}

/// The training resolution of a pinhole image of this size, made from a file that is `file_width` wide.
pub(super) fn target_size(
    (width, height): (u32, u32),
    file_width: u32,
    resolution: Option<Resolution>,
    is_reduced: bool,
) -> (u32, u32) {
    match resolution {
        Some(Resolution::Divisor(k)) if !is_reduced => (divided(width, k), divided(height, k)),
        Some(Resolution::Width(target)) if target < file_width => {
            let scaled = |side: u32| {
                let side = f64::from(side) * f64::from(target) / f64::from(file_width);
                (side.round() as u32).max(1)
            };
            (scaled(width), scaled(height))
        }
        _ => (width, height),
    }
}

/// side / k, rounded to the nearest integer as image tools do, and at least 1.
fn divided(side: u32, k: u32) -> u32 {
    ((f64::from(side) / f64::from(k.max(1))).round() as u32).max(1)
}

/// Returns true if one factor scales `reference` to `size` within 1 px along both axes.
fn is_proportional(size: (u32, u32), reference: (u32, u32)) -> bool {
    let range = |side: u32, reference: u32| {
        let (side, reference) = (f64::from(side), f64::from(reference));
        ((side - 1.0) / reference, (side + 1.0) / reference)
    };
    let ((x0, x1), (y0, y1)) = (range(size.0, reference.0), range(size.1, reference.1));
    size == reference || x0.max(y0) < x1.min(y1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rescaled_sizes_are_distinguished_from_others() {
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
            assert_eq!(is_proportional(size, (1237, 822)), fits, "{size:?}");
        }
        assert_eq!((divided(1237, 2), divided(3, 8)), (619, 1));
    }

    #[test]
    fn the_name_of_a_face_goes_before_the_file_extension() {
        for (name, named) in
            [("a/b.c.png", "a/b.c@up.png"), ("a.b/c", "a.b/c@up"), (".png", ".png@up")]
        {
            assert_eq!((face_name(name, "up"), face_name(name, "")), (named.into(), name.into()));
        }
    }
}
