//! Measures models against the photographs.

use std::path::Path;

use super::{Attempt, Options};
use densify_core::gaussians::Gaussians;
use densify_data::dataset::Dataset;
use densify_data::models::{Format, PLY};
use densify_data::views::ViewSource;
use densify_render::Backend;
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

    /// Measures the original model, which was read from `file`; `bytes` is its size as a PLY.
    ///
    /// # Errors
    /// If rendering fails, or the model is not in the coordinates of the dataset.
    pub(super) fn evaluate_original(
        &self,
        model: Gaussians,
        file: &Path,
        bytes: u64,
        observer: &dyn Observer,
    ) -> Result<Attempt, Failure> {
        let sh_degree = model.sh_degree;
        let views = views_of(&self.dataset, Split::Train)?;
        let mut backend = self.machine.backend(&self.dataset, model, self.near)?;
        CoordinateCheck::measure(backend.as_mut(), &views, (self.background, sh_degree))?
            .require(None, file, observer)?;
        self.measure(backend.as_mut(), sh_degree, PLY, bytes)
    }

    /// Measures a model; `bytes` is the size of its file.
    pub(super) fn evaluate(
        &self,
        model: Gaussians,
        format: &Format,
        bytes: u64,
    ) -> Result<Attempt, Failure> {
        let sh_degree = model.sh_degree;
        let mut backend = self.machine.backend(&self.dataset, model, self.near)?;
        self.measure(backend.as_mut(), sh_degree, format, bytes)
    }

    fn measure(
        &self,
        backend: &mut dyn Backend,
        sh_degree: u8,
        format: &Format,
        bytes: u64,
    ) -> Result<Attempt, Failure> {
        let rows = backend.rows();
        let mut mean = |split: Split| {
            let views = views_of(&self.dataset, split)?;
            let mut sum = 0.0;
            for view in 0..views.count() {
                views.prefetch_after(view);
                let image = views.image(view).map_err(Failure::input)?;
                let rendering = backend.render(views.camera(view), self.background, sh_degree)?;
                let score =
                    |rgb: &[f32]| psnr(rgb, &image, self.background).map_err(Failure::input);
                // This also checks that the render and the photograph can be compared, so it runs in either case.
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
