//! What is looked at: one model or two, in the coordinates of a dataset where there is one.

use super::paint::Paint;
use crate::backend::{Backend, BackendError};
use crate::camera::Camera;
use crate::dataset::normalise::Normalisation;
use crate::dataset::{PointCloud, View};
use crate::evaluate::Split;
use crate::run::Run;
use crate::run::finished::{Machine, name_of};
use crate::views::DatasetViews;

/// Decoded photographs that are kept `[bytes]`, where a promise does not say how much may be held.
const KEPT_PHOTOGRAPHS: u64 = 64 << 20;

/// A model that is shown.
pub(super) struct Shown {
    /// What the page calls it.
    pub(super) name: String,
    /// When the page opened.
    pub(super) rows: usize,
    pub(super) sh_degree: u8,
    /// Near plane `[scene units]`.
    pub(super) near: f32,
    /// The same rows in other colours, once they were asked for.
    pub(super) paint: Option<Paint>,
}

/// Everything that is looked at.
pub(crate) struct Stage {
    pub(super) machine: Machine,
    /// What the page calls it.
    pub(super) title: String,
    /// One or two.
    pub(super) models: Vec<Shown>,
    /// What renders them, in their order; of a run in training its own does.
    pub(super) backends: Vec<Box<dyn Backend>>,
    /// Whether rows per pixel can be counted.
    pub(super) counts: bool,
    /// The largest picture that may be rendered, where a promise holds: that of training.
    pub(super) largest: Option<(u32, u32)>,
    pub(super) normalisation: Normalisation,
    pub(super) background: [f32; 3],
    /// The views of the dataset, in its order: those held out, those trained on.
    pub(super) views: [Vec<View>; 2],
    photographs: [DatasetViews; 2],
    /// Points that the dataset brings, in scene coordinates.
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
    /// Whether rows per pixel can be counted.
    pub(super) counts: bool,
    /// Whether rows can be painted: that takes a second model.
    pub(super) paints: bool,
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
        Self::keeping(KEPT_PHOTOGRAPHS, machine, title, (normalisation, background), views, points)
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
        let photographs = |views: &Vec<View>| DatasetViews::new(views.clone(), kept, 1);
        Self {
            machine,
            title,
            models: Vec::new(),
            backends: Vec::new(),
            counts: true,
            largest: None,
            normalisation,
            background,
            photographs: [photographs(&test), photographs(&train)],
            views: [test, train],
            points,
            start: None,
        }
    }

    /// A run in training: rendered by what trains it, and in no larger pictures.
    pub(super) fn of_run(run: &mut Run) -> Self {
        let counts = run.trainer().backend().counts_rows();
        let rows = run.trainer().rows();
        let (config, dataset) = (run.config(), run.dataset());
        let title = name_of(&config.scene_path());
        let background = config.spec.data.background.fixed();
        let models = vec![Shown {
            name: format!("{}, in training", config.spec.density.policy),
            rows,
            sh_degree: config.sh_degree(),
            near: 0.0,
            paint: None,
        }];
        let views = [dataset.test.clone(), dataset.train.clone()];
        let stage = Self::keeping(
            0,
            Machine::default(),
            title,
            (dataset.normalisation, background),
            views,
            PointCloud::default(),
        );
        Self { models, counts, largest: Some(dataset.largest_image()), ..stage }
    }

    /// Adds a model with what renders it.
    pub(super) fn add(&mut self, shown: Shown, backend: Box<dyn Backend>) {
        self.counts &= backend.counts_rows();
        self.models.push(shown);
        self.backends.push(backend);
    }

    /// Names and rows of the models.
    pub(crate) fn models(&self) -> impl Iterator<Item = (&str, usize)> {
        self.models.iter().map(|model| (&*model.name, model.rows))
    }

    pub(super) fn extent(&self) -> Extent {
        Extent {
            models: self.models.len(),
            views: [self.views[0].len(), self.views[1].len()],
            normalisation: self.normalisation,
            counts: self.counts,
            paints: self.largest.is_none(),
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

    /// The same rows in other colours.
    pub(super) fn paint(
        &mut self,
        model: usize,
        backend: &dyn Backend,
    ) -> Result<&mut Paint, BackendError> {
        let Self { machine, models, .. } = self;
        let Shown { near, paint, .. } = &mut models[model];
        if paint.is_none() {
            *paint = Some(Paint::new(machine, backend, *near)?);
        }
        Ok(paint.as_mut().expect("it was made just now"))
    }
}
