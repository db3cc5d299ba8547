//! Measures models against the photographs.

use std::path::Path;

use super::{Attempt, Options};
use densify_core::gaussians::Gaussians;
use densify_data::dataset::Dataset;
use densify_data::models::Format;
use densify_data::views::ViewSource;
use densify_run::Observer;
use densify_run::coordinate_check::CoordinateCheck;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, load, near_plane, views_of};
use densify_train::evaluate::Split;
use densify_train::exposure::fitted;
use densify_train::metrics::psnr;

/// The photographs and the settings to render with.
pub(super) struct Evaluator {
    dataset: Dataset,
    machine: Machine,
    /// Near plane `[scene units]`.
    near: f32,
    background: [f32; 3],
    /// The exposure of each render is fitted to the photograph before they are compared.
    fits_exposure: bool,
}

impl Evaluator {
    pub(super) fn open(options: &Options<'_>, observer: &dyn Observer) -> Result<Self, Failure> {
        let machine = Machine::open(&options.device, observer)?;
        let dataset = load(options.scene, &options.data, observer)?;
        let near = near_plane(options.near, &dataset, observer);
        let background = options.data.background.fixed();
        let fits_exposure = options.exposure.is_some();
        Ok(Self { dataset, machine, near, background, fits_exposure })
    }

    /// Checks that the model is in the coordinates of the dataset.
    pub(super) fn check_coordinates(
        &self,
        model: &Gaussians,
        file: &Path,
        observer: &dyn Observer,
    ) -> Result<(), Failure> {
        let degree = model.sh_degree;
        let mut backend = self.machine.backend(&self.dataset, model.clone(), self.near)?;
        let views = views_of(&self.dataset, Split::Train)?;
        let check = CoordinateCheck::measure(backend.as_mut(), &views, (self.background, degree))?;
        check.require(None, file, observer)
    }

    /// Measures a model whose file has this size.
    pub(super) fn evaluate(
        &self,
        model: Gaussians,
        format: &Format,
        bytes: u64,
    ) -> Result<Attempt, Failure> {
        let (rows, sh_degree) = (model.len(), model.sh_degree);
        let mut backend = self.machine.backend(&self.dataset, model, self.near)?;
        let mut mean = |split: Split| {
            let views = views_of(&self.dataset, split)?;
            let mut sum = 0.0;
            for view in 0..views.count() {
                views.prefetch_after(view);
                let image = views.image(view).map_err(Failure::input)?;
                let rendering = backend.render(views.camera(view), self.background, sh_degree)?;
                let score =
                    |rgb: &[f32]| psnr(rgb, &image, self.background).map_err(Failure::input);
                // Also checks that the render and the photograph can be compared.
                let mut value = score(&rendering.rgb)?;
                if self.fits_exposure {
                    value = score(&fitted(&rendering.rgb, &image, self.background))?;
                }
                sum += value;
            }
            Ok::<_, Failure>(sum / views.count() as f64)
        };
        let train_psnr = mean(Split::Train)?;
        let test_psnr = if self.dataset.test.is_empty() { None } else { Some(mean(Split::Test)?) };
        Ok(Attempt { rows, sh_degree, format: format.name, bytes, train_psnr, test_psnr })
    }
}
