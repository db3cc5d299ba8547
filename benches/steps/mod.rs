//! The training steps that the benchmarks measure, and their scenes.

use std::time::Duration;

use densify::core::camera::Camera;
use densify::core::gaussians::{Gaussians, sh_coefficients};
use densify::core::image::Image8;
use densify::render::{LearningRates, StepInput};
use densify_policies::policy::{Cadence, LossTerms};
use glam::{DMat3, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A random cloud of Gaussians in front of the camera. Their size depends on their number such that there are as
/// many tile entries per row as in a trained scene: about 3 at 10,000 rows and 256² px, 2.7 at 50,000 rows and
/// 512² px.
pub(crate) fn scene(rows: usize, sh_degree: u8) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(rows as u64);
    let mut uniform = |from: f32, to: f32| rng.random_range(from..to);
    let size = 0.0222 * (10_000.0 / rows as f32).powf(0.5);
    let mut model = Gaussians { sh_degree, ..Gaussians::default() };
    for _ in 0..rows {
        model.means.push([0, 1, 2].map(|_| uniform(-1.0, 1.0)));
        model.log_scales.push([0, 1, 2].map(|_| (size * uniform(0.3, 1.5)).ln()));
        model.quats.push([0, 1, 2, 3].map(|_| uniform(-1.0, 1.0)));
        model.opacity_logits.push(uniform(-2.0, 2.5));
        model.sh.extend((0..3 * sh_coefficients(sh_degree)).map(|_| uniform(-0.3, 0.5)));
    }
    model
}

/// A camera at distance 3 from the centre of the cloud, with a square image of side `size` `[px]`.
pub(crate) fn camera(size: u32) -> Camera {
    let f = f64::from(size);
    Camera {
        width: size,
        height: size,
        fx: f,
        fy: f,
        cx: 0.5 * f,
        cy: 0.5 * f,
        rotation: DMat3::IDENTITY,
        translation: DVec3::new(0.0, 0.0, 3.0),
    }
}

/// A square photograph of random pixels.
pub(crate) fn target(size: u32) -> Image8 {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let rgb = (0..3 * size * size).map(|_| rng.random::<u8>()).collect();
    Image8 { width: size, height: size, rgb, alpha: None, mask: None }
}

const RATES: LearningRates = LearningRates {
    mean: 1e-6,
    noise: 1e-6,
    log_scale: 1e-6,
    quat: 1e-6,
    opacity: 1e-6,
    sh_dc: 1e-6,
    sh_rest: 1e-6,
};

/// The input of one training step.
pub(crate) fn input<'a>(step: u32, camera: &'a Camera, target: &'a Image8) -> StepInput<'a> {
    StepInput {
        step,
        view: 0,
        camera,
        target,
        background: [0.0; 3],
        exposure: None,
        pose: false,
        vignette: None,
        depth: None,
        distortion: 0.0,
        sh_degree: 3,
        rates: RATES,
        loss_terms: LossTerms::default(),
        noise: None,
        cadence: Cadence::default(),
        seed: 1,
    }
}

/// Number of training steps to run; the first two are not measured.
pub(crate) fn step_count(rows: usize) -> u32 {
    (6_000_000 / rows).clamp(7, 60) as u32
}

pub(crate) fn median(mut times: Vec<Duration>) -> Duration {
    times.sort();
    times[times.len() / 2]
}

pub(crate) fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}
