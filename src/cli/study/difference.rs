//! Paired differences, with bootstrap intervals.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Resamples of a bootstrap: the interval's ends then move by less than a hundredth of its width.
const RESAMPLES: usize = 10_000;

/// The mean of paired differences.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::cli) struct Difference {
    pub(in crate::cli) mean: f64,
    /// 95 % percentile bootstrap interval of the mean (Efron and Tibshirani 1993, chapter 13); none
    /// for a single pair.
    pub(in crate::cli) interval: Option<[f64; 2]>,
    pub(in crate::cli) pairs: usize,
    /// Pairs in which the difference is above zero.
    pub(in crate::cli) above: usize,
    /// Pairs in which it is below zero.
    pub(in crate::cli) below: usize,
}

impl Difference {
    /// Of these; `None` where there are none.
    pub(in crate::cli) fn of(differences: &[f64]) -> Option<Self> {
        let pairs = differences.len();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        if pairs == 0 {
            return None;
        }
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
        Some(Self { mean: mean(differences), interval, pairs, above, below })
    }

    /// `+0.12 [+0.05, +0.19]`.
    pub(in crate::cli) fn show(&self, digits: usize) -> String {
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
        let few = Difference::of(&[0.0, 1.0, 2.0]).unwrap();
        assert!((few.mean - 1.0).abs() < 1e-12 && (few.pairs, few.above, few.below) == (3, 2, 0));
        let [low, high] = few.interval.unwrap();
        // The mean of three draws is 0 or 2 in 1 of 27 cases each, so both ends are reached.
        assert!(low.abs() < 1e-12 && (high - 2.0).abs() < 1e-12);
        let many: Vec<f64> = (0..300).map(|i| f64::from(i % 3)).collect();
        let [low, high] = Difference::of(&many).unwrap().interval.unwrap();
        // Standard error √(2/3/300) = 0.047.
        assert!((low - 0.908).abs() < 0.01 && (high - 1.092).abs() < 0.01, "{low} {high}");
        assert_eq!(Difference::of(&[0.5]).unwrap().show(2), "+0.50");
        assert_eq!(Difference::of(&[0.5, 0.5]).unwrap().show(1), "+0.5 [+0.5, +0.5]");
        assert!(Difference::of(&[]).is_none());
    }
}
