//! Blend weights in views that are rendered for a policy's decision rather than for training.
//!
//! The backward kernel replays the blending of every pixel, so it finds the largest weights here as
//! it does in training; the image's gradient is zero. That is more than a forward pass alone would
//! take, but weights are then the same to the bit as those of training.

use super::rasterize::DARK;
use super::{BackendError, Camera, CpuBackend};

impl CpuBackend {
    /// Counts one more view for `FreshWeightMax`.
    pub(super) fn measure(&mut self, camera: &Camera, sh_degree: u8) -> Result<(), BackendError> {
        if !self.signals.measures() {
            return Ok(());
        }
        // Stage times stay those of training.
        let clock = std::mem::take(&mut self.clock);
        let frame = self.forward(camera, [0.0; 3], sh_degree, false);
        let measured = frame.map(|frame| {
            for gradient in &mut self.gradient {
                gradient.planes = [DARK; 5];
            }
            self.backward(&frame, self.signals.layout());
            let Self { pool, signals, sums, visible, rows, .. } = self;
            pool.install(|| signals.measure(*rows, sums, visible));
        });
        self.clock = clock;
        measured
    }
}

#[cfg(test)]
mod tests {
    use densify_policies::policy::{Cadence, Needs, Signal};
    use densify_policies::rng::{PolicyRng, Purpose};
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::backend::cpu::{CpuOptions, ImageGradient};
    use crate::backend::{Backend, LearningRates, StepInput};
    use crate::dataset::images::Image8;
    use crate::gaussians::Gaussians;

    const ROWS: usize = 70;

    /// Translucent rows before the cameras, some beyond the edges of their images.
    fn model() -> Gaussians {
        let rng = PolicyRng::new(5, 1);
        let rows = 0..ROWS as u32;
        let normal = |row, counter| rng.normal3(row, Purpose::Noise, counter);
        Gaussians {
            sh_degree: 0,
            means: rows
                .clone()
                .map(|row| normal(row, 0))
                .map(|[x, y, z]| [x, y, z * 0.3])
                .collect(),
            log_scales: rows.clone().map(|row| normal(row, 1).map(|v| v * 0.4 - 2.0)).collect(),
            quats: rows.clone().map(|_| [1.0, 0.0, 0.0, 0.0]).collect(),
            opacity_logits: rows.clone().map(|row| normal(row, 2)[0]).collect(),
            sh: rows.flat_map(|row| normal(row, 3)).collect(),
        }
    }

    fn cameras() -> Vec<Camera> {
        let at = |(width, height, x)| Camera {
            width,
            height,
            fx: 50.0,
            fy: 50.0,
            cx: f64::from(width) / 2.0,
            cy: f64::from(height) / 2.0,
            rotation: DMat3::IDENTITY,
            translation: DVec3::new(x, 0.1, 2.0),
        };
        [(50, 40, -0.5), (33, 61, 0.4), (48, 48, 1.2)].map(at).to_vec()
    }

    fn backend(signals: &[Signal], tile_cap: usize) -> (CpuBackend, Needs) {
        let needs = Needs { signals: signals.iter().copied().collect(), ..Needs::default() };
        let options = CpuOptions { tile_cap, needs: needs.clone(), ..CpuOptions::new(ROWS + 9) };
        (CpuBackend::new(&model(), &options).unwrap(), needs)
    }

    fn taken(backend: &mut CpuBackend, needs: &Needs, signal: Signal) -> Vec<u32> {
        let signals = backend.take_signals(needs.signals).unwrap();
        signals.get(signal).unwrap().iter().map(|v| v.to_bits()).collect()
    }

    /// Largest weight of each row in a view.
    fn weights(camera: &Camera) -> Vec<f32> {
        let pixels = (camera.width * camera.height) as usize;
        let upstream = ImageGradient {
            rgb: vec![1.0; 3 * pixels],
            alpha: vec![1.0; pixels],
            depth: vec![1.0; pixels],
        };
        let (mut backend, _) = backend(&[], 10_000);
        backend.differentiate(camera, [0.5; 3], 0, &upstream).unwrap().1.max_weight
    }

