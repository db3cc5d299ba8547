//! Means of paired differences with confidence intervals.

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use statrs::distribution::{ContinuousCDF, StudentsT};

/// Number of resamples of a bootstrap, enough for a standard error accurate to one percent.
const RESAMPLES: usize = 10_000;
/// Minimum number of runs, or of scenes, for which an interval is computed.
const MIN_VALUES: usize = 3;

/// Explanation of the intervals of [`Difference`], for reports.
pub(super) const INTERVALS: &str = "Brackets are 95 % intervals of the mean: over seeds by Student's t; over several scenes by \
     resampling scenes and then their seeds, with the standard error multiplied by Student's t, as \
     scenes are few. No interval is given for fewer than three seeds, or three scenes";

/// Mean of some numbers; `None` if there are none.
pub(super) fn mean(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let (sum, count) =
        values.into_iter().fold((0.0, 0_u32), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}

/// A difference between two runs of the same scene and seed.
#[derive(Debug, Clone, Copy)]
pub struct Pair<'a> {
    /// The scene of both runs.
    pub scene: &'a str,
    /// The seed of both runs.
    pub seed: u32,
    /// Value of the second run minus that of the first.
    pub difference: f64,
}

/// The mean of paired differences.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// Mean over scenes of the means over seeds.
    pub mean: f64,
    /// 95 % confidence interval of the mean ([`INTERVALS`]).
    pub(super) interval: Option<[f64; 2]>,
    /// Number of pairs.
    pub(super) pairs: usize,
    /// Largest number of seeds of a scene, >= 1.
    pub(super) seeds: usize,
    /// Number of pairs with a positive difference.
    pub(super) above: usize,
    /// Number of pairs with a negative difference.
    pub(super) below: usize,
    /// Number of scenes, >= 1.
    pub(super) scenes: usize,
}

impl Difference {
    /// Computes the statistics of pairs; `None` if there are none.
    pub fn new(pairs: &[Pair<'_>]) -> Option<Self> {
        let mut by_scene: BTreeMap<&str, BTreeMap<u32, Vec<f64>>> = BTreeMap::new();
        for pair in pairs {
            let seeds = by_scene.entry(pair.scene).or_default();
            seeds.entry(pair.seed).or_default().push(pair.difference);
        }
        // Runs of one seed with several budgets start alike, so only their mean is an independent value.
        let means = |seeds: BTreeMap<u32, Vec<f64>>| seeds.into_values().filter_map(mean).collect();
        let by_scene: Vec<Vec<f64>> = by_scene.into_values().map(means).collect();
        let mean = mean(by_scene.iter().filter_map(|seeds| mean(seeds.iter().copied())))?;
        let half = match &by_scene[..] {
            [seeds] => half_interval_over_seeds(seeds),
            scenes => half_interval_over_scenes(scenes),
        };
        let count = |has: fn(f64) -> bool| pairs.iter().filter(|pair| has(pair.difference)).count();
        Some(Self {
            mean,
            interval: half.map(|half| [mean - half, mean + half]),
            pairs: pairs.len(),
            seeds: by_scene.iter().map(Vec::len).max().unwrap_or(0),
            above: count(|d| d > 0.0),
            below: count(|d| d < 0.0),
            scenes: by_scene.len(),
        })
    }

    /// Formats the mean and its interval, as `+0.12 [+0.05, +0.19]`, or `+0.12, two runs` if there is no interval.
    pub fn format(&self, digits: usize) -> String {
        let low_and_high = |[low, high]: [f64; 2]| format!("{low:+.digits$}, {high:+.digits$}");
        format!("{:+.digits$}{}", self.mean, self.format_interval(low_and_high))
    }

    /// Formats the interval in brackets, or the reason why there is none, to follow the mean.
    pub fn format_interval(&self, bounds: impl Fn([f64; 2]) -> String) -> String {
        let reason = match (self.scenes, self.seeds, self.pairs == self.seeds) {
            (2.., ..) => "two scenes",
            (_, 1, true) => "one run",
            (_, 1, false) => "one seed",
            (_, _, true) => "two runs",
            (_, _, false) => "two seeds",
        };
        self.interval
            .map_or_else(|| format!(", {reason}"), |interval| format!(" [{}]", bounds(interval)))
    }
}

/// Student's t for a 95 % interval; `None` for too few values.
fn student_factor(values: usize) -> Option<f64> {
    let degrees_of_freedom = values.checked_sub(1).filter(|_| values >= MIN_VALUES)?;
    Some(StudentsT::new(0.0, 1.0, degrees_of_freedom as f64).ok()?.inverse_cdf(0.975))
}

/// Half the width of the interval of the mean of independent values.
fn half_interval_over_seeds(values: &[f64]) -> Option<f64> {
    Some(student_factor(values.len())? * super::standard_error(values)?)
}

/// Half the width of the interval of the mean if scenes are resampled first and then their seeds. The variance of a
/// bootstrap over `n` scenes is too small by the factor (n − 1)/n. With few scenes, percentiles of the bootstrap
/// would not cover the mean often enough (Efron and Tibshirani 1993, chapters 8 and 12).
fn half_interval_over_scenes(scenes: &[Vec<f64>]) -> Option<f64> {
    let n = scenes.len();
    let factor = student_factor(n)? * (n as f64 / (n as f64 - 1.0)).sqrt();
    // The seed is fixed so that reports are reproducible.
    let mut rng = ChaCha8Rng::seed_from_u64(n as u64);
    let mut resample = || {
        let scene = |rng: &mut ChaCha8Rng| {
            let seeds = &scenes[rng.random_range(0..n)];
            let draws = (0..seeds.len()).map(|_| seeds[rng.random_range(0..seeds.len())]);
            draws.sum::<f64>() / seeds.len() as f64
        };
        (0..n).map(|_| scene(&mut rng)).sum::<f64>() / n as f64
    };
    let means: Vec<f64> = (0..RESAMPLES).map(|_| resample()).collect();
    let deviation = super::standard_error(&means)? * (RESAMPLES as f64).sqrt();
    Some(factor * deviation)
}

#[cfg(test)]
mod tests {
    use statrs::distribution::Normal;

