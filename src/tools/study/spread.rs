//! Divides the variance of the scores of single views into the parts due to seeds and due to views.
//!
//! All runs of a scene are scored on the same views, so seeds and views are crossed: the value of seed k in view v is
//! m + s(k) + w(v) + r(k, v), with independent random parts. Their variances follow from the mean squares of the two-way
//! analysis of variance without replication (Searle, Casella and McCulloch 1992, §4.4), and so does the error of the
//! mean for other seeds and other views of the scene, with degrees of freedom by Satterthwaite (1946).

use std::collections::{BTreeMap, BTreeSet};

use statrs::distribution::{ContinuousCDF, StudentsT};

use super::difference::mean;

/// The parts of the spread. Variances are >= 0, in squared units of the values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Spread {
    /// Mean of all values.
    pub(super) mean: f64,
    /// Variance between seeds, the same in all views.
    pub(super) seeds: f64,
    /// Variance between views, the same for all seeds.
    pub(super) views: f64,
    /// Variance of the rest: particular seeds render particular views better or worse.
    pub(super) rest: f64,
    /// Squared standard error of the mean, with seeds and views as random draws, and its degrees of freedom.
    error: (f64, f64),
}

impl Spread {
    /// The parts of the spread of `values`, by seed and view. Uses only views that have a value for every seed; `None` for fewer
    /// than two seeds or views, or values that are not finite.
    pub(super) fn new(values: &[BTreeMap<&str, f64>]) -> Option<Self> {
        let (first, others) = values.split_first()?;
        let mut names: BTreeSet<&str> = first.keys().copied().collect();
        names.retain(|name| others.iter().all(|seed| seed.contains_key(name)));
        let rows: Vec<Vec<f64>> =
            values.iter().map(|seed| names.iter().map(|name| seed[name]).collect()).collect();
        let (seeds, views) = (rows.len() as f64, names.len() as f64);
        if rows.len() < 2 || names.len() < 2 || rows.iter().flatten().any(|v| !v.is_finite()) {
            return None;
        }
        let all = mean(rows.iter().flatten().copied())?;
        let of_seeds: Vec<f64> =
            rows.iter().map(|row| mean(row.iter().copied())).collect::<Option<_>>()?;
        let of_views: Vec<f64> = (0..names.len())
            .map(|view| mean(rows.iter().map(|row| row[view])))
            .collect::<Option<_>>()?;
        let squares = |means: &[f64]| means.iter().map(|m| (m - all).powi(2)).sum::<f64>();
        let residuals = rows.iter().zip(&of_seeds).flat_map(|(row, seed)| {
            row.iter().zip(&of_views).map(move |(value, view)| (value - seed - view + all).powi(2))
        });
        let degrees = [seeds - 1.0, views - 1.0, (seeds - 1.0) * (views - 1.0)];
        let squares = [
            views * squares(&of_seeds) / degrees[0],
            seeds * squares(&of_views) / degrees[1],
            residuals.sum::<f64>() / degrees[2],
        ];
        let [by_seed, by_view, rest] = squares;
        // Negative estimates of variances mean that there is no such part.
        let numerator = by_seed + by_view - rest;
        let error = if numerator >= by_seed.max(by_view) {
            let terms = squares.iter().zip(degrees).map(|(square, n)| square * square / n);
            (numerator, numerator * numerator / terms.sum::<f64>())
        } else if by_seed >= by_view {
            (by_seed, degrees[0])
        } else {
            (by_view, degrees[1])
        };
        Some(Self {
            mean: all,
            seeds: ((by_seed - rest) / views).max(0.0),
            views: ((by_view - rest) / seeds).max(0.0),
            rest,
            error: (error.0 / (seeds * views), error.1),
        })
    }

    /// Fractions of the variance of a single value that are due to the seeds, to the views and to the rest.
    pub(super) fn shares(&self) -> [f64; 3] {
        let sum = self.seeds + self.views + self.rest;
        [self.seeds, self.views, self.rest].map(|part| if sum > 0.0 { part / sum } else { 0.0 })
    }

