//! Finds the pose of a test view on a model that stays as it is, as InstantSplat does before it measures.

use densify_core::camera::Camera;
use densify_core::image::Image8;
use densify_core::pose::Twist;
use densify_policies::policy::{Cadence, LossTerms};
use densify_render::{Backend, BackendError, LearningRates, StepInput};

use super::adam::{Adam, FADE};

/// Number of gradient steps; each costs as much as a step of training.
const STEPS: u32 = 60;
/// Step size at the start of rotations `[radians]`, and of translations `[fraction of the scene's extent]`.
const RATE: f64 = 1e-3;

/// The camera near `camera` from which the model looks most like the photograph. `view` is a camera of an evaluation;
/// the backend must have been set up for poses.
///
/// # Errors
/// See [`BackendError`].
pub fn fitted_camera(
    backend: &mut dyn Backend,
    camera: &Camera,
    photograph: &Image8,
    background: [f32; 3],
    sh_degree: u8,
) -> Result<Camera, BackendError> {
    let mut adam = Adam::default();
    let (mut best, mut least) = (*camera, f32::INFINITY);
    let mut at = *camera;
    for step in 0..=STEPS {
        let output = backend.differentiate_pose(&StepInput {
            step: 1,
            view: 0,
            camera: &at,
            target: photograph,
            background,
            exposure: None,
            vignette: None,
            pose: true,
            depth: None,
            distortion: 0.0,
            sh_degree,
            rates: LearningRates::default(),
            loss_terms: LossTerms::default(),
            noise: None,
            cadence: Cadence::default(),
            seed: 0,
        })?;
        if output.loss < least {
            (best, least) = (at, output.loss);
        }
        let rate = RATE * FADE.powf(f64::from(step) / f64::from(STEPS));
        let extent = densify_data::dataset::EXTENT;
        let by = output.pose.and_then(|gradient| adam.step(&gradient, [rate * extent, rate]));
        at = at.moved(&by.unwrap_or(Twist::default()));
    }
    Ok(best)
}
