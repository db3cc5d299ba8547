//! Per-Gaussian training signals of a finished model, measured in the training views of its scene. Each view gets a
//! training step with learning rates of zero. A few views are measured per picture, so that the page shows a first
//! result at once.

use std::time::{Duration, Instant};

use densify_policies::adc::mean_over_views;
use densify_policies::policy::{Cadence, LossTerms, Needs, Signal, SignalSet};

use super::scene::{ModelInfo, Scene};
use densify_data::views::ViewSource;
use densify_render::{AuxInput, Backend, LearningRates, StepInput};
use densify_run::failure::Failure;
use densify_train::evaluate::Split;
use densify_train::in_front::{self, MARGIN, RowWeights};
use densify_train::schedule::view_order;

/// The measured signals.
const SIGNALS: [Signal; 3] = [Signal::ScreenGradient, Signal::VisibleCount, Signal::WeightMax];

/// The measurements so far.
pub(super) struct RowMeasurements {
    /// The backend that measures; dropped after the last view.
    backend: Option<Box<dyn Backend>>,
    /// The order of the views.
    order: Vec<usize>,
    /// Number of views measured.
    seen: usize,
    /// Mean gradient of the projected centre over the views. Shape: `[rows]`.
    pub(super) gradient: Vec<f32>,
    /// Largest weight in any pixel, in `[0, 1]`. Shape: `[rows]`.
    pub(super) weight: Vec<f32>,
    /// Weights in front of the surface, and whole ones. Shape: `[rows]`.
    in_front: Vec<RowWeights>,
}

impl std::fmt::Debug for RowMeasurements {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [seen, all] = self.progress();
        write!(f, "RowMeasurements in {seen} of {all} views")
    }
}

impl RowMeasurements {
    /// Prepares to measure the model of this backend.
    pub(super) fn new(
        scene: &Scene,
        model: &ModelInfo,
        backend: &dyn Backend,
    ) -> Result<Self, Failure> {
        let aux = Some(in_front::request(MARGIN));
        let needs = Needs { signals: SIGNALS.into(), aux, ..Needs::default() };
        let gaussians = backend.download()?;
        let mut backend = scene.machine.backend_to_measure(&gaussians, model.near, needs)?;
        backend.begin_epoch();
        let (views, rows) = (scene.photographs(Split::Train).count(), gaussians.len());
        Ok(Self {
            backend: Some(backend),
            order: view_order(views, 0, 0),
            seen: 0,
            gradient: vec![0.0; rows],
            weight: vec![0.0; rows],
            in_front: vec![RowWeights::default(); rows],
        })
    }

    /// Number of measured views, and number of all views.
    pub(super) fn progress(&self) -> [usize; 2] {
        [self.seen, self.order.len()]
    }

    /// Measures at least one more view, and further ones until `duration` has passed.
    pub(super) fn measure_more(
        &mut self,
        scene: &Scene,
        sh_degree: u8,
        duration: Duration,
    ) -> Result<(), Failure> {
        let Some(backend) = &mut self.backend else { return Ok(()) };
        let (begun, views) = (Instant::now(), scene.photographs(Split::Train));
        while let Some(&view) = self.order.get(self.seen) {
            let ahead = &self.order[self.seen + 1..self.order.len().min(self.seen + 3)];
            views.prefetch(ahead);
            let image = views.image(view).map_err(Failure::input)?;
            let input = StepInput {
                step: self.seen as u32 + 1,
                view,
                camera: views.camera(view),
                target: &image,
                background: scene.background,
                exposure: None,
                pose: false,
                vignette: None,
                depth: None,
                distortion: 0.0,
                sh_degree,
                rates: LearningRates::default(),
                loss_terms: LossTerms::default(),
                noise: None,
                cadence: Cadence::default(),
                seed: 0,
            };
            backend.train_step(&input)?;
            let measured = backend.observe(&AuxInput {
                step: input.step,
                view,
                seed: 0,
                camera: input.camera,
                target: &image,
                background: scene.background,
                exposure: None,
                vignette: None,
                sh_degree,
                depth: None,
                request: &in_front::request(MARGIN),
            })?;
            in_front::add(&mut self.in_front, &measured);
            self.seen += 1;
            if begun.elapsed() >= duration {
                break;
            }
        }
        let taken = backend.take_signals(SignalSet::from(SIGNALS))?;
        let get = |signal| taken.get(signal).unwrap_or_default();
        self.gradient = mean_over_views(get(Signal::ScreenGradient), get(Signal::VisibleCount));
        self.weight = get(Signal::WeightMax).to_vec();
        backend.give_back(taken);
        if self.seen == self.order.len() {
            self.backend = None;
        }
        Ok(())
    }

