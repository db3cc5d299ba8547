//! What is looked at: one model or two, in the coordinates of a dataset where there is one.

use super::paint::Paint;
use crate::backend::{Backend, BackendError};
use crate::camera::Camera;
use crate::dataset::normalise::Normalisation;
use crate::dataset::{PointCloud, View};
use crate::evaluate::Split;
use crate::run::finished::Machine;
use crate::views::DatasetViews;

/// Decoded photographs that are kept `[bytes]`.
const KEPT_PHOTOGRAPHS: u64 = 64 << 20;

/// A model that is shown.
pub(super) struct Shown {
    /// What the page calls it.
    pub(super) name: String,
    pub(super) backend: Box<dyn Backend>,
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
        let photographs = |views: &Vec<View>| DatasetViews::new(views.clone(), KEPT_PHOTOGRAPHS, 1);
        Self {
            machine,
            title,
            models: Vec::new(),
            normalisation,
            background,
            photographs: [photographs(&test), photographs(&train)],
            views: [test, train],
            points,
            start: None,
        }
    }

    /// Names and rows of the models.
    pub(crate) fn models(&self) -> impl Iterator<Item = (&str, usize)> {
        self.models.iter().map(|model| (&*model.name, model.backend.rows()))
    }

    pub(super) fn extent(&self) -> Extent {
        Extent {
            models: self.models.len(),
            views: [self.views[0].len(), self.views[1].len()],
            normalisation: self.normalisation,
            counts: self.models.iter().all(|model| model.backend.counts_rows()),
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
    pub(super) fn paint(&mut self, model: usize) -> Result<&mut Paint, BackendError> {
        let Self { machine, models, .. } = self;
        let Shown { backend, near, paint, .. } = &mut models[model];
        if paint.is_none() {
            *paint = Some(Paint::new(machine, backend.as_ref(), *near)?);
        }
        Ok(paint.as_mut().expect("it was made just now"))
    }
}
