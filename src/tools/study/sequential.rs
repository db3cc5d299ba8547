//! The sequential test of `--until-decided`: looks at paired differences after every seed and says when they decide.
//!
//! With n seeds let m be the mean of the differences, e its standard error, and t(p) the quantile of Student's t with
//! n − 1 degrees of freedom.
//!
//! - *Better* or *worse*: the interval m ± t(1 − α/2) e excludes 0. An interval of 95 % at every look would exclude 0 in
//!   18 of 100 comparisons of equal policies, as each look is another chance (Armitage, McPherson and Rowe 1969). α is
//!   therefore one constant for all looks (Pocock 1977), such that with up to `most` seeds 5 of 100 are called better or
//!   worse: a repeated confidence interval (Jennison and Turnbull 2000, chapter 9). The table of α is simulated, as
//!   Pocock's own is for a known variance; it does not depend on the variance.
//! - *Not worse*: otherwise, as soon as t(0.975) e is at most [`PRECISION`], and at `most` seeds in any case: m is at
//!   least −[`TOLERANCE`].

use statrs::distribution::{ContinuousCDF, StudentsT};

use super::difference::mean;
use super::standard_error;

/// Half width of the plain 95 % interval at which the mean decides `[dB]`.
const PRECISION: f64 = 0.2;
/// Loss that does not count as worse `[dB]`.
const TOLERANCE: f64 = 0.1;
/// Number of seeds at the first look.
pub(super) const FIRST_LOOK: usize = 3;
/// α of every look, by the number of seeds at the last, from [`FIRST_LOOK`]: the 5 % quantiles of the smallest p-value
/// over all looks, from 400,000 simulated sequences of normal differences with mean 0.
const LEVELS: [f64; 10] =
    [0.05, 0.0307, 0.0230, 0.0189, 0.0162, 0.0144, 0.0131, 0.0121, 0.0113, 0.0106];

/// The numbers of seeds that [`Rule::new`] accepts.
pub(super) const SEEDS: std::ops::RangeInclusive<i64> = 3..=12;

/// The rule, fixed before the first look.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rule {
    most: usize,
    level: f64,
}

/// What the differences say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    Better,
    Worse,
    NotWorse,
    /// Neither better nor worse by an interval, but the mean is below the tolerance.
    NotShown,
    /// More seeds are needed.
    Undecided,
}

/// The state of a comparison after a look.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Decision {
    pub(super) verdict: Verdict,
    /// Number of seeds at the look.
    pub(super) seeds: usize,
    /// Mean difference at the look; `None` without a pair.
    pub(super) mean: Option<f64>,
    /// Interval that covers the true mean at all looks together in 95 of 100 comparisons; `None` before the first look.
    pub(super) interval: Option<[f64; 2]>,
    /// True if the mean has decided at the last look although it is not known to within the precision.
    pub(super) by_mean_alone: bool,
}

impl Rule {
    /// The rule with a look after every seed up to `most`, a number in [`SEEDS`].
    pub(super) fn new(most: u32) -> Self {
        let most = (most as usize).clamp(FIRST_LOOK, FIRST_LOOK + LEVELS.len() - 1);
        Self { most, level: LEVELS[most - FIRST_LOOK] }
    }

    /// The decision on differences in the order of their seeds, policy minus first policy `[dB]`. A decision is final:
    /// later differences do not change it.
    pub(super) fn decide(self, differences: &[f64]) -> Decision {
        let differences = &differences[..differences.len().min(self.most)];
        let looks = FIRST_LOOK..=differences.len();
        let mut decisions = looks.map(|seeds| self.look(&differences[..seeds]));
        let decided = decisions.by_ref().find(|decision| decision.verdict != Verdict::Undecided);
        decided.unwrap_or_else(|| self.look(differences))
    }

