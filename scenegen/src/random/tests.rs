//! Chi-square tests of the samplers against their distributions.

use super::*;

/// The value that chi-square of `bins` bins exceeds once in a million (Wilson and Hilferty).
fn limit(bins: usize) -> f64 {
    let k = bins as f64 - 1.0;
    let spread = 2.0 / (9.0 * k);
    k * (1.0 - spread + 4.75 * spread.sqrt()).powi(3)
}

/// Tests counts against probabilities; bins with an expectation below 10 are merged.
fn check_distribution(counts: &[u64], probabilities: &[f64]) -> Result<(), String> {
    let total: u64 = counts.iter().sum();
    let (mut chi, mut bins) = (0.0, 0);
    let (mut merged, mut merged_expected) = (0.0, 0.0);
    let sum: f64 = probabilities.iter().sum();
    if (sum - 1.0).abs() > 5e-3 {
        return Err(format!("the density integrates to {sum}"));
    }
    for (&count, &probability) in counts.iter().zip(probabilities) {
        let expected = total as f64 * probability / sum;
        merged += count as f64;
        merged_expected += expected;
        if merged_expected >= 10.0 {
            chi += (merged - merged_expected) * (merged - merged_expected) / merged_expected;
            bins += 1;
            (merged, merged_expected) = (0.0, 0.0);
        }
    }
    let limit = limit(bins);
    if chi < limit {
        Ok(())
    } else {
        Err(format!("chi-square {chi} of {bins} bins, limit {limit}"))
    }
}

const DRAWS: usize = 400_000;
const HEIGHTS: usize = 20;
const TURNS: usize = 24;

/// Bins directions of the upper hemisphere by height and turn, and tests the counts against a density.
fn check_directions(
    name: &str,
    mut draw: impl FnMut(&mut Draws) -> Vec3,
    density: impl Fn(Vec3) -> f64,
) {
    let mut counts = vec![0_u64; HEIGHTS * TURNS];
    let mut draws = Draws::new(1, &[7]);
    for _ in 0..DRAWS {
        let d = draw(&mut draws);
        assert!(d.is_finite() && (d.length() - 1.0).abs() < 1e-4 && d.z >= 0.0, "{name}: {d}");
        let height = ((d.z * HEIGHTS as f32) as usize).min(HEIGHTS - 1);
        let turn = (d.y.atan2(d.x) / TAU).rem_euclid(1.0);
        counts[height * TURNS + ((turn * TURNS as f32) as usize).min(TURNS - 1)] += 1;
    }
    const FINE: usize = 24;
    let mut probabilities = vec![0.0; counts.len()];
    for height in 0..HEIGHTS * FINE {
        for turn in 0..TURNS * FINE {
            let z = (height as f64 + 0.5) / (HEIGHTS * FINE) as f64;
            let angle = std::f64::consts::TAU * (turn as f64 + 0.5) / (TURNS * FINE) as f64;
            let flat = (1.0 - z * z).sqrt();
            let d = Vec3::new((flat * angle.cos()) as f32, (flat * angle.sin()) as f32, z as f32);
            let solid_angle = std::f64::consts::TAU / ((HEIGHTS * FINE) * (TURNS * FINE)) as f64;
            probabilities[height / FINE * TURNS + turn / FINE] += density(d) * solid_angle;
        }
    }
    check_distribution(&counts, &probabilities).unwrap_or_else(|e| panic!("{name}: {e}"));
}

#[test]
fn cosine_directions_follow_their_density() {
    check_directions(
        "cosine",
        |draws| cosine_hemisphere(draws.square()),
        |d| f64::from(d.z) / std::f64::consts::PI,
    );
}

