//! Importance of Gaussians in the training views, for reducing models that exceed the budget.

use densify_policies::policy::{AuxColumn, AuxRequest, Needs};

use crate::metrics::EvaluateError;
use densify_core::gaussians::{Gaussians, sigmoid};
use densify_data::views::ViewSource;
use densify_render::{AuxInput, Backend, BackendError};

/// The values that the backend for [`importance`] must record; pass them when creating the backend.
pub fn needs() -> Needs {
    Needs { aux: Some(request()), ..Needs::default() }
}

fn request() -> AuxRequest {
    AuxRequest { columns: vec![AuxColumn::WeightSum], ..AuxRequest::default() }
}

/// Memory that [`importance`] needs in addition to the backend and one image `[bytes]`.
pub fn bytes(rows: usize) -> u64 {
    // Per row: its weight in one view, the sum over all views, and its index while sorting.
    rows as u64 * (size_of::<f32>() + size_of::<f64>() + size_of::<usize>()) as u64
}

/// The sum of each row's blend weights α·T over all pixels of all views, >= 0. Shape: `[rows]`.
///
/// # Errors
/// When a view cannot be read or rendered.
pub fn importance(
    backend: &mut dyn Backend,
    views: &impl ViewSource,
    background: [f32; 3],
    sh_degree: u8,
) -> Result<Vec<f64>, EvaluateError> {
    let request = request();
    let mut sums = vec![0.0; backend.rows()];
    for view in 0..views.count() {
        let name = || views.name(view).to_owned();
        views.prefetch_after(view);
        let image =
            views.image(view).map_err(|source| EvaluateError::View { view: name(), source })?;
        let input = AuxInput {
            step: 0,
            view,
            seed: 0,
            camera: views.camera(view),
            target: &image,
            background,
            exposure: None,
            vignette: None,
            sh_degree,
            depth: None,
            request: &request,
        };
        let output = backend.observe(&input);
        let output = output
            .map_err(|source: BackendError| EvaluateError::Backend { view: name(), source })?;
        for (sum, weight) in sums.iter_mut().zip(&output.columns[0].1) {
            *sum += f64::from(*weight);
        }
    }
    Ok(sums)
}

/// A substitute for importance if there are no views: the logarithm of the product of each row's opacity and its two
/// longest axes, which measures its largest possible contribution to an image. Shape: `[rows]`.
pub fn footprints(model: &Gaussians) -> Vec<f64> {
    let footprint = |row: usize| {
        let mut log_scales = model.log_scales[row];
        log_scales.sort_unstable_by(f32::total_cmp);
        f64::from(sigmoid(model.opacity_logits[row]).ln() + log_scales[1] + log_scales[2])
    };
    (0..model.len()).map(footprint).collect()
}

/// The `count` most important rows, sorted by index; of equally important rows, the first.
pub fn largest(importance: &[f64], count: usize) -> Vec<usize> {
    let mut rows: Vec<usize> = (0..importance.len()).collect();
    rows.sort_by(|&a, &b| importance[b].total_cmp(&importance[a]));
    rows.truncate(count);
    rows.sort_unstable();
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_important_rows_are_sorted_by_index() {
        assert_eq!(largest(&[1.0, 3.0, 0.0, 3.0, 2.0], 3), [1, 3, 4]);
        assert_eq!(largest(&[1.0, 1.0, 1.0], 2), [0, 1]);
        assert_eq!(largest(&[1.0], 5), [0]);
    }
}
