//! Selecting rows: the largest, the smallest, or at random by weight; and quantiles.
//!
//! Selections are deterministic: ties go to the lower row, NaN comes last, and random draws are hashes
//! of (seed, step, row, purpose). Selecting takes O(n) and sorting the result O(k log k).

use std::cmp::Ordering;

use crate::rng::{PolicyRng, Purpose};

/// The `k` rows with the largest values, largest first; of equal values the lower row first, NaN last.
pub fn top_k(values: &[f32], k: usize) -> Vec<u32> {
    largest((0..values.len() as u32).collect(), values, k)
}

/// Of `rows`, the `k` with the largest `values[row]`, largest first; of equal values the lower row first, NaN last.
///
/// # Panics
/// When a row is not in `values`.
pub fn largest(rows: Vec<u32>, values: &[f32], k: usize) -> Vec<u32> {
    first_k(rows, k, |&a, &b| {
        let (x, y) = (values[a as usize], values[b as usize]);
        nan_last(x, y, Ordering::reverse).then(a.cmp(&b))
    })
}

/// Of `rows`, the `k` with the smallest `values[row]`, smallest first; of equal values the lower row first, NaN last.
///
/// # Panics
/// When a row is not in `values`.
pub fn smallest(rows: Vec<u32>, values: &[f32], k: usize) -> Vec<u32> {
    first_k(rows, k, |&a, &b| {
        let (x, y) = (values[a as usize], values[b as usize]);
        nan_last(x, y, |order| order).then(a.cmp(&b))
    })
}