#[test]
fn visible_normals_follow_their_density() {
    for alpha in [0.15_f32, 0.4, 1.0] {
        for view in [Vec3::Z, Vec3::new(0.6, 0.0, 0.8), Vec3::new(-0.5, 0.8, 0.12)] {
            let view = view.normalize();
            // G1 · max(0, v·h) · D(h) / v.z (Heitz 2018, equation 1).
            let tan2 = f64::from(1.0 / (view.z * view.z) - 1.0);
            let lambda = 0.5 * ((1.0 + f64::from(alpha * alpha) * tan2).sqrt() - 1.0);
            let g1 = 1.0 / (1.0 + lambda);
            check_directions(
                &format!("visible normals at alpha {alpha}, view {view}"),
                |draws| ggx_visible_normal(view, alpha, draws.square()),
                |h| {
                    let seen = f64::from(view.dot(h).max(0.0) / view.z);
                    g1 * seen * f64::from(ggx_distribution(h.z, alpha))
                },
            );
        }
    }
}

#[test]
fn units_are_uniform_and_streams_are_independent() {
    let mut counts = vec![0_u64; 256];
    let mut pairs = vec![0_u64; 256];
    for stream in 0..400_u64 {
        let mut draws = Draws::new(5, &[stream, 3]);
        for _ in 0..1000 {
            let (a, b) = (draws.unit(), draws.unit64());
            assert!((0.0..1.0).contains(&a) && (0.0..1.0).contains(&b));
            counts[(a * 256.0) as usize] += 1;
            pairs[(a * 16.0) as usize * 16 + (b * 16.0) as usize] += 1;
        }
    }
    let even = vec![1.0 / 256.0; 256];
    check_distribution(&counts, &even).expect("units");
    check_distribution(&pairs, &even).expect("pairs");
    // The first draws of neighbouring streams are independent.
    let mut firsts = vec![0_u64; 256];
    for view in 0..300 {
        for pixel in 0..300 {
            firsts[(Draws::new(0, &[view, pixel]).unit() * 256.0) as usize] += 1;
        }
    }
    check_distribution(&firsts, &even).expect("streams");
}

#[test]
fn strata_are_filled_evenly_and_jitter_stays_within_them() {
    let mut draws = Draws::new(2, &[]);
    let mut counts = vec![0_u64; 64];
    for _ in 0..2000 {
        for i in 0..16 {
            let at = stratum(i, 4, draws.square());
            let cell = (at * 4.0).floor();
            assert_eq!(cell.x as u32 + 4 * cell.y as u32, i);
            let within = ((at * 4.0 - cell) * 8.0).floor();
            counts[within.x as usize + 8 * within.y as usize] += 1;
        }
    }
    check_distribution(&counts, &[1.0 / 64.0; 64]).expect("jitter");
}

#[test]
fn normal_draws_follow_the_normal_distribution() {
    let mut draws = Draws::new(9, &[]);
    let mut counts = vec![0_u64; 40];
    for _ in 0..DRAWS {
        let bin = (draws.normal() * 5.0 + 20.0).clamp(0.0, 39.0);
        counts[bin as usize] += 1;
    }
    let density = |x: f64| (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
    let mass = |bin: usize| {
        let width = 0.2 / 50.0;
        (0..50)
            .map(|i| density((bin as f64 - 20.0) / 5.0 + (f64::from(i) + 0.5) * width) * width)
            .sum()
    };
    let probabilities: Vec<f64> = (0..40).map(mass).collect();
    check_distribution(&counts, &probabilities).expect("normal");
}

#[test]
fn wrong_distributions_are_rejected() {
    let uneven: Vec<u64> = (0..100).map(|i| 1000 + 5 * i).collect();
    assert!(check_distribution(&uneven, &[0.01; 100]).is_err());
    let even = vec![1000; 100];
    assert!(check_distribution(&even, &[0.01; 100]).is_ok());
    assert!(check_distribution(&even, &[0.02; 100]).is_err());
}

#[test]
fn frames_are_orthonormal() {
    let mut draws = Draws::new(4, &[]);
    for _ in 0..1000 {
        let n = Vec3::new(draws.unit() - 0.5, draws.unit() - 0.5, draws.unit() - 0.5).normalize();
        for n in [n, Vec3::Z, Vec3::NEG_Z] {
            let (x, y) = frame(n);
            assert!((x.cross(y) - n).length() < 1e-5 && x.dot(y).abs() < 1e-6, "{n}");
        }
    }
}
