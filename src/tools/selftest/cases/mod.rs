//! The cases, one file per kind of difficulty.

mod antialiasing;
mod blending;
mod colour;
mod depth;
mod loss;
mod optimiser;
mod poison;
mod rows;
mod shapes;
mod sizes;
mod training;
mod world;

use glam::{DMat3, DVec3};

use super::Case;
use densify_core::camera::Camera;

/// Background of most cases.
const GREEN: [f32; 3] = [0.2, 0.5, 0.3];
/// No rotation.
const UPRIGHT: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

/// All cases, in the order of their numbers.
#[rustfmt::skip] // One case per line.
pub fn cases() -> &'static [Case] {
    &[
        Case { number: 0, title: "ordinary scenes, every SH degree", run: shapes::ordinary },
        Case { number: 1, title: "no Gaussian", run: rows::no_row },
        Case { number: 2, title: "one Gaussian", run: rows::one_row },
        Case { number: 3, title: "Gaussians on top of each other", run: rows::duplicates },
        Case { number: 5, title: "extreme log-scales", run: shapes::scales },
        Case { number: 6, title: "quaternions of any length", run: shapes::quaternions },
        Case { number: 7, title: "needles in every direction", run: shapes::needles },
        Case { number: 8, title: "Gaussians behind, at and beyond the near plane", run: depth::near_plane },
        Case { number: 9, title: "a camera inside Gaussians", run: depth::camera_inside },
        Case { number: 10, title: "Gaussians far outside the frustum", run: shapes::outside_frustum },
        Case { number: 11, title: "Gaussians as large as the image, in bands", run: sizes::large_rows },
        Case { number: 12, title: "opacities at the thresholds of the renderer", run: blending::opacities },
        Case { number: 13, title: "thousands of faint layers", run: blending::layers },
        Case { number: 14, title: "faint Gaussians behind an opaque one", run: blending::behind_opaque },
        Case { number: 15, title: "equal depths", run: depth::equal_depths },
        Case { number: 16, title: "depths one bit apart, from 0.01 to a million", run: depth::depth_order },
        Case { number: 17, title: "extreme opacity logits", run: blending::logits },
        Case { number: 18, title: "SH coefficients of any size; black and white Gaussians learn", run: colour::colours },
        Case { number: 19, title: "a camera at the mean of a Gaussian", run: depth::camera_at_mean },
        Case { number: 20, title: "distant, tiny and huge scenes", run: world::placements },
        Case { number: 21, title: "awkward image sizes", run: sizes::images },
        Case { number: 22, title: "lenses from 0.5 to 160 degrees, principal points outside", run: sizes::lenses },
        Case { number: 23, title: "photographs of one colour, or equal to the rendering", run: loss::uniform_photographs },
        Case { number: 24, title: "losses of flat and nearly equal images", run: loss::flat_and_similar },
        Case { number: 25, title: "the optimiser after gradients of any size", run: optimiser::moments },
        Case { number: 26, title: "Gaussians that hold NaN, infinity or extreme numbers", run: poison::poisoned },
        Case { number: 27, title: "Gaussians too faint to be visible", run: rows::invisible },
        Case { number: 28, title: "models trained with antialiasing", run: antialiasing::sizes },
        Case { number: 30, title: "a training run at 64x64 px, checked every 100 steps", run: training::run },
    ]
}

/// A camera at the origin that looks along z, with a focal length of 64 px.
fn axis_camera(width: u32, height: u32) -> Camera {
    Camera {
        translation: DVec3::ZERO,
        ..Camera::centred((width, height), (64.0, 64.0), DMat3::IDENTITY, DVec3::ZERO)
    }
}

/// Coefficients of band 0 that differ between rows and channels.
fn shade(row: usize) -> impl Fn(usize) -> f32 {
    move |k| ((row * 7 + k * 5) % 11) as f32 * 0.1 - 0.5
}

/// Coefficients of band 0 that differ between channels.
fn flat_colour(k: usize) -> f32 {
    0.4 - 0.3 * k as f32
}
