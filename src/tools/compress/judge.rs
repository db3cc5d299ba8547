//! How well a model shows the photographs.

use std::path::Path;

use super::{Attempt, Options};
use densify_core::gaussians::Gaussians;
use densify_data::dataset::Dataset;
use densify_data::models::Format;
use densify_data::views::ViewSource;
use densify_run::Observer;
use densify_run::coordinate_check::CoordinateCheck;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, load, views_of};
use densify_train::evaluate::Split;
use densify_train::exposure::fitted;
use densify_train::metrics::psnr;

/// The photographs, and what models are rendered on.
pub(super) struct Judge {
    dataset: Dataset,
    machine: Machine,
    /// Distance `[scene units]`.
    near: f32,
    background: [f32; 3],
    /// Whether each photograph is compared with the exposure that fits it best.
    fits_exposure: bool,
}

impl Judge {
    pub(super) fn open(options: &Options<'_>, observer: &dyn Observer) -> Result<Self, Failure> {
        let machine = Machine::open(&options.device, observer)?;
        let dataset = load(options.scene, &options.data, observer)?;
        let near = (options.near.0 * dataset.extent()) as f32;
        let background = options.data.background.fixed();
        let fits_exposure = options.exposure.is_some();
        Ok(Self { dataset, machine, near, background, fits_exposure })
    }

    /// Fails where the model is in other coordinates than the dataset.
    pub(super) fn require(
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
    pub(super) fn attempt(
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
                let shown = backend.render(views.camera(view), self.background, sh_degree)?;
                // Which also finds out whether the two can be compared.
                let plain = psnr(&shown.rgb, &image, self.background).map_err(Failure::input)?;
                sum += match self.fits_exposure {
                    true => {
                        let rgb = fitted(&shown.rgb, &image, self.background);
                        psnr(&rgb, &image, self.background).map_err(Failure::input)?
                    }
                    false => plain,
                };
            }
            Ok::<_, Failure>(sum / views.count() as f64)
        };
        let train = mean(Split::Train)?;
        let test = if self.dataset.test.is_empty() { None } else { Some(mean(Split::Test)?) };
        Ok(Attempt { rows, sh_degree, format: format.name, bytes, train, test })
    }
}
