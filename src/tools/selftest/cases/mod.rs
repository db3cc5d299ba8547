//! The cases, by what is hard about them.

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

use super::Case;
use densify_core::camera::Camera;

const GREY: [f32; 3] = [0.2, 0.5, 0.3];
/// No rotation.
const UPRIGHT: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

/// All cases that every backend must hold, in the order of their numbers.
#[must_use]
#[rustfmt::skip] // A case is a line.
pub fn cases() -> &'static [Case] {
    &[
        Case { number: 0, what: "ordinary scenes, every degree", run: shapes::ordinary },
        Case { number: 1, what: "no row", run: rows::none },
        Case { number: 2, what: "one row", run: rows::one },
        Case { number: 3, what: "rows on top of each other", run: rows::duplicates },
        Case { number: 5, what: "log-scales at both ends", run: shapes::scales },
        Case { number: 6, what: "quaternions of any length", run: shapes::quaternions },
        Case { number: 7, what: "needles in every direction", run: shapes::needles },
        Case { number: 8, what: "rows behind, at and beyond the near plane", run: depth::near },
        Case { number: 9, what: "a camera inside of rows", run: depth::inside },
        Case { number: 10, what: "rows far beside the frustum", run: shapes::beside },
        Case { number: 11, what: "rows as large as the image, in bands", run: sizes::crowd },
        Case { number: 12, what: "opacities at the steps of the renderer", run: blending::opacities },
        Case { number: 13, what: "thousands of faint layers", run: blending::layers },
        Case { number: 14, what: "faint rows behind an opaque one", run: blending::behind },
        Case { number: 15, what: "equal depths", run: depth::ties },
        Case { number: 16, what: "depths one bit apart, from 0.01 to a million", run: depth::order },
        Case { number: 17, what: "opacity logits at both ends", run: blending::logits },
        Case { number: 18, what: "colours of any size, and black ones learn", run: colour::colours },
        Case { number: 19, what: "a camera at the mean of a row", run: depth::coincident },
        Case { number: 20, what: "scenes far off, tiny and huge", run: world::anywhere },
        Case { number: 21, what: "awkward image sizes", run: sizes::images },
        Case { number: 22, what: "lenses from 0.5 to 160 degrees, centres outside", run: sizes::lenses },
        Case { number: 23, what: "photographs of one colour, or equal to the render", run: loss::plain },
        Case { number: 24, what: "losses of flat and nearly equal images", run: loss::flat },
        Case { number: 25, what: "the optimiser after gradients of any size", run: optimiser::moments },
        Case { number: 26, what: "rows that hold NaN, infinity, or any number", run: poison::poisoned },
        Case { number: 27, what: "rows all too faint to be seen", run: rows::invisible },
        Case { number: 30, what: "a run of 64x64 px, looked at every 100 steps", run: training::run },
    ]
}

/// A camera that looks along z, at the origin, so that sizes can be given in pixels.
fn straight(width: u32, height: u32) -> Camera {
    Camera {
        width,
        height,
        fx: 64.0,
        fy: 64.0,
        cx: 0.5 * f64::from(width),
        cy: 0.5 * f64::from(height),
        rotation: glam::DMat3::IDENTITY,
        translation: glam::DVec3::ZERO,
    }
}

/// Coefficients of band 0 that tell the channels apart.
fn flat_colour(k: usize) -> f32 {
    0.4 - 0.3 * k as f32
}
