//! Random numbers without state: every draw is a hash of (seed, step, row, purpose, counter).
//!
//! The same five numbers give the same bits on every backend, in any order and at any thread
//! count. The hash is pcg4d (Jarzynski and Olano, *Hash Functions for GPU Rendering*, JCGT 9(3),
//! 2020): 32-bit operations only, so that a shader can compute it too.

/// The purpose of a draw; draws for different purposes are independent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Purpose {
    /// Choosing rows.
    Select = 1,
    /// Placing children.
    Place = 2,
    /// Noise on parameters.
    Noise = 3,
    /// Sampling rows with replacement; the index of the sample takes the place of the row.
    Draw = 4,
    /// Stochastic rounding of numbers stored in fewer bits.
    Round = 5,
    /// Numbers that a policy written in Python draws for its own ends; the counter is the number of the call in the
    /// event.
    Own = 6,
}

/// The random draws at one event of a policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PolicyRng {
    seed: u32,
    step: u32,
}

impl PolicyRng {
    /// The draws of iteration `step` in a run with this seed.
    pub fn new(seed: u64, step: u32) -> Self {
        // Folding keeps both halves of a 64-bit seed significant.
        Self { seed: (seed ^ (seed >> 32).wrapping_mul(0x9e37_79b9)) as u32, step }
    }

    /// Four independent 32-bit words for (row, purpose, counter), with `counter` < 65,536.
    #[inline]
    pub fn bits(&self, row: u32, purpose: Purpose, counter: u32) -> [u32; 4] {
        pcg4d([row, self.step, self.seed, (purpose as u32) << 16 ^ counter])
    }

    /// A number in (0, 1): (k + ½) / 2²³ with a random k of 23 bits.
    pub fn uniform(&self, row: u32, purpose: Purpose) -> f32 {
        self.uniform_at(row, purpose, 0)
    }

    /// As [`uniform`](Self::uniform), with another number for each counter.
    pub fn uniform_at(&self, row: u32, purpose: Purpose, counter: u32) -> f32 {
        unit_open(self.bits(row, purpose, counter)[0])
    }

    /// A number in (0, 1) with 52 bits: among millions of rows, numbers of 23 bits often repeat.
    pub fn uniform_f64(&self, row: u32, purpose: Purpose) -> f64 {
        let [high, low, ..] = self.bits(row, purpose, 0);
        let bits = (u64::from(high) << 32 | u64::from(low)) >> 12;
        (bits as f64 + 0.5) / (1_u64 << 52) as f64
    }

    /// Three independent standard normals, by Box–Muller.
    pub fn normal3(&self, row: u32, purpose: Purpose, counter: u32) -> [f32; 3] {
        let u = self.bits(row, purpose, counter).map(unit_open);
        let polar = |radius: f32, angle: f32| {
            let r = (-2.0 * radius.ln()).sqrt();
            let (sin, cos) = (std::f32::consts::TAU * angle).sin_cos();
            [r * cos, r * sin]
        };
        let [a, b] = polar(u[0], u[1]);
        let [c, _] = polar(u[2], u[3]);
        [a, b, c]
    }
}

/// The top 23 bits as a number strictly between 0 and 1. With 24 bits, k + ½ would need a 25-bit
/// mantissa, and the largest number would round to 1.
fn unit_open(bits: u32) -> f32 {
    ((bits >> 9) as f32 + 0.5) * (1.0 / 8_388_608.0)
}

