//! Conversion of pixels to sRGB.

use densify_scenegen::texture::srgb_from_linear;
use image::{DynamicImage, ImageBuffer, Pixel};
use moxcms::{ColorProfile, Layout, TransformExecutor, TransformOptions};

use super::Fault;

/// Largest difference in 8-bit values between a profile and sRGB that counts as none: profiles of sRGB differ in the
/// rounding of their curves.
const SAME: u8 = 1;

/// Converts values that are linear light to the power of `exponent`.
pub(super) fn exponent_to_srgb(image: &mut DynamicImage, exponent: f64) {
    let srgb = |value: f64| srgb_from_linear(value.powf(1.0 / exponent));
    let eight = || -> Vec<u8> {
        (0..=255).map(|v| (255.0 * srgb(f64::from(v) / 255.0)).round() as u8).collect()
    };
    let deep = || -> Vec<u16> {
        (0..=u16::MAX).map(|v| (65_535.0 * srgb(f64::from(v) / 65_535.0)).round() as u16).collect()
    };
    replace_all(image, eight, deep);
}

/// Converts values to which a profile for RGB applies. In grey images, the profile's grey axis counts.
pub(super) fn profile_to_srgb(
    image: &mut DynamicImage,
    profile: &ColorProfile,
) -> Result<(), Fault> {
    use DynamicImage::*;
    let eight =
        |layout| eight(profile, layout).map_err(|problem| Fault::new("ICC profile", problem));
    let deep = |layout| deep(profile, layout).map_err(|problem| Fault::new("ICC profile", problem));
    let width = image.width() as usize;
    match image {
        ImageRgb8(image) => each_row(image, 3 * width, &*eight(Layout::Rgb)?),
        ImageRgba8(image) => each_row(image, 4 * width, &*eight(Layout::Rgba)?),
        ImageRgb16(image) => each_row(image, 3 * width, &*deep(Layout::Rgb)?),
        ImageRgba16(image) => each_row(image, 4 * width, &*deep(Layout::Rgba)?),
        ImageLuma8(_) | ImageLumaA8(_) => {
            let greys = (0..=255).flat_map(|value| [value; 3]).collect();
            greys_to_srgb(greys, &*eight(Layout::Rgb)?)
                .map(|table| replace_all(image, || table, Vec::new))
        }
        _ => {
            let greys = (0..=u16::MAX).flat_map(|value| [value; 3]).collect();
            greys_to_srgb(greys, &*deep(Layout::Rgb)?)
                .map(|table| replace_all(image, Vec::new, || table))
        }
    }
    .map_err(|problem| Fault::new("ICC profile", problem))
}

/// Returns true if a profile for RGB is that of sRGB, or differs from it by no more than [`SAME`].
pub(super) fn is_srgb(profile: &ColorProfile) -> Result<bool, String> {
    const STEP: usize = 17;
    let levels = || (0..=255u8).step_by(STEP);
    let grid = levels().flat_map(|r| levels().flat_map(move |g| levels().map(move |b| [r, g, b])));
    let colours: Vec<u8> = grid.chain((0..=255).map(|v| [v; 3])).flatten().collect();
    let mut converted = vec![0; colours.len()];
    let transform = eight(profile, Layout::Rgb)?;
    transform.transform(&colours, &mut converted).map_err(|error| error.to_string())?;
    Ok(colours.iter().zip(converted).all(|(&before, after)| before.abs_diff(after) <= SAME))
}

type Transform<T> = std::sync::Arc<dyn TransformExecutor<T> + Send + Sync>;

fn eight(profile: &ColorProfile, layout: Layout) -> Result<Transform<u8>, String> {
    let (srgb, options) = (ColorProfile::new_srgb(), TransformOptions::default());
    profile.create_transform_8bit(layout, &srgb, layout, options).map_err(|error| error.to_string())
}

fn deep(profile: &ColorProfile, layout: Layout) -> Result<Transform<u16>, String> {
    let (srgb, options) = (ColorProfile::new_srgb(), TransformOptions::default());
    profile
        .create_transform_16bit(layout, &srgb, layout, options)
        .map_err(|error| error.to_string())
}

/// Converts a row at a time, so that no second image is needed.
fn each_row<T: Copy + Default>(
    values: &mut [T],
    row: usize,
    transform: &dyn TransformExecutor<T>,
) -> Result<(), String> {
    let mut before = vec![T::default(); row];
    for row in values.chunks_exact_mut(row) {
        before.copy_from_slice(row);
        transform.transform(&before, row).map_err(|error| error.to_string())?;
    }
    Ok(())
}

/// One value per grey, given three.
fn greys_to_srgb<T: Copy + Default>(
    greys: Vec<T>,
    transform: &dyn TransformExecutor<T>,
) -> Result<Vec<T>, String> {
    let mut converted = greys.clone();
    transform.transform(&greys, &mut converted).map_err(|error| error.to_string())?;
    Ok(converted.chunks_exact(3).map(|rgb| rgb[1]).collect())
}

/// Replaces all values but alpha with those of a table, for 8 or 16 bits.
fn replace_all(
    image: &mut DynamicImage,
    eight: impl FnOnce() -> Vec<u8>,
    deep: impl FnOnce() -> Vec<u16>,
) {
    use DynamicImage::*;
    match image {
        ImageLuma8(image) => replace(image, &eight()),
        ImageLumaA8(image) => replace(image, &eight()),
        ImageRgb8(image) => replace(image, &eight()),
        ImageRgba8(image) => replace(image, &eight()),
        ImageLuma16(image) => replace(image, &deep()),
        ImageLumaA16(image) => replace(image, &deep()),
        ImageRgb16(image) => replace(image, &deep()),
        ImageRgba16(image) => replace(image, &deep()),
        // The formats that are read have no other types of pixels.
        _ => {}
    }
}

fn replace<P: Pixel>(image: &mut ImageBuffer<P, Vec<P::Subpixel>>, table: &[P::Subpixel])
where
    P::Subpixel: Into<usize>,
{
    for pixel in image.pixels_mut() {
        pixel.apply_without_alpha(|value| table[value.into()]);
    }
}
