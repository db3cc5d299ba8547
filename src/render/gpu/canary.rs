//! The canary: before a device trains, two steps on a small fixed scene are compared with the native backend, so that a
//! driver that miscompiles a kernel causes an error instead of a bad model.

use densify_policies::policy::{Cadence, LossTerms, Needs};
use densify_policies::rng::{PolicyRng, Purpose};
use glam::{DMat3, DVec3};

use super::{GpuBackend, GpuDevice};
use crate::cpu::CpuBackend;
use crate::signals::RecordLayout;
use crate::{
    Backend, BackendError, DepthTarget, DepthTerm, LearningRates, Setup, StepInput, StepOutput,
    Storage,
};
use densify_core::antialiasing::Antialiasing;
use densify_core::camera::Camera;
use densify_core::gaussians::{Gaussians, sh_coefficients};
use densify_core::image::Image8;
use densify_core::image::depth::DepthMap;

const ROWS: u32 = 60;
const SIZE: u32 = 40;
const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.4];
/// Largest difference of a colour: rounding stays below 1e-5, but a splat at the threshold of 1/255 may or may not
/// appear in a pixel.
const TOLERANCE: f32 = 6e-3;
/// Largest difference of a loss.
const LOSS_TOLERANCE: f32 = 1e-3;

/// Rows of all sizes and opacities in front of a camera, some outside of its image and behind it.
fn scene() -> (Gaussians, Camera, Image8) {
    let rng = PolicyRng::new(17, 1);
    let draw = |row, counter| rng.normal3(row, Purpose::Noise, counter);
    let per_row = 3 * sh_coefficients(1) as u32;
    let model = Gaussians {
        sh_degree: 1,
        origin: [0.0; 3],
        antialiasing: Antialiasing::None,
        means: (0..ROWS).map(|row| draw(row, 0)).map(|[x, y, z]| [0.6 * x, 0.6 * y, z]).collect(),
        log_scales: (0..ROWS).map(|row| draw(row, 1).map(|s| 0.5 * s - 2.0)).collect(),
        quats: (0..ROWS)
            .map(|row| draw(row, 2))
            .map(|[x, y, z]| [1.0, 0.5 * x, 0.5 * y, 0.5 * z])
            .collect(),
        opacity_logits: (0..ROWS).map(|row| draw(row, 3)[0]).collect(),
        sh: (0..ROWS)
            .flat_map(|row| (0..per_row).map(move |k| (row, k)))
            .map(|(row, k)| 0.3 * draw(row, 4 + k)[0])
            .collect(),
    };
    let camera = Camera {
        width: SIZE,
        height: SIZE - 7,
        fx: 45.0,
        fy: 43.0,
        cx: 19.0,
        cy: 17.0,
        rotation: DMat3::IDENTITY,
        translation: DVec3::new(0.1, -0.1, 2.5),
    };
    let rgb = (0..3 * camera.width * camera.height).map(|i| (i * 31 % 253) as u8).collect();
    let target =
        Image8 { width: camera.width, height: camera.height, rgb, alpha: None, mask: None };
    (model, camera, target)
}

/// Depth given in half of the pixels, in front of and behind the rows.
fn given_depth(camera: &Camera) -> DepthMap {
    let (width, height) = (camera.width, camera.height);
    let confidence = |pixel: u32| if pixel.is_multiple_of(2) { 255 } else { 0 };
    DepthMap {
        width,
        height,
        inverse: (0..width * height).map(|pixel| 200 + (pixel * 37 % 600) as u16).collect(),
        confidence: (0..width * height).map(confidence).collect(),
        unit: 1e-3,
        median: 2.0,
    }
}

/// Trains two steps, with depth in the loss if a map is given, and renders.
fn run(
    backend: &mut dyn Backend,
    camera: &Camera,
    target: &Image8,
    map: Option<&DepthMap>,
) -> Result<(Vec<StepOutput>, Vec<f32>), BackendError> {
    let rates = LearningRates {
        mean: 5e-3,
        noise: 5e-3,
        log_scale: 0.05,
        quat: 0.01,
        opacity: 0.3,
        sh_dc: 0.1,
        sh_rest: 0.02,
    };
    let mut outputs = Vec::new();
    for step in 1..=2 {
        outputs.push(backend.train_step(&StepInput {
            step,
            view: 0,
            camera,
            target,
            background: BACKGROUND,
            exposure: None,
            pose: false,
            vignette: None,
            depth: map.map(|map| {
                let term = if step == 1 { DepthTerm::Expected } else { DepthTerm::Samples };
                DepthTarget { map, weight: 1.0, term }
            }),
            distortion: if map.is_some() { 1.0 } else { 0.0 },
            sh_degree: 1,
            rates,
            loss_terms: LossTerms::default(),
            noise: None,
            cadence: Cadence::default(),
            seed: 1,
        })?);
    }
    Ok((outputs, backend.render(camera, BACKGROUND, 1)?.rgb))
}

