//! What is learned from the runs, as pure functions of numbers: which levels others dominate, and which are
//! free.

use crate::study::difference::Difference;

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
/// were. What has no interval is not known to be free.
pub(super) fn is_free(
    psnr: &Difference,
    ssim: &Difference,
    depth_ln_ratio: Option<&Difference>,
) -> bool {
    let low = |d: &Difference| d.interval.map_or(f64::NEG_INFINITY, |[low, _]| low);
    let high = |d: &Difference| d.interval.map_or(f64::INFINITY, |[_, high]| high);
    low(psnr) > -0.05
        && low(ssim) > -0.001
        && depth_ln_ratio.is_none_or(|depth| high(depth) < 1.02_f64.ln())
}

#[cfg(test)]
mod tests {
    use super::*;

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
        assert!(is_free(&psnr, &ssim, Some(&depth)));
        assert!(is_free(&psnr, &ssim, None));
        assert!(!is_free(&of(-0.06, 0.5), &ssim, None));
        assert!(!is_free(&psnr, &of(-0.002, 0.0), None));
        assert!(!is_free(&psnr, &ssim, Some(&of(-0.1, 0.021))));
        let single = Difference { interval: None, ..psnr };
        assert!(!is_free(&single, &ssim, None));
    }
}