    /// The share of each Gaussian's weight that is in front of the surface, in `[0, 1]`. Shape: `[rows]`.
    pub(super) fn shares_in_front(&self) -> Vec<f32> {
        self.in_front.iter().map(|weights| weights.share() as f32).collect()
    }

    /// Completed measurements with these values; the share of each row in front of the surface is its weight.
    #[cfg(test)]
    pub(super) fn from_values(gradient: Vec<f32>, weight: Vec<f32>) -> Self {
        let in_front = |&weight: &f32| RowWeights {
            in_front: f64::from(weight * weight),
            whole: weight.into(),
        };
        let in_front = weight.iter().map(in_front).collect();
        Self { backend: None, order: Vec::new(), seen: 0, gradient, weight, in_front }
    }
}

#[cfg(test)]
mod tests {
    use image::{Rgb, RgbImage};
    use serde_json::json;

    use super::*;
    use crate::open::scene_of;
    use densify_core::gaussians::{Gaussians, logit};
    use densify_render::{Device, Setup};

    #[test]
    fn every_view_is_measured_and_the_model_stays_unchanged() {
        let folder = tempfile::tempdir().expect("a folder");
        // Two cameras, back to back.
        let mut frames = Vec::new();
        for (name, side) in [("a.png", 1.0), ("b.png", -1.0)] {
            let noise =
                |x: u32, y: u32| Rgb([(x * 37 + y * 91) as u8, (x * y * 7) as u8, (x * 11) as u8]);
            RgbImage::from_fn(48, 48, noise).save(folder.path().join(name)).expect("a PNG");
            let pose = [
                [side, 0.0, 0.0, 0.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, side, side],
                [0.0, 0.0, 0.0, 1.0],
            ];
            frames.push(json!({ "file_path": name, "transform_matrix": pose }));
        }
        let transforms = json!({ "w": 48, "h": 48, "fl_x": 50, "fl_y": 50, "cx": 24, "cy": 24, "frames": frames });
        std::fs::write(folder.path().join("transforms.json"), transforms.to_string())
            .expect("a file");
        let scene = scene_of(folder.path());
        // A Gaussian in front of each camera.
        let mut model = Gaussians::zeros(2, 0);
        for row in 0..2 {
            let camera = scene.view(Split::Train, row).camera;
            model.means[row] = (camera.centre() + 2.0 * camera.forward()).as_vec3().to_array();
            model.log_scales[row] = [-2.0, -1.7, -1.4];
            model.quats[row] = [1.0, 0.0, 0.0, 0.0];
            model.opacity_logits[row] = logit(0.8);
        }
        let backend = Device::default().backend(&model, &Setup::new(2)).expect("a backend");
        let info = ModelInfo::sample(2);
        let mut measured = RowMeasurements::new(&scene, &info, &*backend).expect("a backend");
        assert_eq!(measured.progress(), [0, 2]);
        let positive = |values: &[f32]| values.iter().filter(|&&value| value > 0.0).count();
        for views in 1..=2 {
            measured.measure_more(&scene, 0, Duration::ZERO).expect("a view");
            assert_eq!(measured.progress(), [views, 2]);
            let found = [positive(&measured.weight), positive(&measured.gradient)];
            assert_eq!(found, [views; 2], "{measured:?}");
            let unfinished =
                measured.backend.as_ref().map(|backend| backend.download().expect("a model"));
            assert_eq!(unfinished.is_none(), views == 2, "the backend outlives the last view");
            assert!(unfinished.is_none_or(|rest| rest == model), "measuring changed the model");
        }
        let before = (measured.weight.clone(), measured.gradient.clone());
        measured.measure_more(&scene, 0, Duration::ZERO).expect("nothing to do");
        assert_eq!((&measured.weight, &measured.gradient), (&before.0, &before.1));
        assert_eq!(measured.shares_in_front(), [0.0; 2]);
        let weights = &measured.weight;
        assert!(weights.iter().all(|weight| (0.5..=1.0).contains(weight)), "{weights:?}");
    }
}
