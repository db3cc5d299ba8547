//! Few rows, rows at one place, and invisible rows.

use densify_policies::plan::EditPlan;

use super::{GREEN, UPRIGHT, axis_camera, flat_colour, shade};
use crate::compare::class;
use crate::reference::CLASSES;
use crate::scenes;
use crate::trial::{Trial, count_non_finite, step};
use densify_core::gaussians::Gaussians;
use densify_render::{BackendError, Setup};

const BACKGROUND: [f32; 3] = [0.25, 0.5, 0.75];

/// Number of pixels that differ from the background, and of nonzero values of alpha and depth.
fn count_drawn(image: &densify_render::Rendering) -> usize {
    let coloured = image.rgb.chunks_exact(3).filter(|rgb| **rgb != BACKGROUND).count();
    coloured + image.alpha.iter().chain(&image.depth).filter(|v| v.to_bits() != 0).count()
}

pub(super) fn no_row(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(21, 13, 1);
    let model = Gaussians { sh_degree: 2, ..Gaussians::default() };
    let mut backend =
        trial.subject.backend_with(&model, Setup { budget: 3.into(), ..Setup::default() })?;
    let upstream = scenes::narrowed(&scenes::upstream(&camera, 1));
    let (image, gradient) = backend.differentiate(&camera, BACKGROUND, 2, &upstream)?;
    trial.count("0 Gaussians", "pixels other than the background", count_drawn(&image));
    let numbers = CLASSES.iter().map(|name| class(&gradient, name).len()).sum();
    trial.count("0 Gaussians", "gradients", numbers);
    let target = scenes::target(&camera);
    let output = step(&mut *backend, 1, &camera, &target, BACKGROUND, 2)?;
    backend.apply(&EditPlan::new(0, 3).compile(), 1, 1)?;
    let unsound = backend.audit()?.len() + count_non_finite(&[&[output.loss, output.ssim]]);
    let broken = backend.rows() + unsound;
    trial.count("0 Gaussians", "Gaussians or broken numbers after a step and an edit", broken);
    Ok(())
}

pub(super) fn one_row(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = axis_camera(64, 64);
    for scale in [0.01, 0.1, 1.0] {
        let mut model = Gaussians::default();
        scenes::push(&mut model, [0.0, 0.0, 2.0], [scale; 3], UPRIGHT, 0.0, flat_colour);
        trial.check(&format!("standard deviation {scale}"), &model, &camera, GREEN, 0)?;
    }
    Ok(())
}

pub(super) fn duplicates(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(24, 18, 2);
    let place = scenes::world(&camera, [0.05, -0.02, 2.0]);
    for rows in [2_usize, 3, 10_000] {
        let mut model = Gaussians::default();
        for row in 0..rows {
            scenes::push(&mut model, place, [0.3, 0.2, 0.4], UPRIGHT, -2.0, shade(row));
        }
        trial.check(&format!("{rows} Gaussians"), &model, &camera, GREEN, 0)?;
    }
    Ok(())
}

pub(super) fn invisible(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(40, 30, 3);
    let mut model = scenes::cloud(20, 1, &camera, 4);
    // σ(−5.6) = 0.0037, below 1/255.
    model.opacity_logits.fill(-5.6);
    let mut backend = trial.subject.backend(&model)?;
    let upstream = scenes::narrowed(&scenes::upstream(&camera, 1));
    let (image, gradient) = backend.differentiate(&camera, BACKGROUND, 1, &upstream)?;
    trial.count("all Gaussians", "pixels other than the background", count_drawn(&image));
    let gradients = CLASSES.iter().flat_map(|name| class(&gradient, name));
    let nonzero = gradients.filter(|g| **g != 0.0).count();
    trial.count("all Gaussians", "gradients of invisible Gaussians", nonzero);
    trial.train("all Gaussians", &mut *backend, &camera, BACKGROUND, 1)
}
