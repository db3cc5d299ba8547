//! Writes plots as SVG files.

use std::error::Error;
use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::Picture;
use densify_core::files::write_atomically;
use densify_run::failure::{Failure, OTHER};

/// Drawing area of a plot.
pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Creates an SVG with this size in pixels and a white background, drawn by `draw`.
pub(super) fn svg(
    size: (u32, u32),
    draw: impl FnOnce(&Area<'_>) -> Result<(), Box<dyn Error>>,
) -> Result<String, Failure> {
    let mut text = String::new();
    let drawn = || -> Result<(), Box<dyn Error>> {
        let area = SVGBackend::with_string(&mut text, size).into_drawing_area();
        area.fill(&WHITE)?;
        draw(&area)?;
        area.present()?;
        Ok(())
    };
    drawn().map_err(|error| Failure::new(OTHER, error))?;
    Ok(text)
}

/// Writes a plot into the folder `output`.
pub(super) fn write(
    output: &Path,
    file: String,
    caption: String,
    svg: &str,
) -> Result<Picture, Failure> {
    write_atomically(&output.join(&file), |out| out.write_all(svg.as_bytes()))?;
    Ok(Picture { file, caption })
}

/// Minimum and maximum of some numbers; `None` if there are none.
pub(super) fn range(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    values.fold(None, |range: Option<[f64; 2]>, v| {
        Some(range.map_or([v, v], |[low, high]| [low.min(v), high.max(v)]))
    })
}