impl GpuBackend {
    /// Runs the canary, allocates all buffers for `options.budget` rows, and uploads the model.
    ///
    /// # Errors
    /// [`BackendError`]: a limit of the device, its memory, or a driver that computes wrongly.
    ///
    /// # Panics
    /// When the model has more rows than the budget: a bug in the caller.
    pub fn new(
        model: &Gaussians,
        options: &Setup,
        device: &GpuDevice,
    ) -> Result<Self, BackendError> {
        device.run_canary(&options.needs, options.storage, options.depth)?;
        Self::without_canary(model, options, device)
    }
}

impl GpuDevice {
    /// Compares the device with the native backend, once per set of kernels that a policy's signals and pixel term, the
    /// storage of numbers and depth in the loss require. Afterwards the memory of the process includes the driver's.
    ///
    /// # Errors
    /// As [`GpuBackend::new`].
    pub fn run_canary(
        &self,
        needs: &Needs,
        storage: Storage,
        depth: bool,
    ) -> Result<(), BackendError> {
        let kernels = (RecordLayout::new(needs.signals, depth), storage, needs.pixel_loss);
        self.0.check_once(kernels, || check(self, needs, storage, depth))
    }
}

/// Compares the device with the native backend, with the kernels that these needs and this storage require.
///
/// # Errors
/// [`BackendError::Device`] with the difference.
fn check(
    device: &GpuDevice,
    needs: &Needs,
    storage: Storage,
    depth: bool,
) -> Result<(), BackendError> {
    let (model, camera, target) = scene();
    let mut options = Setup { threads: Some(1), storage, depth, ..Setup::new(model.len()) };
    options.needs.pixel_loss = needs.pixel_loss;
    let mut cpu = CpuBackend::new(&model, &options)?;
    options.largest_image = (camera.width, camera.height);
    options.needs.signals = needs.signals;
    let mut gpu = GpuBackend::without_canary(&model, &options, device)?;
    let map = depth.then(|| given_depth(&camera));
    let (expected, image) = run(&mut cpu, &camera, &target, map.as_ref())?;
    let (found, rendered) = run(&mut gpu, &camera, &target, map.as_ref())?;
    let wrong = |difference: String| BackendError::Device {
        device: device.adapter().name.clone(),
        why: format!("its driver computes wrongly: {difference}"),
    };
    for (step, (found, expected)) in found.iter().zip(&expected).enumerate() {
        // `<=`, so that NaN counts as a difference.
        let depths = [found, expected].map(|output| output.depth.unwrap_or_default());
        let is_close = (found.loss - expected.loss).abs() <= LOSS_TOLERANCE
            && (depths[0] - depths[1]).abs() <= LOSS_TOLERANCE;
        if !is_close || found.visible != expected.visible {
            return Err(wrong(format!(
                "at step {} of a test scene: loss {}, depth term {}, {} rows on screen; expected: loss {}, depth term \
                 {}, {} rows",
                step + 1,
                found.loss,
                depths[0],
                found.visible,
                expected.loss,
                depths[1],
                expected.visible
            )));
        }
    }
    let off = rendered.iter().zip(&image).filter(|(a, b)| {
        let is_close = (**a - **b).abs() <= TOLERANCE;
        !is_close
    });
    match off.count() {
        0 => Ok(()),
        n => Err(wrong(format!("{n} of {} colours of a test image differ", image.len()))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scene_exercises_the_kernels() {
        let (model, camera, target) = scene();
        let options = Setup { threads: Some(1), ..Setup::new(model.len()) };
        let mut cpu = CpuBackend::new(&model, &options).unwrap();
        let (outputs, _) = run(&mut cpu, &camera, &target, None).unwrap();
        // Visible and invisible rows, several tiles, and steps whose effect exceeds the tolerance.
        assert!(outputs[0].visible > 30 && outputs[0].visible < model.len(), "{outputs:?}");
        assert!(outputs[0].entries > 100, "{outputs:?}");
        assert!(outputs[0].loss - outputs[1].loss > 3.0 * LOSS_TOLERANCE, "{outputs:?}");
    }
}
