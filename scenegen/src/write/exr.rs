//! Writes float images: depth as channel `Z`, normals as `X`, `Y`, `Z`.

use std::io::Cursor;
use std::path::Path;

use exr::prelude::{Image, SpecificChannels, WritableImage};

use super::write_file;
use crate::error::Error;
use crate::trace::Frame;

/// Writes depth `[world units]`, 0 where there is no surface.
pub(super) fn write_depth(path: &Path, frame: &Frame) -> Result<(), Error> {
    let width = frame.width as usize;
    let channels = SpecificChannels::build()
        .with_channel("Z")
        .with_pixel_fn(|at: exr::math::Vec2<usize>| (frame.depth[at.1 * width + at.0],));
    let mut bytes = Cursor::new(Vec::new());
    let image = Image::from_channels((width, frame.height as usize), channels);
    let written = image.write().non_parallel().to_buffered(&mut bytes);
    written.map_err(|error| Error::write(path)(std::io::Error::other(error)))?;
    write_file(path, bytes.get_ref())
}

/// Writes world-space unit normals, zero where there is no surface.
pub(super) fn write_normals(path: &Path, frame: &Frame) -> Result<(), Error> {
    let width = frame.width as usize;
    let channels = SpecificChannels::build()
        .with_channel("X")
        .with_channel("Y")
        .with_channel("Z")
        .with_pixel_fn(|at: exr::math::Vec2<usize>| {
            let [x, y, z] = frame.normals[at.1 * width + at.0];
            (x, y, z)
        });
    let mut bytes = Cursor::new(Vec::new());
    let image = Image::from_channels((width, frame.height as usize), channels);
    let written = image.write().non_parallel().to_buffered(&mut bytes);
    written.map_err(|error| Error::write(path)(std::io::Error::other(error)))?;
    write_file(path, bytes.get_ref())
}
