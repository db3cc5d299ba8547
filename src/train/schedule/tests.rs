//! Tests of step sizes, degrees, view orders and backgrounds.

use densify_policies::policy::{Fade, PixelLoss, Rate};

use super::*;

#[test]
fn short_runs_have_larger_step_sizes() {
    let published = RateOptions::default();
    for pixel_loss in [PixelLoss::L1, PixelLoss::Huber] {
        assert_eq!(RateOptions::for_run(30_000, pixel_loss), published);
        assert_eq!(RateOptions::for_run(100_000, pixel_loss), published);
    }
    let short = RateOptions::for_run(3_000, PixelLoss::Huber);
    let close = |a: f32, b: f32| assert!((a / b - 1.0).abs() < 1e-5, "{a} against {b}");
    let (start, end) = (short.at(0, 3_000, 1.0), short.at(3_000, 3_000, 1.0));
    let factor = 10_f32.powf(0.6);
    close(start.mean, 1.6e-4 * factor);
    close(start.opacity, published.opacity * factor);
    close(short.at(1_500, 3_000, 1.0).quat, published.quat * factor.sqrt());
    close(end.mean, 1.6e-6 * 10_f32.powf(0.77));
    close(start.noise, 1.6e-4);
    close(end.noise, 1.6e-6);
    close(start.log_scale, 2.0 * published.log_scale * factor);
    close(end.log_scale, 2.0 * published.log_scale);
    close(start.sh_rest, 2.0 * published.sh_rest * factor);
    close(end.sh_rest, 2.0 * published.sh_rest);
    // A slightly shorter run has slightly larger step sizes.
    let factor = 1.25_f32.powf(0.6);
    let slightly_shorter = RateOptions::for_run(24_000, PixelLoss::Huber);
    close(slightly_shorter.sh_rest, published.sh_rest * factor);
    let shortest = RateOptions::for_run(1, PixelLoss::Huber);
    close(shortest.boost as f32, 5.0);
    close(shortest.mean_end as f32, 1.6e-5);
    // With L1, means and log-scales end with the published step sizes.
    let (boost, sh_rest) = (short.boost, short.sh_rest);
    assert_eq!(
        RateOptions::for_run(3_000, PixelLoss::L1),
        RateOptions { boost, sh_rest, ..published }
    );
}

#[test]
fn mean_rate_falls_log_linearly_between_its_ends() {
    let rates = RateOptions::default();
    let mean = |step| f64::from(rates.at(step, 1_000, 2.0).mean);
    let close = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 1e-6, "{a} against {b}");
    close(mean(0), 3.2e-4);
    close(mean(500), 3.2e-5);
    close(mean(1_000), 3.2e-6);
    close(mean(1_500), 3.2e-6);
    close(mean(250) * mean(750), mean(500) * mean(500));
    close(f64::from(rates.at(7, 1_000, 2.0).sh_rest), 1.25e-4);
}

#[test]
fn a_rate_of_0_freezes_its_values_for_the_whole_run() {
    let rates = RateOptions {
        mean_start: 0.0,
        opacity: 0.0,
        opacity_end: Some(0.1),
        ..RateOptions::default()
    };
    assert_eq!(rates.problem(), None);
    for step in [1, 500, 1_000] {
        let LearningRates { mean, opacity, quat, .. } = rates.at(step, 1_000, 2.0);
        assert!(mean == 0.0 && opacity == 0.0 && quat > 0.0, "{mean}, {opacity}, {quat}");
    }
    let named = |rates: RateOptions| rates.problem().expect("a problem");
    assert!(named(RateOptions { mean_end: 0.0, ..rates }).contains("mean_end"));
    assert!(named(RateOptions { quat: -1.0, ..rates }).contains("quat"));
}

#[test]
fn steps_scale_with_the_run() {
    assert_eq!(scaled(1_000, 30_000), 1_000);
    assert_eq!(scaled(1_000, 3_000), 100);
    assert_eq!(scaled(1_000, 100), 3);
    assert_eq!(scaled(1_000, 1), 1);
    assert_eq!(scaled(u32::MAX, u32::MAX), u32::MAX);
}

#[test]
fn the_degree_rises_every_1000_steps_in_a_run_of_30000() {
    let at = |step| sh_degree(step, 30_000, 3);
    assert_eq!([1, 999, 1_000, 1_999, 2_000, 3_000, 30_000].map(at), [0, 0, 1, 1, 2, 3, 3]);
    assert_eq!(sh_degree(300, 3_000, 3), 3);
    assert_eq!(sh_degree(300, 3_000, 1), 1);
    assert_eq!(sh_degree(u32::MAX, 1, 9), MAX_SH_DEGREE);
}

#[test]
fn each_epoch_has_its_own_permutation() {
    for views in [0, 1, 2, 7, 100] {
        let mut order = view_order(views, 5, 3);
        order.sort_unstable();
        assert_eq!(order, (0..views).collect::<Vec<_>>());
    }
    assert_eq!(view_order(50, 5, 3), view_order(50, 5, 3));
    assert_ne!(view_order(50, 5, 3), view_order(50, 5, 4));
    assert_ne!(view_order(50, 5, 3), view_order(50, 6, 3));
    assert_ne!(view_order(50, 5, 3), view_order(50, 5 | 1 << 40, 3));
}

#[test]
fn every_view_is_first_equally_often() {
    let mut first = [0_u32; 5];
    for epoch in 0..5_000 {
        first[view_order(5, 1, epoch)[0]] += 1;
    }
    // Binomial(5,000, 1/5): mean 1,000, standard deviation 28; the bound is five standard deviations.
    assert!(first.iter().all(|n| n.abs_diff(1_000) < 142), "{first:?}");
}

