//! The scene on the page: one or two models and the dataset whose coordinates they share, if there is one. All threads
//! read it; only the rendering thread has the models themselves.

use std::path::PathBuf;

use super::picture_kind::PictureKind;
use super::row_colours::RowData;
use densify_core::camera::Camera;
use densify_data::dataset::normalise::Normalisation;
use densify_data::dataset::{PointCloud, View};
use densify_data::views::DatasetViews;
use densify_policies::policy::Signal;
use densify_render::Backend;
use densify_run::Run;
use densify_run::finished::{Machine, name_of};
use densify_train::evaluate::Split;

/// Cache of decoded photographs `[bytes]`; there is none beside a run in training, whose memory is limited.
const PHOTOGRAPH_CACHE: u64 = 64 << 20;

const NO_COUNTS: &str = "GPU backends do not count them; densify view --backend cpu does";
const NO_CREATION: &str =
    "model files do not store when a Gaussian was created; densify train --view shows it";
const NO_EDITS: &str = "only a run's checkpoint stores when a Gaussian was edited, and this model has none; \
densify train --view shows it";
const NO_SURFACE: &str =
    "it is not measured during training; densify view does, once a model is saved";
const NO_PHOTOGRAPHS: &str = "there are no photographs; name their dataset with --scene";
const NO_TRAINING_VIEWS: &str =
    "it is measured in training photographs, and there are none; name their dataset with --scene";
pub(super) const NO_MODEL: &str = "these points are not a trained model";

/// A model of the scene, without its Gaussians.
pub(super) struct ModelInfo {
    /// The name shown on the page.
    pub(super) name: String,
    /// Number of Gaussians when the page opened.
    pub(super) rows: usize,
    pub(super) sh_degree: u8,
    /// Near plane `[scene units]`.
    pub(super) near: f32,
    /// The run's checkpoint of this iteration, if it exists.
    pub(super) checkpoint: Option<PathBuf>,
}

#[cfg(test)]
impl ModelInfo {
    /// A model of degree 0.
    pub(super) fn sample(rows: usize) -> Self {
        Self { name: "a".into(), rows, sh_degree: 0, near: 0.1, checkpoint: None }
    }
}

/// A scene with the backends that render its models.
pub struct LoadedScene {
    pub(super) scene: Scene,
    /// One backend per model, in the same order.
    pub(super) backends: Vec<Box<dyn Backend>>,
}

/// The scene, without the models' Gaussians.
pub(super) struct Scene {
    pub(super) machine: Machine,
    /// The title of the page.
    pub(super) title: String,
    /// One model, or two to compare.
    pub(super) models: Vec<ModelInfo>,
    /// Kinds of pictures that this scene cannot show, with the reasons.
    pub(super) unavailable: Vec<(PictureKind, String)>,
    /// Maximum size of a picture `[px]`: beside a run in training, memory is planned for no larger one.
    pub(super) largest: Option<(u32, u32)>,
    pub(super) normalisation: Normalisation,
    pub(super) background: [f32; 3],
    /// The test views and the training views of the dataset.
    pub(super) views: [Vec<View>; 2],
    photographs: [DatasetViews; 2],
    /// The dataset's points in scene coordinates; moved into the description.
    pub(super) points: PointCloud,
    /// The first camera of a scene without views.
    pub(super) start: Option<Camera>,
}

impl LoadedScene {
    /// Adds a model and its backend.
    pub(super) fn add(&mut self, model: ModelInfo, mut backend: Box<dyn Backend>) {
        if !counts_rows(&mut *backend) {
            self.scene.mark_unavailable(&[PictureKind::Count], NO_COUNTS);
        }
        if model.checkpoint.is_none() {
            self.scene.mark_unavailable(&[PictureKind::RowEdit], NO_EDITS);
        }
        self.scene.models.push(model);
        self.backends.push(backend);
    }

    /// Name and number of Gaussians of each model.
    pub fn models(&self) -> impl Iterator<Item = (&str, usize)> {
        self.scene.models.iter().map(|model| (&*model.name, model.rows))
    }
}

