//! Tests of the rules of `mcmc`, each worked out by hand.

use super::*;
use crate::event::{Event, Outcome, assert_conforms, build};
use crate::plan::EditCounts;

fn run(event: &Event, set: &str) -> Outcome {
    event.run("mcmc", set)
}

fn event(opacity: &[f32], budget: usize) -> Event {
    Event::new(600, opacity.len(), budget).with(Signal::Opacity, opacity)
}

/// The denominator of the scale factor (equation 9), as the double sum that the paper prints.
fn denominator(share: f64, members: u32) -> f64 {
    let binomial =
        |n: u32, k: u32| (0..k).fold(1.0, |c, i| c * f64::from(n - i) / f64::from(i + 1));
    (1..=members)
        .flat_map(|i| (0..i).map(move |k| (i, k)))
        .map(|(i, k)| {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            binomial(i - 1, k) * sign * share.powi(k as i32 + 1) / f64::from(k + 1).sqrt()
        })
        .sum()
}

#[test]
fn shares_conserve_opacity() {
    for opacity in [0.01, 0.3, 0.75, 0.99] {
        for members in [2, 3, 7, 51] {
            let (share, scale) = divide_opacity(opacity, members, 1e-9);
            let together = 1.0 - (1.0 - share).powi(members as i32);
            assert!((together / opacity - 1.0).abs() < 1e-12, "{opacity} {members}: {together}");
            let expected = opacity / denominator(share, members);
            assert!((scale / expected - 1.0).abs() < 1e-9, "{opacity} {members}: {scale}");
        }
    }
}

#[test]
fn two_shares_match_values_worked_out_by_hand() {
    // o = 0.75: o′ = 0.5, 0.75/(1 − 0.25/√2) = 0.911053.
    let (half, scale) = divide_opacity(0.75, 2, 0.005);
    assert!((half - 0.5).abs() < 1e-12 && (scale - 0.911_053).abs() < 1e-6, "{half} {scale}");
    // Scale factors given beside the formula in the paper: 0.996 at opacity 0.05, 0.81 at 0.99.
    assert!((divide_opacity(0.05, 2, 0.005).1 - 0.996).abs() < 1e-3);
    assert!((divide_opacity(0.99, 2, 0.005).1 - 0.81).abs() < 5e-3);
    // Clamped from below: 1 − 0.994^½ = 0.003 becomes 0.005.
    let (clamped, scale) = divide_opacity(0.006, 2, 0.005);
    let by_hand = 0.006 / (0.01 - 0.005 * 0.005 / 2.0_f64.sqrt());
    assert!((clamped - 0.005).abs() < 1e-12 && (scale - by_hand).abs() < 1e-9);
    let (largest, scale) = divide_opacity(1.0, 2, 0.005);
    assert!(largest < 1.0 && scale.is_finite());
}

#[test]
fn the_dead_are_relocated_to_the_only_living_row() {
    let done = run(&event(&[0.005, 0.5, f32::NAN, 0.001], 4), "");
    // Three copies of row 1, in the slots of the dead.
    assert_eq!((&done.pruned, &done.split), (&vec![0, 2, 3], &vec![1]));
    let family = done.offspring()[0];
    assert_eq!((family.children, family.siblings()), (3, 4));
    assert_eq!(family.placement, Placement::Offset([0.0; 3]));
    assert_eq!(family.opacity, OpacityRule::Conserved);
    let ScaleRule::Uniform(scale) = family.scale else { panic!("{family:?}") };
    assert!((f64::from(scale) - divide_opacity(0.5, 4, 0.005).1).abs() < 1e-6);
    assert_eq!(done.ops.counts, EditCounts { removed: 3, added: 3, updated: 1, denied: 0 });
    assert_eq!((done.ops.rows_after, done.ops.cause.as_str()), (4, "relocate"));
    // A row of opacity 0.0051 is alive.
    assert_eq!(run(&event(&[0.0051, 0.5], 2), "").pruned, [0_u32; 0]);
}