    fn look(self, differences: &[f64]) -> Decision {
        let seeds = differences.len();
        let mean = mean(differences.iter().copied());
        let undecided = Decision {
            verdict: Verdict::Undecided,
            seeds,
            mean,
            interval: None,
            by_mean_alone: false,
        };
        let (Some(mean), Some(error)) = (mean, standard_error(differences)) else {
            return undecided;
        };
        if seeds < FIRST_LOOK {
            return undecided;
        }
        let half = |level: f64| student_quantile(seeds, level) * error;
        let wide = half(self.level);
        let interval = Some([mean - wide, mean + wide]);
        let is_precise = half(0.05) <= PRECISION;
        let is_last = seeds >= self.most;
        let verdict = match mean {
            _ if mean - wide > 0.0 => Verdict::Better,
            _ if mean + wide < 0.0 => Verdict::Worse,
            _ if !is_precise && !is_last => Verdict::Undecided,
            _ if mean >= -TOLERANCE => Verdict::NotWorse,
            _ => Verdict::NotShown,
        };
        let by_mean = matches!(verdict, Verdict::NotWorse | Verdict::NotShown);
        Decision { verdict, interval, by_mean_alone: by_mean && !is_precise, ..undecided }
    }

    /// The rule for the user. `base` is the policy with which the others are compared, `of` what is decided.
    pub(super) fn text(self, base: &str, of: &str) -> String {
        let Self { most, level } = self;
        format!(
            "{of}, the differences in PSNR from {base}, paired by seed, are looked at after every \
             seed from {FIRST_LOOK} to {most}. Better or worse: their {:.1} % interval (Student's t) \
             excludes 0; over all looks together that is a 95 % interval, so that of 100 comparisons \
             without a difference 5 are called better or worse. Not worse: otherwise, once the plain \
             95 % interval is within ±{PRECISION} dB, or at {most} seeds, the mean is at least \
             −{TOLERANCE} dB. Undecided: neither, when the hours are over",
            100.0 * (1.0 - level)
        )
    }
}

/// Student's t for a two-sided interval of 1 − `level` over values of this number, >= 2.
fn student_quantile(values: usize, level: f64) -> f64 {
    let student = StudentsT::new(0.0, 1.0, values as f64 - 1.0);
    student.map_or(f64::INFINITY, |student| student.inverse_cdf(1.0 - level / 2.0))
}

impl Decision {
    /// The verdict in words.
    pub(super) fn words(&self) -> String {
        let word = match self.verdict {
            Verdict::Better => "better",
            Verdict::Worse => "worse",
            Verdict::NotWorse => "not worse",
            Verdict::NotShown => "mean below −0.1 dB",
            Verdict::Undecided => "undecided",
        };
        let by_mean = if self.by_mean_alone { ", by the mean alone" } else { "" };
        format!("{word}{by_mean}")
    }