    use super::*;

    /// The statistics of these differences, by scene and seed.
    fn difference(scenes: &[&[f64]]) -> Option<Difference> {
        let names: Vec<String> = (0..scenes.len()).map(|i| i.to_string()).collect();
        let pairs = names.iter().zip(scenes).flat_map(|(scene, seeds)| {
            let pair = |(seed, &difference)| Pair { scene, seed, difference };
            (0..).zip(seeds.iter()).map(pair)
        });
        Difference::new(&pairs.collect::<Vec<_>>())
    }

    /// Quantiles of Student's t at 97.5 %, as printed in any table.
    #[test]
    fn intervals_over_seeds_follow_students_t() {
        let root = f64::sqrt;
        // Standard errors √(1/3), √(2.5/5), √(9.1667/10).
        let ten: Vec<f64> = (1..=10).map(f64::from).collect();
        for (values, quantile, error) in [
            (&[0.0, 1.0, 2.0][..], 4.303, root(1.0 / 3.0)),
            (&[1.0, 2.0, 3.0, 4.0, 5.0], 2.776, root(0.5)),
            (&ten, 2.262, root(55.0 / 60.0)),
        ] {
            let found = difference(&[values]).unwrap();
            let [low, high] = found.interval.unwrap();
            assert!((high - found.mean - quantile * error).abs() < 1e-3 * error, "{high}");
            assert!((found.mean - low - (high - found.mean)).abs() < 1e-12);
        }
        let found = difference(&[&[0.0, 1.0, 2.0]]).unwrap();
        assert!((found.mean - 1.0).abs() < 1e-12);
        assert_eq!((found.pairs, found.above, found.below), (3, 2, 0));
        assert_eq!(difference(&[&[0.5; 3]]).unwrap().format(1), "+0.5 [+0.5, +0.5]");
    }

    #[test]
    fn too_few_runs_or_scenes_give_a_reason_instead_of_an_interval() {
        for (scenes, expected) in [
            (&[&[0.5][..]][..], "+0.50, one run"),
            (&[&[0.0, 1.0]], "+0.50, two runs"),
            (&[&[0.0; 9], &[1.0; 9]], "+0.50, two scenes"),
        ] {
            assert_eq!(difference(scenes).unwrap().format(2), expected);
        }
        assert!(difference(&[]).is_none());
        // Several budgets of one seed are not independent.
        let pair = |difference| Pair { scene: "room", seed: 0, difference };
        let found = Difference::new(&[pair(1.0), pair(2.0), pair(3.0)]).unwrap();
        assert_eq!((found.format(1).as_str(), found.pairs), ("+2.0, one seed", 3));
    }

    /// The variance of a resampled mean is (variance of the scenes' means + mean over scenes of the seeds' variance
    /// divided by their number) / number of scenes.
    #[test]
    fn resampled_errors_match_the_closed_form() {
        let scenes: [&[f64]; 4] = [&[0.0, 1.0, 2.0], &[2.0, 4.0], &[-1.0, 0.0, 4.0], &[5.0]];
        let variance = |values: &[f64]| {
            let mean = mean(values.iter().copied()).unwrap();
            values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64
        };
        let means = scenes.map(|seeds| mean(seeds.iter().copied()).unwrap());
        let within = scenes.map(|seeds| variance(seeds) / seeds.len() as f64);
        let error = ((variance(&means) + mean(within).unwrap()) / 4.0).sqrt();
        let expected = 3.182 * (4.0_f64 / 3.0).sqrt() * error;
        let found = difference(&scenes).unwrap();
        let half = found.interval.unwrap()[1] - found.mean;
        assert!((half / expected - 1.0).abs() < 0.03, "{half}, not {expected}");
    }

    /// In simulated studies of three scenes and three seeds, 19 of 20 intervals must contain the true mean, whether
    /// scenes differ or not. Only 15 to 17 of 20 percentile intervals would contain it.
    #[test]
    fn intervals_over_scenes_contain_the_true_mean_as_often_as_claimed() {
        let normal = Normal::new(0.0, 1.0).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for scene_deviation in [0.0, 1.0, 5.0] {
            let mut draw = || normal.inverse_cdf(rng.random_range(1e-9..1.0));
            let holds = |_: &usize| {
                let scenes = [(); 3].map(|()| {
                    let scene = scene_deviation * draw();
                    [(); 3].map(|()| scene + draw())
                });
                let [low, high] =
                    difference(&scenes.each_ref().map(|s| &s[..])).unwrap().interval.unwrap();
                low <= 0.0 && 0.0 <= high
            };
            let count = (0..200).filter(holds).count();
            // The expected count is at least 190; the first percentile of the count is 182.
            assert!(count >= 182, "{count} of 200 where scenes differ by {scene_deviation}");
        }
    }
}
