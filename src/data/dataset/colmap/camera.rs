//! Cameras of COLMAP files: a lens model, an image size and the model's parameters.

use std::path::Path;

use glam::DVec2;

use super::super::LoadError;
use super::super::lens::models::LensModel;
use super::super::lens::{Distortion, Lens};
use super::super::pose::check_lens;
use super::REMEDY;

/// Reads and checks the lens of a camera; `next` returns the parameters of its model one by one.
pub(super) fn lens(
    model: &LensModel,
    file: &Path,
    camera: &str,
    [width, height]: [u64; 2],
    mut next: impl FnMut() -> Result<f64, LoadError>,
) -> Result<Lens, LoadError> {
    let side = |side: u64| u32::try_from(side).ok().filter(|&side| side > 0);
    let (Some(width), Some(height)) = (side(width), side(height)) else {
        let problem = format!("the size {width}x{height} px is impossible");
        return Err(LoadError::malformed(file, camera, problem, REMEDY));
    };
    let fx = next()?;
    let fy = if model.focals == 2 { next()? } else { fx };
    let (focal, principal) = (DVec2::new(fx, fy), DVec2::new(next()?, next()?));
    let mut distortion = Distortion::none(model.plane);
    for &term in model.terms {
        distortion.set(term, next()?);
    }
    let lens = Lens::new((width, height), focal, principal, distortion);
    check_lens(file, camera, &lens)?;
    Ok(lens)
}
