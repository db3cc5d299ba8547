//! What is looked at: one model or two, in the coordinates of a dataset where there is one. All threads read it; the
//! models themselves are with the one that renders.

use std::path::PathBuf;

use super::kinds::Kind;
use super::paint::Known;
use densify_core::camera::Camera;
use densify_data::dataset::normalise::Normalisation;
use densify_data::dataset::{PointCloud, View};
use densify_data::views::DatasetViews;
use densify_policies::policy::Signal;
use densify_render::Backend;
use densify_run::Run;
use densify_run::finished::{Machine, name_of};
use densify_train::evaluate::Split;

/// Decoded photographs that are kept `[bytes]`, where a promise does not say how much may be held.
const KEPT_PHOTOGRAPHS: u64 = 64 << 20;

const NO_COUNTS: &str = "they are not counted on a GPU; densify view --backend cpu counts them";
const NO_BIRTHS: &str =
    "no file says when a Gaussian was made; densify train --view shows it while a run trains";
const NO_EDITS: &str = "only a run's checkpoint says when a Gaussian was edited, and there is none of this model; \
                        densify train --view shows it while a run trains";
const NO_PHOTOGRAPHS: &str = "no photographs are known; name their dataset with --scene";
const NO_TRAINING_VIEWS: &str =
    "it is measured in training photographs, and none are known; name their dataset with --scene";
pub(super) const NO_MODEL: &str = "points are not a model yet";

/// A model that is shown.
pub(super) struct Shown {
    /// What the page calls it.
    pub(super) name: String,
    /// When the page opened.
    pub(super) rows: usize,
    pub(super) sh_degree: u8,
    /// Near plane `[scene units]`.
    pub(super) near: f32,
    /// What the run that has it can go on from, where that is kept.
    pub(super) checkpoint: Option<PathBuf>,
}

/// What is looked at, with the models.
pub struct Exhibition {
    pub(super) stage: Stage,
    /// What renders the models, in their order.
    pub(super) backends: Vec<Box<dyn Backend>>,
}

/// Everything that is looked at, but the models' rows.
pub(super) struct Stage {
    pub(super) machine: Machine,
    /// What the page calls it.
    pub(super) title: String,
    /// One or two.
    pub(super) models: Vec<Shown>,
    /// The kinds of pictures that cannot be made of it, with the reasons.
    pub(super) lacking: Vec<(Kind, String)>,
    /// The largest picture that may be rendered, where a promise holds: that of training.
    pub(super) largest: Option<(u32, u32)>,
    pub(super) normalisation: Normalisation,
    pub(super) background: [f32; 3],
    /// The views of the dataset, in its order: those held out, those trained on.
    pub(super) views: [Vec<View>; 2],
    photographs: [DatasetViews; 2],
    /// Points that the dataset brings, in scene coordinates, until they are part of the description.
    pub(super) points: PointCloud,
    /// Where to look from at first, where there are no views.
    pub(super) start: Option<Camera>,
}

/// What is known of a stage without having it: enough to check a wish.
#[derive(Debug, Clone)]
pub(super) struct Extent {
    pub(super) models: usize,
    /// Number of views of each split.
    pub(super) views: [usize; 2],
    pub(super) normalisation: Normalisation,
    /// The kinds of pictures that cannot be made, with the reasons.
    pub(super) lacking: Vec<(Kind, String)>,
}

impl Exhibition {
    /// Adds a model with what renders it.
    pub(super) fn add(&mut self, shown: Shown, mut backend: Box<dyn Backend>) {
        if !counts_rows(&mut *backend) {
            self.stage.lacks(&[Kind::Count], NO_COUNTS);
        }
        if shown.checkpoint.is_none() {
            self.stage.lacks(&[Kind::RowEdit], NO_EDITS);
        }
        self.stage.models.push(shown);
        self.backends.push(backend);
    }

    /// Names and rows of the models.
    pub fn models(&self) -> impl Iterator<Item = (&str, usize)> {
        self.stage.models.iter().map(|model| (&*model.name, model.rows))
    }
}

