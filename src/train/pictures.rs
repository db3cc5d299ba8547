//! 8-bit images of renderings and photographs, and PNG files of them.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageFormat, Rgb, RgbImage, imageops};
use rayon::prelude::*;

use densify_core::files::{FileError, write_atomically};
use densify_core::image::Image8;
use densify_render::Rendering;

/// Converts a value in `[0, 1]` to 8 bits.
pub fn to_u8(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// The 8-bit image of a rendering.
pub fn picture(Rendering { width, height, rgb, .. }: &Rendering) -> RgbImage {
    let mut image = RgbImage::new(*width, *height);
    let row = 3 * *width as usize;
    let rows = image.par_chunks_exact_mut(row.max(1)).zip(rgb.par_chunks_exact(row.max(1)));
    rows.for_each(|(to, from)| to.iter_mut().zip(from).for_each(|(to, &from)| *to = to_u8(from)));
    image
}

/// The image of a photograph, composited on a background.
pub fn photograph(image: &Image8, background: [f32; 3]) -> RgbImage {
    let pixel =
        |x: u32, y: u32| Rgb(image.composited(x as usize, y as usize, background).map(to_u8));
    RgbImage::from_fn(image.width, image.height, pixel)
}

/// Joins images from left to right, with white gaps of width `gap` `[px]` between them.
pub fn side_by_side(pictures: &[RgbImage], gap: u32) -> RgbImage {
    let width = pictures.iter().map(|picture| picture.width() + gap).sum::<u32>() - gap;
    let height = pictures.iter().map(RgbImage::height).max().unwrap_or(1);
    let mut joined = RgbImage::from_pixel(width, height, Rgb([255; 3]));
    let mut x = 0;
    for picture in pictures {
        imageops::replace(&mut joined, picture, i64::from(x), 0);
        x += picture.width() + gap;
    }
    joined
}

/// Writes an image as a PNG file.
///
/// # Errors
/// When the file cannot be written.
pub fn write_png(path: &Path, image: &DynamicImage) -> Result<(), FileError> {
    write_atomically(path, |out| {
        let mut encoded = Cursor::new(Vec::new());
        image.write_to(&mut encoded, ImageFormat::Png).map_err(std::io::Error::other)?;
        out.write_all(&encoded.into_inner())
    })
}