    fn train(backend: &mut CpuBackend, step: u32) {
        let camera = cameras()[step as usize % 3];
        let rgb = (0..3 * camera.width * camera.height).map(|i| (i * 7 % 251) as u8).collect();
        let target =
            Image8 { width: camera.width, height: camera.height, rgb, alpha: None, mask: None };
        let rate = 1e-3;
        let rates = LearningRates {
            mean: rate,
            log_scale: rate,
            quat: rate,
            opacity: rate,
            sh_dc: rate,
            sh_rest: rate,
        };
        let background = [0.2; 3];
        let input = StepInput {
            step,
            view: 0,
            camera: &camera,
            target: &target,
            background,
            sh_degree: 0,
            rates,
            cadence: Cadence::default(),
            seed: 1,
            ssim_weight: 1.0,
        };
        backend.train_step(&input).unwrap();
    }

    #[test]
    fn the_largest_weight_over_the_views_measured() {
        use Signal::{FreshWeightMax, MeanGradientX, PixelCount, WeightMax};
        let cameras = cameras();
        let most = |views: &[Camera]| -> Vec<u32> {
            let mut most = vec![0.0_f32; ROWS];
            for view in views {
                for (most, weight) in most.iter_mut().zip(weights(view)) {
                    *most = most.max(weight);
                }
            }
            most.iter().map(|weight| weight.to_bits()).collect()
        };
        let (all, last) = (most(&cameras), most(&cameras[2..]));
        // The views differ, and there are rows that only some of them show.
        assert!(all != last && last.contains(&0) && all != most(&cameras[..2]));
        let requests = [
            &[FreshWeightMax][..],
            &[MeanGradientX, WeightMax, FreshWeightMax],
            &[PixelCount, FreshWeightMax],
        ];
        // The smaller cap takes several bands.
        for (request, cap) in requests.iter().flat_map(|r| [(r, 10_000), (r, 1)]) {
            let (mut backend, needs) = backend(request, cap);
            for camera in &cameras {
                let frame = backend.forward(camera, [0.0; 3], 0, false).unwrap();
                assert_eq!(frame.bands.len() > 1, cap == 1, "{} entries", frame.entries);
                backend.measure_weights(camera, 0).unwrap();
            }
            let what = format!("{request:?}, {cap} entries");
            assert!(taken(&mut backend, &needs, FreshWeightMax) == all, "{what}");
            backend.measure_weights(&cameras[2], 0).unwrap();
            assert!(taken(&mut backend, &needs, FreshWeightMax) == last, "{what}: not forgotten");
            assert!(taken(&mut backend, &needs, FreshWeightMax).iter().all(|&w| w == 0), "{what}");
        }
    }

    #[test]
    fn training_goes_on_as_if_nothing_had_been_measured() {
        let signals = [Signal::ScreenGradient, Signal::WeightMax, Signal::VisibleCount];
        let both = [&signals[..], &[Signal::FreshWeightMax]].concat();
        let ((mut plain, needs), (mut measured, _)) =
            (backend(&signals, 10_000), backend(&both, 10_000));
        for step in 1..=4 {
            train(&mut plain, step);
            train(&mut measured, step);
            let stages = measured.stage_times().to_vec();
            for camera in &cameras() {
                measured.measure_weights(camera, 0).unwrap();
            }
            assert_eq!(measured.stage_times(), stages);
        }
        for signal in signals {
            let expected = taken(&mut plain, &needs, signal);
            assert!(taken(&mut measured, &needs, signal) == expected, "{signal:?}");
        }
        assert_eq!(measured.download().unwrap(), plain.download().unwrap());
    }

    #[test]
    fn where_it_was_not_asked_for_nothing_is_measured() {
        let (mut backend, needs) = backend(&[Signal::WeightMax], 10_000);
        backend.measure_weights(&cameras()[0], 0).unwrap();
        assert!(taken(&mut backend, &needs, Signal::WeightMax).iter().all(|&w| w == 0));
    }
}
