//! Weights of Gaussians in the training views, and in front of the surface: the median depth of the model itself, not
//! that of the dataset's depth maps.

use densify_core::gaussians::Gaussians;
use densify_data::dataset::Dataset;
use densify_data::views::ViewSource;
use densify_render::BackendChoice;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, views_of};
use densify_run::{DeviceSpec, Observer, Silent, check_interrupt};
use densify_train::evaluate::Split;

use super::Options;

/// Blend weights α·T summed over the pixels of all training views.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Weights {
    /// The part in pixels whose median depth is farther than the Gaussian by more than the margin.
    pub(super) in_front: f64,
    pub(super) whole: f64,
}

/// Measures the weights of each Gaussian of a model in the coordinates of the dataset. Shape of the result: `[rows]`.
///
/// # Errors
/// When a view cannot be rendered, or the observer interrupts.
pub(super) fn measure(
    model: &Gaussians,
    (dataset, near): (&Dataset, f32),
    options: &Options<'_>,
    observer: &dyn Observer,
) -> Result<Vec<Weights>, Failure> {
    let device = DeviceSpec { backend: BackendChoice::Cpu, gpu: None, ..options.device.clone() };
    let machine = Machine::open(&device, &Silent)?;
    let mut backend = machine.backend(dataset, model.clone(), near)?;
    let inspect = backend.inspect()?;
    let views = views_of(dataset, Split::Train)?;
    let mut sums = vec![Weights::default(); model.len()];
    let nearer = 1.0 - options.rules.margin as f32;
    for view in 0..views.count() {
        check_interrupt(observer)?;
        let camera = views.camera(view);
        let mut surface = inspect.render_depths(camera)?.median;
        surface.iter_mut().for_each(|depth| *depth *= nearer);
        let weights = inspect.weights_in_front(camera, &surface)?;
        for (sum, weights) in sums.iter_mut().zip(weights) {
            sum.in_front += f64::from(weights.in_front);
            sum.whole += f64::from(weights.whole);
        }
    }
    Ok(sums)
}
