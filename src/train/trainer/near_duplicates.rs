//! Finds near-duplicate training views; only the first of each group is rendered for a policy's scores.
//!
//! A near-duplicate, such as the next frame of a video, costs as much as any other view and adds nothing to a score.
//! All views are trained on nevertheless, and all test views are evaluated.

use densify_core::camera::Camera;
use densify_data::views::ViewSource;

/// Largest distance between the cameras of near-duplicates `[fraction of the scene extent]`.
const MAX_DISTANCE: f64 = 0.01;
/// Smallest cosine of the angle between the orientations of near-duplicates; the angle is one degree.
const MIN_COSINE: f64 = 0.999_847_7;
/// Largest difference between their focal lengths or principal points `[fraction of the image's width]`.
const MAX_LENS_DIFFERENCE: f64 = 0.01;

/// The first view of each group of near-duplicates.
pub(super) fn distinct_views(views: &impl ViewSource, extent: f32) -> Vec<usize> {
    let reach = MAX_DISTANCE * f64::from(extent);
    let mut chosen: Vec<usize> = Vec::new();
    for view in 0..views.count() {
        let camera = views.camera(view);
        if !chosen.iter().any(|&other| are_near_duplicates(camera, views.camera(other), reach)) {
            chosen.push(view);
        }
    }
    chosen
}

/// True if two cameras have nearly the same lens and orientation and are at most `reach` apart.
fn are_near_duplicates(a: &Camera, b: &Camera, reach: f64) -> bool {
    let lengths = |camera: &Camera| [camera.fx, camera.fy, camera.cx, camera.cy];
    let apart = lengths(a).into_iter().zip(lengths(b)).map(|(a, b)| (a - b).abs());
    let is_same_lens = (a.width, a.height) == (b.width, b.height)
        && apart.fold(0.0, f64::max) <= MAX_LENS_DIFFERENCE * f64::from(a.width);
    // trace(AᵀB) = 1 + 2 cos(angle between A and B).
    let turn = (a.rotation.transpose() * b.rotation).to_cols_array();
    let cosine = (turn[0] + turn[4] + turn[8] - 1.0) / 2.0;
    a.centre().distance(b.centre()) <= reach && cosine >= MIN_COSINE && is_same_lens
}
