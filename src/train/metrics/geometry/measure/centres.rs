//! Distances between centres and mesh, in both directions.

use rayon::prelude::*;

use super::rows::{Rows, SolidRows};
use super::visibility::Visibility;
use super::{CentreErrors, KnownScene, ratio};
use crate::metrics::EvaluateError;

pub(super) fn errors(
    rows: &Rows,
    visibility: &Visibility,
    scene: &KnownScene<'_>,
) -> Result<CentreErrors, EvaluateError> {
    let diagonal = scene.diagonal();
    let solid = SolidRows::new(rows);
    let to_centres: Vec<f64> =
        visibility.samples.par_iter().map(|&sample| solid.distance(sample) / diagonal).collect();
    let to_mesh: Vec<(f64, f64)> = rows
        .distances
        .iter()
        .zip(&visibility.weights)
        .filter(|&(_, &weight)| weight > 0.0)
        .map(|(&distance, &weight)| (distance / diagonal, weight))
        .collect();
    let total: f64 = to_mesh.iter().map(|&(_, weight)| weight).sum();
    let accuracy = ratio(to_mesh.iter().map(|(distance, weight)| distance * weight).sum(), total);
    let completeness = ratio(to_centres.iter().sum(), to_centres.len() as f64);
    let f_score = |limit: f64| {
        let within = to_mesh.iter().filter(|&&(distance, _)| distance <= limit);
        let precision = ratio(within.map(|&(_, weight)| weight).sum(), total);
        let reached = to_centres.iter().filter(|&&distance| distance <= limit).count();
        let recall = ratio(reached as f64, to_centres.len() as f64);
        let sum = precision + recall;
        if sum > 0.0 { 2.0 * precision * recall / sum } else { sum }
    };
    Ok(CentreErrors {
        accuracy,
        accuracy_p95: percentile(to_mesh.clone(), 0.95),
        completeness,
        chamfer: accuracy + completeness,
        f_score_half_percent: f_score(0.005),
        f_score_one_percent: f_score(0.01),
    })
}

/// The weighted percentile of (value, weight) pairs; NaN without pairs.
fn percentile(mut values: Vec<(f64, f64)>, fraction: f64) -> f64 {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let goal = fraction * values.iter().map(|&(_, weight)| weight).sum::<f64>();
    let mut sum = 0.0;
    let reached = values.iter().find(|&&(_, weight)| {
        sum += weight;
        sum >= goal
    });
    // Rounding may leave the sum just below the goal.
    reached.or(values.last()).map_or(f64::NAN, |&(value, _)| value)
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_weighted() {
        let values = vec![(3.0, 1.0), (1.0, 8.0), (2.0, 1.0)];
        assert_eq!(percentile(values.clone(), 0.5), 1.0);
        assert_eq!(percentile(values.clone(), 0.9), 2.0);
        assert_eq!(percentile(values, 0.95), 3.0);
        assert!(percentile(Vec::new(), 0.95).is_nan());
    }
}
