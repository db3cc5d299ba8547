//! Weights of Gaussians in the training views, and in front of the surface: the median depth of the model itself, not
//! that of the dataset's depth maps.

use densify_core::gaussians::Gaussians;
use densify_core::image::Image8;
use densify_data::dataset::Dataset;
use densify_data::views::ViewSource;
use densify_policies::policy::Needs;
use densify_render::AuxInput;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, views_of};
use densify_run::{Observer, check_interrupt};
use densify_train::evaluate::Split;
use densify_train::in_front::{self, RowWeights};

/// Measures the weights of each Gaussian of a model in the coordinates of the dataset. Shape of the result: `[rows]`.
///
/// # Errors
/// When a view cannot be rendered, or the observer interrupts.
pub(super) fn measure(
    model: &Gaussians,
    (dataset, near): (&Dataset, f32),
    margin: f64,
    machine: &Machine,
    observer: &dyn Observer,
) -> Result<Vec<RowWeights>, Failure> {
    let request = in_front::request(margin as f32);
    let needs = Needs { aux: Some(request.clone()), ..Needs::default() };
    let mut backend = machine.backend_for(dataset, model.clone(), near, needs)?;
    let views = views_of(dataset, Split::Train)?;
    let mut sums = vec![RowWeights::default(); model.len()];
    for view in 0..views.count() {
        check_interrupt(observer)?;
        let camera = views.camera(view);
        let black = Image8::black(camera.width, camera.height);
        let measured = backend.observe(&AuxInput::of_rows(camera, &black, &request))?;
        in_front::add(&mut sums, &measured);
    }
    Ok(sums)
}