impl Scene {
    pub(super) fn new(
        machine: Machine,
        title: String,
        normalisation: Normalisation,
        background: [f32; 3],
        views: [Vec<View>; 2],
        points: PointCloud,
    ) -> Self {
        let space = (normalisation, background);
        let mut scene = Self::with_cache(PHOTOGRAPH_CACHE, machine, title, space, views, points);
        scene.mark_unavailable(&[PictureKind::RowAge], NO_CREATION);
        if scene.views[1].is_empty() {
            scene.mark_unavailable(
                &[PictureKind::RowGradient, PictureKind::RowWeight, PictureKind::RowInFront],
                NO_TRAINING_VIEWS,
            );
        }
        scene
    }

    /// Like [`new`](Self::new), with a cache of this many bytes for decoded photographs.
    fn with_cache(
        cache: u64,
        machine: Machine,
        title: String,
        (normalisation, background): (Normalisation, [f32; 3]),
        [test, train]: [Vec<View>; 2],
        points: PointCloud,
    ) -> Self {
        let has_views = !(test.is_empty() && train.is_empty());
        let photographs = |views: &Vec<View>| DatasetViews::new(views.clone(), cache, 1);
        let mut scene = Self {
            machine,
            title,
            models: Vec::new(),
            unavailable: Vec::new(),
            largest: None,
            normalisation,
            background,
            photographs: [photographs(&test), photographs(&train)],
            views: [test, train],
            points,
            start: None,
        };
        if !has_views {
            scene.mark_unavailable(
                &[PictureKind::Photograph, PictureKind::Difference],
                NO_PHOTOGRAPHS,
            );
        }
        scene
    }

    /// The scene of a run in training, which the run's own backend renders, in pictures no larger than the photographs.
    pub(super) fn of_run(run: &mut Run) -> Self {
        let counts = counts_rows(run.trainer.backend());
        let (rows, signals) = (run.trainer.rows(), run.trainer.signals());
        let points = std::mem::take(&mut run.dataset.points);
        let (config, dataset) = (&run.config, &run.dataset);
        let title = name_of(&config.scene_path());
        let background = config.spec.data.background.fixed();
        let policy = &config.spec.density.policy;
        let models = vec![ModelInfo {
            name: format!("{policy}, in training"),
            rows,
            sh_degree: config.sh_degree,
            near: 0.0,
            checkpoint: None,
        }];
        let views = [dataset.test.clone(), dataset.train.clone()];
        let space = (dataset.normalisation, background);
        let scene = Self::with_cache(0, Machine::default(), title, space, views, points);
        let mut scene = Self { models, largest: Some(dataset.largest_image()), ..scene };
        if !counts {
            scene.mark_unavailable(&[PictureKind::Count], NO_COUNTS);
        }
        scene.mark_unavailable(&[PictureKind::RowInFront], NO_SURFACE);
        let unmeasured = format!(
            "the policy {policy} does not measure it; densify view does, once a model is saved"
        );
        if (RowData { signals, ..RowData::default() }).gradient().is_none() {
            scene.mark_unavailable(&[PictureKind::RowGradient], &unmeasured);
        }
        if !signals.contains(Signal::WeightMax) {
            scene.mark_unavailable(&[PictureKind::RowWeight], &unmeasured);
        }
        scene
    }

    /// Marks kinds of pictures as unavailable; replaces earlier reasons.
    pub(super) fn mark_unavailable(&mut self, kinds: &[PictureKind], reason: &str) {
        self.unavailable.retain(|(kind, _)| !kinds.contains(kind));
        self.unavailable.extend(kinds.iter().map(|&kind| (kind, reason.to_owned())));
    }

    /// A view of this split.
    pub(super) fn view(&self, split: Split, number: usize) -> &View {
        &self.views[split as usize][number]
    }

    /// The photographs of this split.
    pub(super) fn photographs(&self, split: Split) -> &DatasetViews {
        &self.photographs[split as usize]
    }
}

/// True if the backend can count the Gaussians blended into each pixel.
fn counts_rows(backend: &mut dyn Backend) -> bool {
    backend.inspect().is_ok_and(|inspect| inspect.counts_rows())
}