/// Draws `k` distinct rows without replacement, each with a probability proportional to its weight among the
/// remaining ones. Returned in the order drawn; fewer than `k` if fewer weights are positive.
///
/// The rows with the smallest keys −ln(u) / weight are drawn; a key is an exponential variable whose rate is the
/// weight (Efraimidis and Spirakis, *Weighted random sampling with a reservoir*, 2006). Rows with zero,
/// negative or NaN weights are never drawn; those with infinite weights always come first.
pub fn weighted(weights: &[f32], k: usize, rng: &PolicyRng) -> Vec<u32> {
    let eligible = (0..).zip(weights).filter(|(_, weight)| **weight > 0.0);
    let keyed = eligible.map(|(row, &weight)| {
        let u: f64 = rng.uniform_f64(row, Purpose::Select);
        (-u.ln() / f64::from(weight), row)
    });
    let keyed =
        first_k(keyed.collect(), k, |a: &(f64, u32), b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    keyed.into_iter().map(|(_, row)| row).collect()
}

/// Draws `k` rows with replacement, each with a probability proportional to its weight. Returns the rows
/// drawn, ascending, with their counts; nothing if no weight is positive.
///
/// Rows with zero, negative or NaN weights are never drawn; infinite weights count as `f32::MAX`.
pub fn with_replacement(weights: &[f32], k: usize, rng: &PolicyRng) -> Vec<(u32, u32)> {
    let mut total = 0.0_f64;
    let sums: Vec<f64> = weights
        .iter()
        .map(|&weight| {
            // Also turns NaN into 0.
            total += f64::from(if weight > 0.0 { weight.min(f32::MAX) } else { 0.0 });
            total
        })
        .collect();
    if total <= 0.0 {
        return Vec::new();
    }
    let mut drawn: Vec<u32> = (0..k as u32)
        .map(|draw| {
            let target = rng.uniform_f64(draw, Purpose::Draw) * total;
            let row = sums.partition_point(|&sum| sum <= target);
            // The product may round up to the total; then the last row with a positive weight is drawn.
            row.min(sums.partition_point(|&sum| sum < total)) as u32
        })
        .collect();
    drawn.sort_unstable();
    drawn.chunk_by(|a, b| a == b).map(|same| (same[0], same.len() as u32)).collect()
}

/// The linearly interpolated `share` quantile of the finite values; `None` if there are none.
pub fn quantile(values: &[f32], share: f64) -> Option<f64> {
    let mut finite: Vec<f32> = values.iter().copied().filter(|value| value.is_finite()).collect();
    let rank = share * finite.len().checked_sub(1)? as f64;
    let (below, between) = (rank.floor() as usize, rank.fract());
    let (_, &mut low, above) = finite.select_nth_unstable_by(below, f32::total_cmp);
    let high = above.iter().copied().min_by(f32::total_cmp).unwrap_or(low);
    Some(f64::from(low) + between * (f64::from(high) - f64::from(low)))
}

/// Orders numbers in the given direction (−0 equals 0), followed by NaN of either sign.
fn nan_last(x: f32, y: f32, direction: impl Fn(Ordering) -> Ordering) -> Ordering {
    x.partial_cmp(&y).map_or_else(|| x.is_nan().cmp(&y.is_nan()), direction)
}

/// The first `k` items in a total order, sorted.
fn first_k<T>(mut items: Vec<T>, k: usize, order: impl Fn(&T, &T) -> Ordering) -> Vec<T> {
    if k == 0 {
        return Vec::new();
    }
    if k < items.len() {
        items.select_nth_unstable_by(k - 1, &order);
        items.truncate(k);
    }
    items.sort_unstable_by(order);
    items
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const NAN: f32 = f32::NAN;

    #[test]
    fn top_k_matches_values_worked_out_by_hand() {
        let values = [1.0, NAN, 3.0, -NAN, 3.0, f32::INFINITY, -2.0, f32::NEG_INFINITY];
        assert_eq!(top_k(&values, 3), [5, 2, 4]);
        assert_eq!(top_k(&values, 100), [5, 2, 4, 0, 6, 7, 1, 3]);
        assert_eq!(top_k(&[-NAN, NAN, 1.0], 3), [2, 0, 1]);
        assert_eq!(top_k(&values, 0), [0_u32; 0]);
        assert_eq!(top_k(&[], 3), [0_u32; 0]);
        assert_eq!(top_k(&[0.0, -0.0, 0.0], 3), [0, 1, 2]);
        assert_eq!(smallest(vec![7, 1, 0, 6], &values, 3), [7, 6, 0]);
        assert_eq!(largest(vec![3, 4, 2, 0], &values, 9), [2, 4, 0, 3]);
    }

    proptest! {
        #[test]
        fn selection_agrees_with_sorting(values in prop::collection::vec(-3..4_i8, 0..50), k in 0..60_usize) {
            let values: Vec<f32> = values.into_iter().map(|v| if v == -3 { NAN } else { f32::from(v) }).collect();
            let rank = |row: &u32| {
                let value = values[*row as usize];
                (value.is_nan(), if value.is_nan() { 0 } else { value as i32 }, *row)
            };
            let rows: Vec<u32> = (0..values.len() as u32).collect();
            let mut sorted = rows.clone();
            sorted.sort_by_key(&rank);
            sorted.truncate(k);
            prop_assert_eq!(smallest(rows.clone(), &values, k), sorted);
            let mut sorted = rows;
            sorted.sort_by_key(|row| { let (nan, value, row) = rank(row); (nan, -value, row) });
            sorted.truncate(k);
            prop_assert_eq!(top_k(&values, k), sorted);
        }
    }

    #[test]
    fn quantiles_match_values_worked_out_by_hand() {
        let values = [5.0, NAN, 1.0, 2.0, f32::INFINITY, 4.0];
        // Among 1, 2, 4 and 5, these shares are at ranks 0, 0.75, 1.5 and 3.
        let quantiles = [0.0, 0.25, 0.5, 1.0].map(|share| quantile(&values, share));
        assert_eq!(quantiles, [1.0, 1.75, 3.0, 5.0].map(Some));
        assert_eq!((quantile(&[], 0.5), quantile(&[NAN], 0.5)), (None, None));
    }

    #[test]
    fn only_positive_weights_are_drawn() {
        let weights = [0.0, NAN, 1.0, -1.0, f32::NEG_INFINITY, 1e-40, f32::INFINITY, -0.0];
        for step in 0..50 {
            let rng = PolicyRng::new(1, step);
            let drawn = weighted(&weights, 8, &rng);
            assert_eq!(drawn, [6, 2, 5]);
            assert_eq!(weighted(&weights, 2, &rng), drawn[..2]);
            assert!(weighted(&weights, 0, &rng).is_empty());
        }
        assert_eq!(weighted(&[f32::INFINITY; 3], 2, &PolicyRng::new(1, 1)), [0, 1]);
    }

    #[test]
    fn draws_follow_the_weights_without_replacement() {
        // Two of the weights 1, 2, 5: (i, j) has probability w_i / 8 · w_j / (8 − w_i).
        let weights = [1.0, 2.0, 5.0];
        let trials = 40_000;
        let mut counts = [[0.0_f64; 3]; 3];
        for step in 0..trials {
            let drawn = weighted(&weights, 2, &PolicyRng::new(77, step));
            assert_eq!(drawn.len(), 2);
            counts[drawn[0] as usize][drawn[1] as usize] += 1.0;
        }
        for i in 0..3 {
            for j in 0..3 {
                let (first, second) = (f64::from(weights[i]), f64::from(weights[j]));
                let p = if i == j { 0.0 } else { first / 8.0 * second / (8.0 - first) };
                let n = f64::from(trials);
                let bound = 5.0 * (n * p * (1.0 - p)).sqrt();
                assert!((counts[i][j] - n * p).abs() <= bound, "{i} {j}: {}", counts[i][j] / n);
            }
        }
    }

    #[test]
    fn draws_with_replacement_follow_the_weights() {
        let weights = [0.0, 1.0, NAN, 3.0, -1.0, 4.0, 0.0];
        let trials = 40_000_usize;
        let drawn = with_replacement(&weights, trials, &PolicyRng::new(5, 9));
        let rows: Vec<u32> = drawn.iter().map(|(row, _)| *row).collect();
        assert_eq!(rows, [1, 3, 5]);
        assert_eq!(drawn.iter().map(|(_, n)| *n as usize).sum::<usize>(), trials);
        for (row, count) in drawn {
            let p = f64::from(weights[row as usize]) / 8.0;
            let n = trials as f64;
            let bound = 5.0 * (n * p * (1.0 - p)).sqrt();
            assert!((f64::from(count) - n * p).abs() < bound, "{row}: {count}");
        }
        let rng = PolicyRng::new(1, 1);
        assert!(with_replacement(&[0.0, NAN, -2.0], 9, &rng).is_empty());
        assert!(with_replacement(&[1.0], 0, &rng).is_empty());
        assert_eq!(with_replacement(&[0.0, 1e-40, 0.0], 3, &rng), [(1, 3)]);
        assert_eq!(with_replacement(&[1.0, f32::INFINITY], 3, &rng), [(1, 3)]);
        assert_eq!(with_replacement(&[f32::INFINITY; 3], 99, &rng).len(), 3);
    }
}
