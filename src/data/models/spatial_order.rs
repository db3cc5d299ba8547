//! Orders Gaussians along a Z-curve through space, for formats that compress neighbours together.

use densify_core::curve::morton_code;
use densify_core::gaussians::Gaussians;

/// The centre and the spread of a model along each axis: medians, so that outliers have no effect.
pub(super) fn frame(model: &Gaussians) -> [(f64, f64); 3] {
    let middle = model.len() / 2;
    let mut frame = [(0.0, 1.0); 3];
    let mut values = Vec::with_capacity(model.len());
    for (axis, (centre, spread)) in frame.iter_mut().enumerate() {
        values.clear();
        values.extend(model.means.iter().map(|mean| f64::from(mean[axis])));
        if values.is_empty() {
            break;
        }
        *centre = *values.select_nth_unstable_by(middle, f64::total_cmp).1;
        values.iter_mut().for_each(|value| *value = (*value - *centre).abs());
        // The median is 0 if half of all rows are equal in this coordinate.
        *spread = values.select_nth_unstable_by(middle, f64::total_cmp).1.max(f64::MIN_POSITIVE);
    }
    frame
}

/// The rows of a model in the order of the curve, whose scale is that of the [`frame`].
pub(super) fn spatial_order(model: &Gaussians) -> Vec<usize> {
    let frame = frame(model);
    let place = |row: usize| {
        let mean = model.means[row].map(f64::from);
        morton_code(std::array::from_fn(|i| (mean[i] - frame[i].0) / (2.0 * frame[i].1)))
    };
    let mut rows: Vec<usize> = (0..model.len()).collect();
    rows.sort_by_cached_key(|&row| (place(row), row));
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
