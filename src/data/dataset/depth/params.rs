//! `depth_params.json` of the original 3DGS: for each photograph, the scale and the offset that turn its monocular
//! depth map, as a share of 65,536, into inverse depth in the units of the COLMAP model.

use std::path::Path;

use super::super::normalise::median;
use super::super::paths::{DataPath, Root, relative};
use super::super::{Frame, LoadError, json};
use super::files::DepthKind;

/// Name of the file, in the folder of the model.
const NAME: &str = "depth_params.json";
/// Scales outside this range of multiples of their median are failed fits, as in the original.
const RELIABLE: [f64; 2] = [0.2, 5.0];

/// Reads the file beside a COLMAP model, if there is one, for frames whose depth is a PNG file. Maps without an entry,
/// or with an unreliable one, are not used. A fault of the file becomes one of these frames' depth.
pub(in super::super) fn add_params(
    root: &Root,
    model: &Path,
    frames: &mut [Frame],
    notes: &mut Vec<String>,
) {
    if let Err(fault) = read_params(root, model, frames, notes) {
        for frame in frames.iter_mut().filter(|frame| is_png(frame)) {
            frame.depth = Err(fault.clone());
        }
    }
}

fn is_png(frame: &Frame) -> bool {
    matches!(&frame.depth, Ok(Some(depth)) if depth.kind == DepthKind::Png)
}

fn read_params(
    root: &Root,
    model: &Path,
    frames: &mut [Frame],
    notes: &mut Vec<String>,
) -> Result<(), LoadError> {
    if !frames.iter().any(is_png) {
        return Ok(());
    }
    let path = model.join(NAME);
    let inside = path.strip_prefix(root.path()).unwrap_or(&path).to_string_lossy().into_owned();
    let named = DataPath { file: &path, field: "the file", value: &inside };
    // A model outside the dataset was chosen by the user, and so was what lies beside it.
    let found = if model.starts_with(root.path()) {
        root.existing(named)?
    } else {
        path.is_file().then(|| path.clone())
    };
    let Some(path) = found else { return Ok(()) };
    let params = json::read(&path)?;
    let number =
        |name: &str, field: &str| params.get(name)?.get(field)?.as_f64().filter(|x| x.is_finite());
    let of = |frame: &Frame| {
        let listed = relative(&frame.listed);
        let stem = listed.rsplit_once('.').map_or(&*listed, |(stem, _)| stem);
        Some([number(stem, "scale")?, number(stem, "offset")?])
    };
    let scales =
        frames.iter().filter(|frame| is_png(frame)).filter_map(|frame| Some(of(frame)?[0]));
    let Some(middle) = median(scales.filter(|scale| *scale > 0.0).collect()) else {
        let (problem, remedy) = ("it has no scale of any photograph", "write it again");
        return Err(LoadError::malformed(&path, "the entries", problem, remedy));
    };
    let (mut missing, mut unreliable) = (0, 0);
    for frame in frames.iter_mut().filter(|frame| is_png(frame)) {
        let entry = of(frame);
        let is_reliable =
            |scale: f64| (RELIABLE[0] * middle..=RELIABLE[1] * middle).contains(&scale);
        match (entry, &mut frame.depth) {
            (Some(entry), Ok(Some(depth))) if is_reliable(entry[0]) => depth.inverse = Some(entry),
            (entry, depth) => {
                missing += usize::from(entry.is_none());
                unreliable += usize::from(entry.is_some());
                *depth = Ok(None);
            }
        }
    }
    if missing + unreliable > 0 {
        notes.push(format!(
            "{NAME}: {missing} depth maps have no entry, and the scales of {unreliable} are outside {} to {} of the \
             median; these are not used",
            RELIABLE[0], RELIABLE[1]
        ));
    }
    Ok(())
}
