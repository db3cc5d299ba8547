//! Orders Gaussians along a Z-curve through space, for formats that compress neighbours together.

use densify_core::curve::morton_code;
use densify_core::gaussians::Gaussians;

/// The middle and the spread of a model along each axis: medians, so that outliers have no effect.
pub(super) fn middles_and_spreads(model: &Gaussians) -> [(f64, f64); 3] {
    [0, 1, 2].map(|axis| {
        middle_and_spread(model.means.iter().map(|mean| f64::from(mean[axis])).collect())
    })
}

/// The median of values, and the median of their distances from it.
pub(super) fn middle_and_spread(mut values: Vec<f64>) -> (f64, f64) {
    let middle = values.len() / 2;
    if values.is_empty() {
        return (0.0, 1.0);
    }
    let centre = *values.select_nth_unstable_by(middle, f64::total_cmp).1;
    values.iter_mut().for_each(|value| *value = (*value - centre).abs());
    // The median distance is 0 if most values are equal.
    (centre, values.select_nth_unstable_by(middle, f64::total_cmp).1.max(f64::MIN_POSITIVE))
}

/// The rows of a model in the order of the curve, which is scaled by the model's spread along each axis.
pub(super) fn spatial_order(model: &Gaussians) -> Vec<usize> {
    let axes = middles_and_spreads(model);
    let code = |row: usize| {
        let mean = model.means[row].map(f64::from);
        morton_code(std::array::from_fn(|i| (mean[i] - axes[i].0) / (2.0 * axes[i].1)))
    };
    let mut rows: Vec<usize> = (0..model.len()).collect();
    rows.sort_by_cached_key(|&row| (code(row), row));
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_follow_each_other_whatever_the_unit() {
        for unit in [1e-6, 1.0, 1e6] {
            let mut model = Gaussians::zeros(64, 0);
            // Two clusters, whose rows alternate.
            for (row, mean) in model.means.iter_mut().enumerate() {
                let x = if row % 2 == 0 { -1.0 } else { 1.0 };
                *mean = [unit * (x + 0.001 * row as f32), 0.0, 0.0];
            }
            let rows = spatial_order(&model);
            assert!(rows[..32].iter().all(|row| row % 2 == 0), "{rows:?}");
            assert!(rows[32..].iter().all(|row| row % 2 == 1), "{rows:?}");
        }
        assert_eq!(spatial_order(&Gaussians::default()), Vec::<usize>::new());
        assert_eq!(spatial_order(&Gaussians::zeros(3, 1)), [0, 1, 2]);
    }
}