#[inline]
fn pcg4d(v: [u32; 4]) -> [u32; 4] {
    let [mut x, mut y, mut z, mut w] =
        v.map(|k| k.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    for shift_after in [true, false] {
        x = x.wrapping_add(y.wrapping_mul(w));
        y = y.wrapping_add(z.wrapping_mul(x));
        z = z.wrapping_add(x.wrapping_mul(y));
        w = w.wrapping_add(y.wrapping_mul(z));
        if shift_after {
            [x, y, z, w] = [x, y, z, w].map(|k| k ^ (k >> 16));
        }
    }
    [x, y, z, w]
}

#[cfg(test)]
mod tests {
    use super::*;

    const PURPOSES: [Purpose; 6] = [
        Purpose::Select,
        Purpose::Place,
        Purpose::Noise,
        Purpose::Draw,
        Purpose::Round,
        Purpose::Own,
    ];
    const DRAWS: u32 = 1 << 16;

    /// χ² of counts that should all be equal, in standard deviations from its mean.
    fn deviation(counts: &[u32]) -> f64 {
        let expected = f64::from(counts.iter().sum::<u32>()) / counts.len() as f64;
        let chi2: f64 = counts.iter().map(|&n| (f64::from(n) - expected).powi(2) / expected).sum();
        let freedom = (counts.len() - 1) as f64;
        (chi2 - freedom) / (2.0 * freedom).sqrt()
    }

    /// The deviation of pairs of numbers in (0, 1) from a uniform distribution over the unit square.
    fn joint_deviation(pair: impl Fn(u32) -> (f32, f32)) -> f64 {
        let mut counts = [0; 256];
        for draw in 0..DRAWS {
            let (a, b) = pair(draw);
            counts[(a * 16.0) as usize * 16 + (b * 16.0) as usize] += 1;
        }
        deviation(&counts)
    }

    #[test]
    fn bits_are_those_of_pcg4d() {
        // From an independent transcription of the paper's listing.
        let expected = [0x3622_cd16, 0xf114_71d8, 0xe110_9b3f, 0x02b9_4c2f];
        assert_eq!(pcg4d([1, 2, 3, 4]), expected);
        let rng = PolicyRng::new(42, 600);
        let expected = [0xacb5_591e, 0x199d_5110, 0x2221_19f4, 0x7972_97a9];
        assert_eq!(rng.bits(7, Purpose::Place, 1), expected);
    }

    #[test]
    fn unit_numbers_exclude_both_ends() {
        assert!(unit_open(0) > 0.0);
        assert!(unit_open(u32::MAX) < 1.0);
        let normal = PolicyRng::new(0, 0).normal3(0, Purpose::Noise, 0);
        assert!(normal.iter().all(|v| v.is_finite()));
    }

    #[test]
    fn draws_are_uniform() {
        for seed in [0, 1, u64::MAX] {
            for purpose in PURPOSES {
                let rng = PolicyRng::new(seed, 600);
                let mut counts = [[0; 256]; 2];
                for row in 0..DRAWS {
                    counts[0][(rng.uniform(row, purpose) * 256.0) as usize] += 1;
                    counts[1][(rng.uniform_f64(row, purpose) * 256.0) as usize] += 1;
                }
                for counts in counts {
                    let deviation = deviation(&counts);
                    assert!(deviation.abs() < 5.0, "{seed} {purpose:?}: {deviation}");
                }
            }
        }
    }

    #[test]
    fn draws_are_independent() {
        let rng = PolicyRng::new(9, 600);
        let u = |rng: PolicyRng, row: u32, purpose| rng.uniform(row, purpose);
        let select = Purpose::Select;
        type Pair<'a> = (&'a str, &'a dyn Fn(u32) -> (f32, f32));
        let versus =
            |seed, step| move |i| (u(rng, i, select), u(PolicyRng::new(seed, step), i, select));
        let pairs: [Pair<'_>; 8] = [
            ("rows", &|i| (u(rng, 2 * i, select), u(rng, 2 * i + 1, select))),
            ("steps", &versus(9, 601)),
            ("step by step", &|i| {
                let at = |step| u(PolicyRng::new(9, step), 5, select);
                (at(2 * i), at(2 * i + 1))
            }),
            ("seeds", &versus(10, 600)),
            ("high halves of seeds", &versus(9 + (1 << 32), 600)),
            ("purposes", &|i| (u(rng, i, select), u(rng, i, Purpose::Place))),
            ("purposes", &|i| (u(rng, i, Purpose::Noise), u(rng, i, Purpose::Place))),
            ("counters", &|i| {
                let at = |counter| unit_open(rng.bits(i, select, counter)[0]);
                (at(0), at(1))
            }),
        ];
        let deviations = pairs.map(|(name, pair)| (name, joint_deviation(pair)));
        let bad: Vec<_> = deviations.iter().filter(|(_, d)| d.abs() > 5.0).collect();
        assert!(bad.is_empty(), "{bad:?}");
    }

    #[test]
    fn normals_have_the_moments_of_a_normal() {
        let rng = PolicyRng::new(3, 700);
        let draws: Vec<[f32; 3]> = (0..DRAWS).map(|i| rng.normal3(i, Purpose::Place, 1)).collect();
        let n = f64::from(DRAWS);
        let mean = |f: &dyn Fn(&[f64; 3]) -> f64| {
            draws.iter().map(|d| f(&d.map(f64::from))).sum::<f64>() / n
        };
        for axis in 0..3 {
            // Five standard errors of each moment of n standard normals.
            let moments = [(1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)];
            for (power, expected, variance) in moments {
                let moment = mean(&|d| d[axis].powi(power));
                let bound = 5.0 * f64::sqrt(variance / n);
                assert!((moment - expected).abs() < bound, "axis {axis}, moment {power}: {moment}");
            }
            let covariance = mean(&|d| d[axis] * d[(axis + 1) % 3]);
            assert!(covariance.abs() < 5.0 / n.sqrt(), "axis {axis}: {covariance}");
        }
    }
}