#[test]
fn growth_is_five_percent_up_to_the_budget() {
    let opacity = [0.5; 100];
    let after =
        |rows: usize, budget: usize| run(&event(&opacity[..rows], budget), "").ops.rows_after;
    assert_eq!([after(100, 1000), after(100, 103), after(100, 100)], [105, 103, 100]);
    // ⌊1.05 · 39⌋ = 40, ⌊1.05 · 19⌋ = 19.
    assert_eq!([after(39, 1000), after(20, 1000), after(19, 1000)], [40, 21, 19]);
    let both = run(&event(&[0.001, 0.5], 9), "growth = 0.5");
    assert_eq!(both.ops.cause, "relocate+grow");
    assert_eq!((both.ops.rows_after, both.offspring()[0].children), (3, 2));
    assert!(!run(&event(&opacity, 200), "growth = 0.0").ops.edits_rows());
    // If the model is above the budget, dead rows are pruned without replacement.
    let over = run(&event(&[0.001, 0.5, 0.5, 0.001], 2), "");
    assert_eq!((over.pruned, over.ops.rows_after), (vec![0, 3], 2));
    // Copies are drawn only if there is room.
    assert_eq!(over.ops.counts.denied, 0);
}

#[test]
fn growth_per_event_compounds_in_short_runs() {
    let opacity = [0.5; 100];
    let after = |iterations: u32, set: &str| {
        let mut event = event(&opacity, 100_000);
        event.scene.iterations = iterations;
        // Step 200 is within the window of all these runs.
        run(&Event { step: 200, ..event }, &format!("grow_from = 0\ngrow_until = 999\n{set}"))
            .ops
            .rows_after
    };
    // An event grows the model by 5 % once in a run of 30,000 steps, twice in 15,000 (1.05² = 1.1025), and 15 times in
    // 2,000 (1.05¹⁵ = 2.0789).
    assert_eq!([after(30_000, ""), after(15_000, ""), after(2000, "")], [105, 110, 207]);
    // In longer runs the interval increases (100 becomes 200), and the growth per event stays the same.
    assert_eq!(after(60_000, ""), 105);
    // Half the interval halves the exponent: √1.21 = 1.1. Twice the interval squares the factor.
    assert_eq!(after(30_000, "growth = 0.21\ngrow_every = 50"), 110);
    assert_eq!(after(30_000, "growth = 0.21\ngrow_every = 200"), 146);
}

#[test]
fn extreme_growth_fills_the_budget_and_no_more() {
    for (growth, every, iterations) in [(0.05, u32::MAX, 30_000), (1.0, u32::MAX, 1), (1.0, 100, 0)]
    {
        let factor = growth_factor(growth, every, iterations);
        assert_eq!(grown_rows(3, factor).min(1000), 1000, "{growth} {every} {iterations}");
    }
    for (growth, every) in [(0.0, u32::MAX), (0.5, 0)] {
        assert_eq!(grown_rows(3, growth_factor(growth, every, 1)), 3);
    }
    // With the published interval and run length, the growth is exactly the published one.
    for growth in [0.0, 0.05, 0.1, 1.0] {
        assert_eq!(growth_factor(growth, 100, 30_000).to_bits(), (1.0 + growth).to_bits());
    }
}

#[test]
fn runs_of_2_000_steps_fill_their_budget() {
    let scene = SceneInfo { iterations: 2000, ..Event::new(1, 1, 1).scene };
    let mut policy = build("mcmc", "", &scene);
    // From 100 rows, 2.0789-fold at each event: 207, 430, 893, 1856, 3858, 8020, then the budget.
    let (mut rows, mut sizes) = (100, Vec::new());
    for step in (1..=2000).filter(|&step| build("mcmc", "", &scene).is_due(step)) {
        let event = Event { step, ..event(&vec![0.5; rows], 10_000) };
        rows = event.run_policy(&mut *policy).unwrap().ops.rows_after;
        sizes.push(rows);
    }
    assert_eq!(sizes.len(), 16);
    assert_eq!(sizes[..8], [207, 430, 893, 1856, 3858, 8020, 10_000, 10_000]);
}

