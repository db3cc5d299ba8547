//! What is learned from the runs, as pure functions of numbers: which effects stand out, which levels others
//! dominate, which are free, and what knobs do among each other.

use crate::study::difference::Difference;
use crate::study::standard_error;

/// Runs of a factorial.
pub(super) const RUNS: usize = 12;
/// Knobs that it has room for.
pub(super) const FACTORS: usize = RUNS - 1;

/// Whether the mean is more than two standard errors from zero.
pub(super) fn stands_out(differences: &[f64]) -> bool {
    let mean = differences.iter().sum::<f64>() / differences.len() as f64;
    standard_error(differences).is_some_and(|error| mean.abs() > 2.0 * error)
}

/// What a level costs and buys: less is better in each but the first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Price {
    /// Gain in PSNR `[dB]`.
    pub(super) psnr: f64,
    /// Time, as a ratio.
    pub(super) seconds: f64,
    /// Peak memory, as a ratio.
    pub(super) peak: f64,
}

/// The first of the prices that is nowhere worse than number `of`, and somewhere better.
pub(super) fn dominated_by(prices: &[Price], of: usize) -> Option<usize> {
    let own = prices[of];
    let no_worse = |p: &Price| p.psnr >= own.psnr && p.seconds <= own.seconds && p.peak <= own.peak;
    prices.iter().position(|p| *p != own && no_worse(p))
}

/// Whether a level costs nothing, by the rule of docs/tradeoffs.md: nowhere in their 95 %
/// intervals do PSNR and SSIM fall by 0.05 dB and 0.001 or depth errors grow to 1.02 of what they
/// were, and the same model looks the same to 60 dB. What has no interval is not known to be free.
pub(super) fn is_free(
    psnr: &Difference,
    ssim: &Difference,
    depth_ln_ratio: Option<&Difference>,
    numerical_psnr: Option<f64>,
) -> bool {
    let low = |d: &Difference| d.interval.map_or(f64::NEG_INFINITY, |[low, _]| low);
    let high = |d: &Difference| d.interval.map_or(f64::INFINITY, |[_, high]| high);
    low(psnr) > -0.05
        && low(ssim) > -0.001
        && depth_ln_ratio.is_none_or(|depth| high(depth) < 1.02_f64.ln())
        && numerical_psnr.is_none_or(|psnr| psnr >= 60.0)
}

/// The design of Plackett and Burman 1946 for 12 runs: whether factor `k` of run `i` is at its high
/// level. Eleven cyclic shifts of one row, and a row of low levels.
pub(super) fn plackett_burman() -> [[bool; FACTORS]; RUNS] {
    const FIRST: [bool; FACTORS] =
        [true, true, false, true, true, true, false, false, false, true, false];
    std::array::from_fn(|i| {
        std::array::from_fn(|k| i < FACTORS && FIRST[(k + FACTORS - i) % FACTORS])
    })
}

/// Mean of the responses at a factor's high level minus that at its low one, for every factor.
pub(super) fn main_effects(responses: &[f64; RUNS]) -> [f64; FACTORS] {
    let design = plackett_burman();
    std::array::from_fn(|k| {
        let signed = design.iter().zip(responses).map(|(run, y)| if run[k] { *y } else { -*y });
        signed.sum::<f64>() / (RUNS as f64 / 2.0)
    })
}

/// Standard error of an effect, from those of the columns that no knob has: nothing was varied there.
/// `None` where all are taken.
pub(super) fn error_of_effects(idle: &[f64]) -> Option<f64> {
    let squares: f64 = idle.iter().map(|effect| effect * effect).sum();
    (!idle.is_empty()).then(|| (squares / idle.len() as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn standard_errors_of_known_values() {
        // Variance 2.5 of five values: √(2.5/5).
        let error = standard_error(&[1.0, 2.0, 3.0, 4.0, 5.0]).unwrap();
        assert!((error - 0.5_f64.sqrt()).abs() < 1e-12);
        assert_eq!(standard_error(&[1.0]), None);
        assert!(stands_out(&[1.0, 2.0, 3.0, 4.0, 5.0]));
        assert!(!stands_out(&[-1.0, 2.0, -3.0, 4.0, 0.0]));
        assert!(!stands_out(&[0.0, 0.0, 0.0]) && !stands_out(&[9.0]) && !stands_out(&[]));
        assert!(stands_out(&[-0.1, -0.1]));
    }

    #[test]
    fn what_is_nowhere_better_is_dominated() {
        let price = |psnr, seconds, peak| Price { psnr, seconds, peak };
        let prices = [
            price(0.0, 1.0, 1.0),
            price(-0.1, 0.5, 1.0),
            price(-0.2, 0.6, 1.0),
            price(0.1, 2.0, 0.9),
        ];
        let by: Vec<_> = (0..4).map(|of| dominated_by(&prices, of)).collect();
        assert_eq!(by, [None, None, Some(1), None]);
        // Equals do not dominate each other.
        assert_eq!(dominated_by(&[prices[0], prices[0]], 0), None);
    }

    #[test]
    fn free_is_said_by_the_rule_only() {
        let pair = crate::study::difference::Pair { scene: "room", seed: 0, difference: 0.0 };
        let any = Difference::new(&[pair]).unwrap();
        let of = |low: f64, high: f64| Difference { interval: Some([low, high]), ..any };
        let (psnr, ssim, depth) = (of(-0.04, 0.1), of(-0.0009, 0.1), of(-0.1, 0.019));
        assert!(is_free(&psnr, &ssim, Some(&depth), Some(60.0)));
        assert!(is_free(&psnr, &ssim, None, None));
        assert!(!is_free(&of(-0.06, 0.5), &ssim, None, None));
        assert!(!is_free(&psnr, &of(-0.002, 0.0), None, None));
        assert!(!is_free(&psnr, &ssim, Some(&of(-0.1, 0.021)), None));
        assert!(!is_free(&psnr, &ssim, Some(&depth), Some(59.9)));
        let single = Difference { interval: None, ..psnr };
        assert!(!is_free(&single, &ssim, None, None));
    }

    #[test]
    fn the_design_is_balanced_and_orthogonal() {
        let design = plackett_burman();
        let sign = |on: bool| if on { 1 } else { -1 };
        for j in 0..FACTORS {
            assert_eq!(design.iter().map(|run| sign(run[j])).sum::<i32>(), 0, "column {j}");
            for k in 0..j {
                let dot: i32 = design.iter().map(|run| sign(run[j]) * sign(run[k])).sum();
                assert_eq!(dot, 0, "columns {j} and {k}");
            }
        }
        assert_eq!(design[RUNS - 1], [false; FACTORS]);
    }

    #[test]
    fn effects_that_add_up_are_found() {
        let effects: [f64; FACTORS] = std::array::from_fn(|k| k as f64 - 3.0);
        let responses = plackett_burman().map(|run| {
            30.0 + run.iter().zip(effects).map(|(on, e)| if *on { e } else { 0.0 }).sum::<f64>()
        });
        for (found, expected) in main_effects(&responses).into_iter().zip(effects) {
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }
        assert!((error_of_effects(&[3.0, -4.0]).unwrap() - 12.5_f64.sqrt()).abs() < 1e-12);
        assert_eq!(error_of_effects(&[]), None);
    }
}
