//! Paired differences, with bootstrap intervals.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Resamples of a bootstrap: the interval's ends then move by less than a hundredth of its width.
const RESAMPLES: usize = 10_000;

/// The mean of some numbers; `None` without any.
pub(super) fn mean(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let (sum, count) =
        values.into_iter().fold((0.0, 0_u32), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}

/// The mean of paired differences.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Difference {
    pub(super) mean: f64,
    /// 95 % percentile bootstrap interval of the mean (Efron and Tibshirani 1993, chapter 13); none
    /// for a single pair.
    pub(super) interval: Option<[f64; 2]>,
    pub(super) pairs: usize,
    /// Pairs in which the difference is above zero.
    pub(super) above: usize,
    /// Pairs in which it is below zero.
    pub(super) below: usize,
}

impl Difference {
    /// The statistics of these differences; `None` where there are none.
    pub(super) fn new(differences: &[f64]) -> Option<Self> {
        let pairs = differences.len();
        let mean = mean(differences.iter().copied())?;
        let interval = (pairs > 1).then(|| {
            // The same resamples at every call: a table does not change by being written again.
            let mut rng = ChaCha8Rng::seed_from_u64(pairs as u64);
            let mut means: Vec<f64> = (0..RESAMPLES)
                .map(|_| {
                    let draws = (0..pairs).map(|_| differences[rng.random_range(0..pairs)]);
                    draws.sum::<f64>() / pairs as f64
                })
                .collect();
            means.sort_by(f64::total_cmp);
            [0.025, 0.975].map(|q| means[(q * (RESAMPLES - 1) as f64).round() as usize])
        });
        let above = differences.iter().filter(|&&d| d > 0.0).count();
        let below = differences.iter().filter(|&&d| d < 0.0).count();
        Some(Self { mean, interval, pairs, above, below })
    }

    /// `+0.12 [+0.05, +0.19]`.
    pub(super) fn show(&self, digits: usize) -> String {
        let mean = format!("{:+.digits$}", self.mean);
        match self.interval {
            Some([low, high]) => format!("{mean} [{low:+.digits$}, {high:+.digits$}]"),
            None => mean,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_hold_the_mean_and_shrink_with_the_pairs() {
        let few = Difference::new(&[0.0, 1.0, 2.0]).unwrap();
        assert!((few.mean - 1.0).abs() < 1e-12 && (few.pairs, few.above, few.below) == (3, 2, 0));
        let [low, high] = few.interval.unwrap();
        // The mean of three draws is 0 or 2 in 1 of 27 cases each, so both ends are reached.
        assert!(low.abs() < 1e-12 && (high - 2.0).abs() < 1e-12);
        let many: Vec<f64> = (0..300).map(|i| f64::from(i % 3)).collect();
        let [low, high] = Difference::new(&many).unwrap().interval.unwrap();
        // Standard error √(2/3/300) = 0.047.
        assert!((low - 0.908).abs() < 0.01 && (high - 1.092).abs() < 0.01, "{low} {high}");
        assert_eq!(Difference::new(&[0.5]).unwrap().show(2), "+0.50");
        assert_eq!(Difference::new(&[0.5, 0.5]).unwrap().show(1), "+0.5 [+0.5, +0.5]");
        assert!(Difference::new(&[]).is_none());
    }
}
