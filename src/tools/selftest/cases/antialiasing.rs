//! Models trained with antialiasing, which lowers the opacity of Gaussians smaller than a pixel.

use super::{GREEN, axis_camera, flat_colour};
use crate::scenes;
use crate::trial::Trial;
use densify_core::antialiasing::Antialiasing;
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;
use densify_render::BackendError;

/// A cloud whose Gaussians are scaled by `size`, opaque enough to be seen at a fraction of a pixel.
fn cloud(camera: &Camera, size: f32, antialiasing: Antialiasing) -> Gaussians {
    let mut model = scenes::cloud(30, 1, camera, 33);
    model.antialiasing = antialiasing;
    model.log_scales.as_flattened_mut().iter_mut().for_each(|log| *log += size.ln());
    model.opacity_logits.iter_mut().for_each(|logit| *logit += 2.0);
    model
}

/// One Gaussian with these standard deviations `[px]` at distance 1, where a pixel is 1/64 wide.
fn one(sizes_px: [f32; 3], quat: [f32; 4], antialiasing: Antialiasing) -> Gaussians {
    let mut model = Gaussians { antialiasing, ..Gaussians::default() };
    let scale = sizes_px.map(|size| size / 64.0);
    scenes::push(&mut model, [0.01, -0.02, 1.0], scale, quat, 2.0, flat_colour);
    model
}

pub(super) fn sizes(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(49, 35, 10);
    let small = axis_camera(24, 20);
    for kind in [Antialiasing::Wide, Antialiasing::Narrow] {
        // From 4 to 0.09 px at the median; the faintest are below the threshold of blending.
        for size in [1.0, 0.1, 0.02] {
            let label = format!("{kind}, {size} times");
            trial.check(&label, &cloud(&camera, size, kind), &camera, GREEN, 1)?;
        }
        let turned = [0.9, -0.3, 0.4, 0.2];
        for (case, sizes_px) in [
            ("nearly a sphere", [0.2, 0.21, 0.19]),
            ("a needle", [5.0, 0.05, 0.05]),
            ("a disc", [0.5, 0.4, 0.001]),
            ("a disc of no thickness", [0.5, 0.4, 1e-30]),
        ] {
            let label = format!("{kind}, {case}");
            trial.check(&label, &one(sizes_px, turned, kind), &small, GREEN, 0)?;
        }
        // No accuracy is required, but all numbers stay finite.
        for value in [-80.0, -43.7, 20.0, 44.0, 89.0] {
            let mut model = cloud(&camera, 1.0, kind);
            model.log_scales.iter_mut().step_by(2).for_each(|scales| *scales = [value; 3]);
            trial.check_finite(&format!("{kind}, log-scale {value}"), &model, &camera, GREEN, 0)?;
        }
    }
    Ok(())
}