#[test]
fn fresh_views_are_sampled_uniformly() {
    let mut times = [0_u32; 7];
    for step in 0..7_000 {
        let mut chosen = fresh_views(7, 3, 5, step);
        assert_eq!(chosen, fresh_views(7, 3, 5, step));
        chosen.sort_unstable();
        chosen.dedup();
        assert_eq!(chosen.len(), 3, "a view was drawn twice");
        for view in chosen {
            times[view] += 1;
        }
    }
    // Binomial(7,000, 3/7): mean 3,000, standard deviation 41; the bound is five standard deviations.
    assert!(times.iter().all(|n| n.abs_diff(3_000) < 207), "{times:?}");
    assert_ne!(fresh_views(50, 10, 5, 3), fresh_views(50, 10, 6, 3));
    assert_ne!(fresh_views(50, 50, 5, 0), view_order(50, 5, 0));
    let mut all = fresh_views(4, 100, 5, 3);
    all.sort_unstable();
    assert_eq!(all, [0, 1, 2, 3]);
    assert!(fresh_views(4, 0, 5, 3).is_empty() && fresh_views(0, 4, 5, 3).is_empty());
}

#[test]
fn backgrounds_are_read_from_text() {
    for text in ["black", "white", "random", "#0a0b0c", "#ffffff"] {
        assert_eq!(text.parse::<Background>().unwrap().to_string(), text);
    }
    assert_eq!("#0A0b0c".parse(), Ok(Background::Colour([10, 11, 12])));
    for text in ["", "#", "#fff", "#+a0b0c", "#0a0b0g", "#0a0b0c0d", "0a0b0c", "grey", "#äöü"] {
        let message = text.parse::<Background>().unwrap_err();
        assert!(message.contains("#808080"), "{message}");
    }
}

#[test]
fn backgrounds_have_the_expected_colours() {
    let same = |a: [f32; 3], b: [f32; 3]| a.map(f32::to_bits) == b.map(f32::to_bits);
    assert!(same(Background::White.at(1, 2), [1.0; 3]));
    assert!(same(Background::Black.at(1, 2), [0.0; 3]));
    assert!(same(Background::Colour([0, 255, 51]).at(1, 2), [0.0, 1.0, 0.2]));
    assert!(same(Background::Random.fixed(), [0.0; 3]));
    let random = Background::Random.at(1, 2);
    assert!(same(random, Background::Random.at(1, 2)));
    assert!(!same(random, Background::Random.at(1, 3)));
    assert!(!same(random, Background::Random.at(2, 2)));
    let mean =
        (0..3_000).map(|step| f64::from(Background::Random.at(9, step)[1])).sum::<f64>() / 3_000.0;
    // The standard deviation of the mean is 0.29 / √3,000 = 0.005; the bound is five standard deviations.
    assert!((mean - 0.5).abs() < 0.025, "{mean}");
}

#[test]
fn final_rates_and_the_fade_are_applied() {
    let overrides = RateOverrides {
        mean: Some(Rate { start: 1e-4, end: 1e-6 }),
        log_scale: Some(Rate { start: 0.04, end: 0.01 }),
        opacity: Some(Rate::constant(0.05)),
        sh_dc: Some(Rate { start: 4e-3, end: 1e-3 }),
        fade: Some(Fade { from: 0.5, to: 0.25 }),
        ..RateOverrides::default()
    };
    let rates = RateOptions::default().with(&overrides);
    let at = |step| rates.at(step, 1_000, 2.0);
    let near = |found: f32, expected: f64| {
        assert!((f64::from(found) / expected - 1.0).abs() < 1e-6, "{found} against {expected}");
    };
    // Halfway, the step size is the geometric mean.
    near(at(500).mean, 2e-5);
    near(at(500).log_scale, 0.02);
    near(at(1_000).log_scale, 0.01);
    near(at(500).quat, 1e-3);
    near(at(1_000).quat, 1e-3);
    // The fade is 1 up to the middle, and 0.25^½ at three quarters.
    for (step, factor) in [(0, 1.0), (500, 1.0), (750, 0.5), (1_000, 0.25), (9_000, 0.25)] {
        near(at(step).opacity, 0.05 * factor);
        near(at(step).sh_rest, 1.25e-4 * factor);
    }
    near(at(1_000).sh_dc, 1e-3 * 0.25);
    // Noise is not boosted.
    let short = RateOptions { boost: 4.0, ..rates }.at(500, 1_000, 2.0);
    near(short.mean, 4e-5);
    near(short.noise, 2e-5);
}

#[test]
fn fine_step_sizes_are_the_final_ones_throughout() {
    let with_ends = RateOptions {
        log_scale_end: Some(1e-3),
        quat_end: Some(2e-4),
        opacity_end: Some(3e-3),
        sh_dc_end: Some(4e-4),
        sh_rest_end: Some(5e-5),
        ..RateOptions::for_run(2_000, PixelLoss::L1)
    };
    for rates in [RateOptions::for_run(2_000, PixelLoss::L1), with_ends] {
        let end = rates.at(2_000, 2_000, 3.0);
        for step in [1, 700, 2_000] {
            let fine = rates.fine().at(step, 2_000, 3.0);
            for (found, expected) in [
                (fine.mean, end.mean),
                (fine.log_scale, end.log_scale),
                (fine.quat, end.quat),
                (fine.opacity, end.opacity),
                (fine.sh_dc, end.sh_dc),
                (fine.sh_rest, end.sh_rest),
            ] {
                assert!(
                    (found - expected).abs() <= 1e-6 * expected,
                    "step {step}: {found} {expected}"
                );
            }
        }
    }
}
