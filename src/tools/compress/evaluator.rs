//! Measures models against the photographs.

use super::{Attempt, Options};
use densify_core::gaussians::Gaussians;
use densify_data::dataset::Dataset;
use densify_data::models::{Format, PLY};
use densify_render::Backend;
use densify_run::Observer;
use densify_run::coordinate_check::CoordinateCheck;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, load, near_plane, views_of};
use densify_run::refining::TrainedModel;
use densify_train::evaluate::Split;

/// The photographs and the settings to render with.
pub(super) struct Evaluator {
    dataset: Dataset,
    machine: Machine,
    /// Near plane `[scene units]`.
    near: f32,
    /// The original model and its training.
    model: TrainedModel,
}

impl Evaluator {
    pub(super) fn open(options: &Options<'_>, observer: &dyn Observer) -> Result<Self, Failure> {
        let machine = Machine::open(&options.device, observer)?;
        let model = options.model.clone();
        let dataset = load(&model.scene, &model.data, observer)?;
        let near = near_plane(model.near, &dataset, observer);
        Ok(Self { dataset, machine, near, model })
    }

    /// Measures the original model; `bytes` is its size as a PLY.
    ///
    /// # Errors
    /// If rendering fails, or the model is not in the coordinates of the dataset.
    pub(super) fn evaluate_original(
        &self,
        model: Gaussians,
        bytes: u64,
        observer: &dyn Observer,
    ) -> Result<Attempt, Failure> {
        let sh_degree = model.sh_degree;
        let views = views_of(&self.dataset, Split::Train)?;
        let mut backend = self.machine.backend(&self.dataset, model, self.near)?;
        let background = self.model.data.background.fixed();
        CoordinateCheck::measure(backend.as_mut(), &views, (background, sh_degree))?.require(
            None,
            &self.model.file,
            observer,
        )?;
        self.measure(backend.as_mut(), PLY, bytes)
    }

    /// Measures a model; `bytes` is the size of its file.
    pub(super) fn evaluate(
        &self,
        model: Gaussians,
        format: &Format,
        bytes: u64,
    ) -> Result<Attempt, Failure> {
        let mut backend = self.machine.backend(&self.dataset, model, self.near)?;
        self.measure(backend.as_mut(), format, bytes)
    }

    fn measure(
        &self,
        backend: &mut dyn Backend,
        format: &Format,
        bytes: u64,
    ) -> Result<Attempt, Failure> {
        let (rows, sh_degree) = (backend.rows(), backend.sh_degree());
        let mut mean =
            |split| self.model.mean_psnr(backend, (&self.dataset, split), |_, _, _| Ok(()));
        let train_psnr = mean(Split::Train)?;
        let test_psnr = if self.dataset.test.is_empty() { None } else { Some(mean(Split::Test)?) };
        Ok(Attempt { rows, sh_degree, format: format.name, bytes, train_psnr, test_psnr })
    }
}
