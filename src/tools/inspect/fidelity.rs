//! Measures how closely a model in another format reproduces the original, in the held-out views.

use std::path::Path;

use densify_core::gaussians::Gaussians;
use densify_data::dataset::Dataset;
use densify_data::views::ViewSource;
use densify_render::Backend;
use densify_run::coordinate_check::CoordinateCheck;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, load, near_plane, views_of};
use densify_run::{DataSpec, Fraction, Observer};
use densify_train::evaluate::Split;
use densify_train::metrics::psnr_between;

/// The original model, which others are compared with.
pub struct Reference {
    dataset: Dataset,
    machine: Machine,
    /// Near plane `[scene units]`.
    near: f32,
    background: [f32; 3],
    sh_degree: u8,
    backend: Box<dyn Backend>,
}

impl Reference {
    /// Loads the dataset at `scene` and renders `model`, which was read from `file`. Without `near`, the usual near
    /// plane of the dataset is used. Unless the dataset or `data` selects test views, every 8th photograph is held out.
    ///
    /// # Errors
    /// When the dataset cannot be loaded or the model cannot be rendered.
    pub fn open(
        file: &Path,
        model: &Gaussians,
        scene: &Path,
        mut data: DataSpec,
        (near, machine): (Option<Fraction>, Machine),
        observer: &dyn Observer,
    ) -> Result<Self, Failure> {
        data.eval = data.test_every.is_none();
        let dataset = load(scene, &data, observer)?;
        let near = near_plane(near, &dataset, observer);
        let mut backend = machine.backend(&dataset, model.clone(), near)?;
        let (background, sh_degree) = (data.background.fixed(), model.sh_degree);
        let views = views_of(&dataset, Split::Test)?;
        // A model that no view shows would look the same in every format.
        CoordinateCheck::measure(backend.as_mut(), &views, (background, sh_degree))?
            .note(None, file, observer);
        Ok(Self { dataset, machine, near, background, sh_degree, backend })
    }

    /// PSNR `[dB]` of another model's pictures against this one's, averaged over the held-out views.
    ///
    /// # Errors
    /// When a view cannot be rendered.
    pub fn psnr_of(&mut self, other: Gaussians) -> Result<f64, Failure> {
        let degree = other.sh_degree;
        let mut backend = self.machine.backend(&self.dataset, other, self.near)?;
        let views = views_of(&self.dataset, Split::Test)?;
        let mut sum = 0.0;
        for view in 0..views.count() {
            let camera = views.camera(view);
            let ours = self.backend.render(camera, self.background, self.sh_degree)?;
            let theirs = backend.render(camera, self.background, degree)?;
            sum += psnr_between(&ours.rgb, &theirs.rgb);
        }
        Ok(sum / views.count() as f64)
    }
}