#[test]
fn every_parameter_has_its_published_rate() {
    let scene = Event::new(1, 1, 1).scene;
    let rates = build("mcmc", "", &scene).needs(&scene).rates;
    let start_end = |rate: Option<Rate>| rate.map(|rate| (rate.start, rate.end));
    assert_eq!(start_end(rates.mean), Some((0.000_16, 0.000_001_6)));
    assert_eq!(start_end(rates.log_scale), Some((0.005, 0.005)));
    assert_eq!(start_end(rates.quat), Some((0.001, 0.001)));
    assert_eq!(start_end(rates.opacity), Some((0.05, 0.05)));
    assert_eq!(start_end(rates.sh_dc), Some((0.0025, 0.0025)));
    assert_eq!(start_end(rates.sh_rest), Some((0.000_125, 0.000_125)));
    assert_eq!(rates.fade, None);
}

#[test]
fn opaque_rows_are_drawn_more_often() {
    let opacity: Vec<f32> = (0..2000).map(|row| if row % 2 == 0 { 0.1 } else { 0.4 }).collect();
    let done = run(&event(&opacity, 4000), "growth = 1.0");
    let (mut faint, mut strong) = (0, 0);
    for family in &done.ops.families {
        let copies = if family.parent % 2 == 0 { &mut faint } else { &mut strong };
        *copies += done.ops.offspring(family).children;
    }
    assert_eq!(faint + strong, 2000);
    // 400 of the 2000 copies, within five standard deviations (18 each).
    assert!((310..490).contains(&faint), "{faint}");
}

#[test]
fn the_number_of_copies_is_capped_within_the_formulas_only() {
    let mut opacity = [0.001; 80];
    opacity[7] = 0.5;
    let family = run(&event(&opacity, 80), "").offspring()[0];
    assert_eq!(family.children, 79);
    let (share, scale) = divide_opacity(0.5, 51, 0.005);
    assert_eq!(family.opacity, OpacityRule::Set(share as f32));
    assert_eq!(family.scale, ScaleRule::Uniform(scale as f32));
}

#[test]
fn nothing_happens_if_no_row_is_alive() {
    for opacity in [&[0.001, 0.002][..], &[f32::NAN], &[]] {
        assert!(run(&event(opacity, 9), "").ops.is_empty());
    }
}

#[test]
fn terms_and_noise_are_scaled_by_the_camera_radius() {
    let scene = Event::new(1, 1, 1).scene;
    let close = |a: f32, b: f32| (a / b - 1.0).abs() < 1e-5;
    for extent in [1.1, 11.0] {
        let scene = SceneInfo { extent, ..scene.clone() };
        let needs = build("mcmc", "", &scene).needs(&scene);
        let radius = extent / 1.1;
        assert_eq!(needs.check(), Ok(()));
        assert!(close(needs.loss_terms.opacity, 0.01));
        assert!(close(needs.loss_terms.scale * radius, 0.01));
        let noise = needs.noise.unwrap();
        assert!(close(noise.strength * radius * radius, 5e5));
        assert!(close(noise.sharpness, 100.0) && close(noise.opacity, 0.005));
        assert_eq!(needs.start, StartRule { opacity: Some(0.5), scale: 0.1 });
        assert_eq!(needs.signals, SignalSet::from([Signal::Opacity]));
    }
    let off = build("mcmc", "noise = 0\nopacity_term = 0\nscale_term = 0", &scene).needs(&scene);
    assert!(off.noise.is_none() && off.loss_terms.is_none());
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms("mcmc", &["growth = 1.0\nnoise = 0.0", "min_opacity = 0.5\nmost_shares = 2"]);
}