    /// 95 % interval of the mean over the means of scenes, for other seeds and other views of the same scenes; `None`
    /// without scenes.
    pub(super) fn interval(scenes: &[Self]) -> Option<(f64, [f64; 2])> {
        let mean = mean(scenes.iter().map(|scene| scene.mean))?;
        let count = scenes.len() as f64;
        let parts = scenes.iter().map(|scene| (scene.error.0 / count.powi(2), scene.error.1));
        let variance: f64 = parts.clone().map(|(variance, _)| variance).sum();
        let terms: f64 = parts.map(|(variance, degrees)| variance * variance / degrees).sum();
        // Equal values have no error.
        let degrees = if terms > 0.0 { variance * variance / terms } else { 1.0 };
        let quantile = StudentsT::new(0.0, 1.0, degrees.max(1.0)).ok()?.inverse_cdf(0.975);
        let half = quantile * variance.sqrt();
        Some((mean, [mean - half, mean + half]))
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use statrs::distribution::Normal;

    use super::*;

    const NAMES: [&str; 12] = ["a", "b", "c", "d", "e", "f", "g", "h", "i", "j", "k", "l"];

    fn by_name(rows: &[Vec<f64>]) -> Vec<BTreeMap<&'static str, f64>> {
        rows.iter().map(|row| NAMES.into_iter().zip(row.iter().copied()).collect()).collect()
    }

    fn assert_near(found: &[f64], expected: &[f64]) {
        let is_near = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-12;
        assert!(found.iter().zip(expected).all(is_near), "{found:?}, not {expected:?}");
    }

    /// Two seeds and two views, by hand: seeds' means 1 and 4, views' means 2 and 3, mean 2.5. The residuals are ±0.5.
    #[test]
    fn mean_squares_match_those_by_hand() {
        let spread = Spread::new(&by_name(&[vec![1.0, 1.0], vec![3.0, 5.0]])).unwrap();
        // Mean squares: seeds 2 · 2 · 1.5² = 9, views 2 · 2 · 0.5² = 1, rest 4 · 0.5² = 1.
        let parts = [spread.mean, spread.seeds, spread.views, spread.rest];
        assert_near(&parts, &[2.5, 4.0, 0.0, 1.0]);
        assert_near(&spread.shares(), &[0.8, 0.0, 0.2]);
        // Variance (9 + 1 − 1)/4 with 81/83 degrees of freedom, taken as 1: t is 12.71.
        let (mean, [low, high]) = Spread::interval(&[spread]).unwrap();
        assert!((high - mean - 12.706 * 1.5).abs() < 0.01 && (low + high - 5.0).abs() < 1e-9);
    }

    #[test]
    fn only_views_of_all_seeds_count() {
        let mut values = by_name(&[vec![1.0, 1.0, 99.0], vec![3.0, 5.0]]);
        assert_near(&[Spread::new(&values).unwrap().mean], &[2.5]);
        values.push(BTreeMap::new());
        assert_eq!(Spread::new(&values), None);
        assert_eq!(Spread::new(&by_name(&[vec![1.0, f64::INFINITY], vec![3.0, 5.0]])), None);
        assert_eq!(Spread::new(&by_name(&[vec![1.0, 2.0]])), None);
        assert_eq!(Spread::interval(&[]), None);
    }

    /// Where the variances of seeds, views and rest are known, their estimates agree on average, and 19 of 20 intervals
    /// contain the true mean, of one scene and of the mean over three.
    #[test]
    fn known_variances_and_means_are_found() {
        let normal = Normal::new(0.0, 1.0).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut draw = |deviation: f64| deviation * normal.inverse_cdf(rng.random_range(1e-9..1.0));
        for deviations in [[1.0, 0.3, 0.3], [0.3, 1.0, 0.5], [0.5, 0.5, 0.5], [0.0, 1.0, 0.1]] {
            let mut scene = || {
                let views: Vec<f64> = NAMES.iter().map(|_| draw(deviations[1])).collect();
                let row = |_| {
                    let seed = draw(deviations[0]);
                    views.iter().map(|view| seed + view + draw(deviations[2])).collect()
                };
                Spread::new(&by_name(&(0..5).map(row).collect::<Vec<Vec<f64>>>())).unwrap()
            };
            let scenes: Vec<Spread> = (0..900).map(|_| scene()).collect();
            let parts: [fn(&Spread) -> f64; 3] = [|s| s.seeds, |s| s.views, |s| s.rest];
            for (part, deviation) in parts.into_iter().zip(deviations) {
                let found = mean(scenes.iter().map(part)).unwrap();
                assert!((found - deviation.powi(2)).abs() < 0.07, "{found} for {deviation}²");
            }
            for count in [1, 3] {
                let sets: Vec<&[Spread]> = scenes.chunks(count).collect();
                let contains = |set: &&&[Spread]| {
                    let (_, [low, high]) = Spread::interval(set).unwrap();
                    low <= 0.0 && 0.0 <= high
                };
                let rate = sets.iter().filter(contains).count() as f64 / sets.len() as f64;
                assert!(rate > 0.91, "{rate} of {count} scenes at {deviations:?}");
            }
        }
    }
}
