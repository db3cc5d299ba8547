//! What only training knows of the rows of a model, measured anew in the training views of its scene: a step of a
//! length of nothing in each, some at a time, so that who looks does not wait for all.

use std::time::{Duration, Instant};

use densify_policies::adc::mean_over_views;
use densify_policies::policy::{Cadence, LossTerms, Needs, Signal, SignalSet};

use super::stage::{Shown, Stage};
use densify_data::views::ViewSource;
use densify_render::{Backend, LearningRates, StepInput};
use densify_run::failure::Failure;
use densify_train::evaluate::Split;
use densify_train::schedule::view_order;

/// What is measured.
const SIGNALS: [Signal; 3] = [Signal::ScreenGradient, Signal::VisibleCount, Signal::WeightMax];

/// What has been measured so far.
pub(super) struct Measured {
    /// What measures; gone when all is done.
    backend: Option<Box<dyn Backend>>,
    /// In the order in which the views are taken.
    order: Vec<usize>,
    seen: usize,
    /// The mean over the views of the gradient of the projected centre. Shape: `[rows]`.
    pub(super) gradient: Vec<f32>,
    /// The largest weight in any pixel, in `[0, 1]`. Shape: `[rows]`.
    pub(super) weight: Vec<f32>,
}

impl std::fmt::Debug for Measured {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [seen, of] = self.progress();
        write!(f, "Measured in {seen} of {of} views")
    }
}

impl Measured {
    /// Nothing yet, of the model in this backend.
    pub(super) fn new(stage: &Stage, shown: &Shown, model: &dyn Backend) -> Result<Self, Failure> {
        let needs = Needs { signals: SIGNALS.into(), ..Needs::default() };
        let model = model.download()?;
        let mut backend = stage.machine.backend_to_measure(&model, shown.near, needs)?;
        backend.begin_epoch();
        let (views, rows) = (stage.photographs(Split::Train).count(), model.len());
        Ok(Self {
            backend: Some(backend),
            order: view_order(views, 0, 0),
            seen: 0,
            gradient: vec![0.0; rows],
            weight: vec![0.0; rows],
        })
    }

    /// Views that were measured, and all.
    pub(super) fn progress(&self) -> [usize; 2] {
        [self.seen, self.order.len()]
    }

    /// Measures one view, and more as long as this takes no longer.
    pub(super) fn go_on(
        &mut self,
        stage: &Stage,
        sh_degree: u8,
        patience: Duration,
    ) -> Result<(), Failure> {
        let Some(backend) = &mut self.backend else { return Ok(()) };
        let (begun, views) = (Instant::now(), stage.photographs(Split::Train));
        while let Some(&view) = self.order.get(self.seen) {
            let ahead = &self.order[self.seen + 1..self.order.len().min(self.seen + 3)];
            views.prefetch(ahead);
            let image = views.image(view).map_err(Failure::input)?;
            let input = StepInput {
                step: self.seen as u32 + 1,
                view,
                camera: views.camera(view),
                target: &image,
                background: stage.background,
                exposure: None,
                sh_degree,
                rates: LearningRates::STILL,
                loss_terms: LossTerms::default(),
                noise: None,
                cadence: Cadence::default(),
                seed: 0,
            };
            backend.train_step(&input)?;
            self.seen += 1;
            if begun.elapsed() >= patience {
                break;
            }
        }
        let taken = backend.take_signals(SignalSet::from(SIGNALS))?;
        let of = |signal| taken.get(signal).unwrap_or_default();
        self.gradient = mean_over_views(of(Signal::ScreenGradient), of(Signal::VisibleCount));
        self.weight = of(Signal::WeightMax).to_vec();
        backend.give_back(taken);
        if self.seen == self.order.len() {
            self.backend = None;
        }
        Ok(())
    }

    /// As if it had been measured so.
    #[cfg(test)]
    pub(super) fn of(gradient: Vec<f32>, weight: Vec<f32>) -> Self {
        Self { backend: None, order: Vec::new(), seen: 0, gradient, weight }
    }
}

#[cfg(test)]
mod tests {
    use image::{Rgb, RgbImage};
    use serde_json::json;

    use super::*;
    use crate::open::stage_of;
    use densify_core::gaussians::{Gaussians, logit};
    use densify_render::{Device, Setup};

    #[test]
    fn all_views_count_and_the_model_stays_as_it_is() {
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
        let scene = json!({ "w": 48, "h": 48, "fl_x": 50, "fl_y": 50, "cx": 24, "cy": 24, "frames": frames });
        std::fs::write(folder.path().join("transforms.json"), scene.to_string()).expect("a file");
        let stage = stage_of(folder.path());
        // A row before each.
        let mut model = Gaussians::zeros(2, 0);
        for row in 0..2 {
            let camera = stage.view(Split::Train, row).camera;
            model.means[row] = (camera.centre() + 2.0 * camera.forward()).as_vec3().to_array();
            model.log_scales[row] = [-2.0, -1.7, -1.4];
            model.quats[row] = [1.0, 0.0, 0.0, 0.0];
            model.opacity_logits[row] = logit(0.8);
        }
        let backend = Device::default().backend(&model, &Setup::new(2)).expect("a backend");
        let shown = Shown { name: "a".into(), rows: 2, sh_degree: 0, near: 0.1, checkpoint: None };
        let mut measured = Measured::new(&stage, &shown, &*backend).expect("a backend");
        assert_eq!(measured.progress(), [0, 2]);
        let seen = |of: &[f32]| of.iter().filter(|&&number| number > 0.0).count();
        for views in 1..=2 {
            measured.go_on(&stage, 0, Duration::ZERO).expect("a view");
            assert_eq!(measured.progress(), [views, 2]);
            assert_eq!(
                [seen(&measured.weight), seen(&measured.gradient)],
                [views; 2],
                "{measured:?}"
            );
            let measures =
                measured.backend.as_ref().map(|backend| backend.download().expect("a model"));
            assert_eq!(measures.is_none(), views == 2, "what has measured all is kept");
            assert!(measures.is_none_or(|measures| measures == model), "measuring has trained");
        }
        let before = (measured.weight.clone(), measured.gradient.clone());
        measured.go_on(&stage, 0, Duration::ZERO).expect("nothing to do");
        assert_eq!((&measured.weight, &measured.gradient), (&before.0, &before.1));
        assert!(
            measured.weight.iter().all(|weight| (0.5..=1.0).contains(weight)),
            "{:?}",
            measured.weight
        );
    }
}