impl Stage {
    pub(super) fn new(
        machine: Machine,
        title: String,
        normalisation: Normalisation,
        background: [f32; 3],
        [test, train]: [Vec<View>; 2],
        points: PointCloud,
    ) -> Self {
        let views = [test, train];
        let place = (normalisation, background);
        let mut stage = Self::keeping(KEPT_PHOTOGRAPHS, machine, title, place, views, points);
        stage.lacks(&[Kind::RowAge], NO_BIRTHS);
        if stage.views[1].is_empty() {
            stage.lacks(&[Kind::RowGradient, Kind::RowWeight], NO_TRAINING_VIEWS);
        }
        stage
    }

    /// The same, keeping so many bytes of photographs.
    fn keeping(
        kept: u64,
        machine: Machine,
        title: String,
        (normalisation, background): (Normalisation, [f32; 3]),
        [test, train]: [Vec<View>; 2],
        points: PointCloud,
    ) -> Self {
        let has_views = !(test.is_empty() && train.is_empty());
        let photographs = |views: &Vec<View>| DatasetViews::new(views.clone(), kept, 1);
        let mut stage = Self {
            machine,
            title,
            models: Vec::new(),
            lacking: Vec::new(),
            largest: None,
            normalisation,
            background,
            photographs: [photographs(&test), photographs(&train)],
            views: [test, train],
            points,
            start: None,
        };
        if !has_views {
            stage.lacks(&[Kind::Photograph, Kind::Difference], NO_PHOTOGRAPHS);
        }
        stage
    }

    /// A run in training: rendered by what trains it, and in no larger pictures.
    pub(super) fn of_run(run: &mut Run) -> Self {
        let counts = counts_rows(run.trainer().backend());
        let (rows, signals) = (run.trainer().rows(), run.trainer().signals());
        let points = run.take_points();
        let (config, dataset) = (run.config(), run.dataset());
        let title = name_of(&config.scene_path());
        let background = config.spec.data.background.fixed();
        let policy = &config.spec.density.policy;
        let models = vec![Shown {
            name: format!("{policy}, in training"),
            rows,
            sh_degree: config.sh_degree(),
            near: 0.0,
            checkpoint: None,
        }];
        let views = [dataset.test.clone(), dataset.train.clone()];
        let place = (dataset.normalisation, background);
        let stage = Self::keeping(0, Machine::default(), title, place, views, points);
        let mut stage = Self { models, largest: Some(dataset.largest_image()), ..stage };
        if !counts {
            stage.lacks(&[Kind::Count], NO_COUNTS);
        }
        let unmeasured = format!(
            "the policy {policy} does not measure it; densify view does, once a model has been saved"
        );
        if (Known { signals, ..Known::default() }).gradient().is_none() {
            stage.lacks(&[Kind::RowGradient], &unmeasured);
        }
        if !signals.contains(Signal::WeightMax) {
            stage.lacks(&[Kind::RowWeight], &unmeasured);
        }
        stage
    }

    /// These kinds of pictures cannot be made of it, for this reason, whatever was said before.
    pub(super) fn lacks(&mut self, kinds: &[Kind], why: &str) {
        self.lacking.retain(|(lacking, _)| !kinds.contains(lacking));
        self.lacking.extend(kinds.iter().map(|&kind| (kind, why.to_owned())));
    }

    pub(super) fn extent(&self) -> Extent {
        Extent {
            models: self.models.len(),
            views: [self.views[0].len(), self.views[1].len()],
            normalisation: self.normalisation,
            lacking: self.lacking.clone(),
        }
    }

    /// A view of a split.
    pub(super) fn view(&self, split: Split, number: usize) -> &View {
        &self.views[split as usize][number]
    }

    /// Photographs of a split.
    pub(super) fn photographs(&self, split: Split) -> &DatasetViews {
        &self.photographs[split as usize]
    }
}

fn counts_rows(backend: &mut dyn Backend) -> bool {
    backend.inspect().is_ok_and(|inspect| inspect.counts_rows())
}