    /// The mean with its interval, as `+0.12 [-0.05, +0.29]`.
    pub(super) fn difference(&self) -> String {
        let mean = self.mean.map_or_else(|| "–".to_owned(), |mean| format!("{mean:+.2}"));
        let interval = |[low, high]: [f64; 2]| format!(" [{low:+.2}, {high:+.2}]");
        mean + &self.interval.map_or_else(String::new, interval)
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use statrs::distribution::Normal;

    use super::*;

    /// Decisions on simulated comparisons whose differences have this mean and standard deviation.
    fn simulate(count: usize, mean: f64, deviation: f64, most: u32) -> Vec<Decision> {
        let normal = Normal::new(mean, deviation).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(u64::from(most));
        let rule = Rule::new(most);
        let comparison = |_| {
            let draws = (0..most).map(|_| normal.inverse_cdf(rng.random_range(1e-9..1.0)));
            rule.decide(&draws.collect::<Vec<_>>())
        };
        (0..count).map(comparison).collect()
    }

    fn share(decisions: &[Decision], is: impl Fn(&Decision) -> bool) -> f64 {
        decisions.iter().filter(|d| is(d)).count() as f64 / decisions.len() as f64
    }

    /// Without a difference, 5 of 100 comparisons may be called better or worse, however often one looks. A deviation
    /// of 100 dB excludes that precision ends them early; then the rate is 5 %, not less.
    #[test]
    fn looking_after_every_seed_keeps_the_error_rate() {
        let is_called = |d: &Decision| matches!(d.verdict, Verdict::Better | Verdict::Worse);
        for most in [3, 4, 7, 12] {
            let rate = share(&simulate(3000, 0.0, 100.0, most), is_called);
            // Three standard errors of the share.
            assert!((rate - 0.05).abs() < 0.012, "{rate} with up to {most} seeds");
        }
        for deviation in [0.1, 0.3, 0.5] {
            let rate = share(&simulate(3000, 0.0, deviation, 12), is_called);
            assert!(rate < 0.062, "{rate} at {deviation} dB");
        }
    }

    /// The interval at the look that decides contains the true mean in 95 of 100 comparisons.
    #[test]
    fn intervals_contain_the_true_mean_at_the_look_that_decides() {
        for (mean, deviation) in [(0.0, 0.3), (-0.3, 0.3), (1.0, 0.5), (0.5, 1.0)] {
            let contains =
                |d: &Decision| d.interval.is_some_and(|[low, high]| low <= mean && mean <= high);
            let rate = share(&simulate(2000, mean, deviation, 12), contains);
            assert!(rate > 0.935, "{rate} at {mean} ± {deviation} dB");
        }
    }

    /// Rates of the verdicts where policies differ: large differences are found with few seeds, and a policy that is
    /// worse by 0.3 dB is rarely called not worse unless seeds differ by more than that.
    #[test]
    fn differences_are_found() {
        let is = |verdict: Verdict| move |d: &Decision| d.verdict == verdict;
        let far_better = simulate(1000, 1.0, 0.3, 12);
        assert!(share(&far_better, is(Verdict::Better)) > 0.99);
        let seeds = mean(far_better.iter().map(|d| d.seeds as f64)).unwrap();
        assert!(seeds < 4.5, "{seeds}");
        let worse = simulate(1000, -0.3, 0.3, 12);
        let not_worse = share(&worse, is(Verdict::NotWorse));
        assert!(not_worse < 0.06, "{not_worse}");
        assert!(share(&worse, is(Verdict::Worse)) > 0.5);
        let equal = share(&simulate(1000, 0.0, 0.3, 12), is(Verdict::NotWorse));
        assert!(equal > 0.78, "{equal}");
        assert!(share(&simulate(1000, 0.0, 0.3, 12), is(Verdict::Undecided)) == 0.0);
    }

    #[test]
    fn a_decision_is_final_and_says_how_it_was_reached() {
        let rule = Rule::new(12);
        let verdict = |differences: &[f64]| rule.decide(differences).verdict;
        assert_eq!(verdict(&[]), Verdict::Undecided);
        assert_eq!(verdict(&[9.0, 9.1]), Verdict::Undecided);
        assert_eq!(verdict(&[-1.0, 1.0, 0.0]), Verdict::Undecided);
        assert_eq!(verdict(&[-0.05, 0.0, 0.05]), Verdict::NotWorse);
        assert_eq!(verdict(&[-0.2, -0.1, -0.06]), Verdict::NotShown);
        assert_eq!(verdict(&[-1.0, -1.1, -0.9]), Verdict::Worse);
        let early = rule.decide(&[1.0, 1.1, 0.9, -9.0, -9.0]);
        assert_eq!((early.verdict, early.seeds), (Verdict::Better, 3));
        // t(0.9947) of two degrees of freedom is 9.63.
        assert_eq!(early.difference(), "+1.00 [+0.44, +1.56]");
        let last = Rule::new(3).decide(&[-1.0, 1.0, 0.1]);
        assert_eq!(last.words(), "not worse, by the mean alone");
        assert_eq!(Rule::new(3).decide(&[-1.0, 0.5]).difference(), "-0.25");
        let text = rule.text("diet", "On each scene");
        for words in ["from diet", "98.9 % interval", "±0.2 dB", "−0.1 dB", "from 3 to 12"] {
            assert!(text.contains(words), "{words}: {text}");
        }
    }
}
