//! Tests of the rules of `reduced-3dgs`, each worked out by hand.

use super::*;
use crate::event::{Event, Outcome, assert_conforms, assert_grows_like_vanilla, build, due_steps};
use crate::parameters::REFERENCE_ITERATIONS;
use crate::registry::find;

fn run(event: &Event, set: &str) -> Outcome {
    event.run("reduced-3dgs", set)
}

/// Rows of opacity 0.5: balls with half-axes of 1 at these x, with spheres of radius 0.5. The growth rules
/// neither densify nor prune them.
fn event(step: u32, xs: &[f32]) -> Event {
    let means: Vec<f32> = xs.iter().flat_map(|&x| [x, 0.0, 0.0]).collect();
    let upright = [1.0, 0.0, 0.0, 0.0].repeat(xs.len());
    Event::small_rows(step, xs.len(), xs.len())
        .with(Signal::Position, &means)
        .with(Signal::Orientation, &upright)
        .with_all(Signal::LogScale, (1.0_f32 / 3.0).ln())
        .with_all(Signal::PixelSizeMin, 0.577_35)
}

/// Twenty isolated rows, then six at one place.
fn crowd(step: u32) -> Event {
    let alone = (0..20).map(|row| 10.0 * row as f32);
    event(step, &alone.chain([-50.0; 6]).collect::<Vec<f32>>())
}

/// Opacities of the six rows at one place, and 0.5 for the others.
fn opacities(crowd: [f32; 6]) -> Vec<f32> {
    [0.5; 20].into_iter().chain(crowd).collect()
}

#[test]
fn the_fainter_half_of_the_redundant_rows_is_pruned() {
    // R is 1 for twenty rows and 6 for six: mean 56/26 = 2.154, standard deviation √(25·20·6/26/25) = 2.148.
    // The six are above 4.302. Their median opacity is (0.3 + 0.4)/2 = 0.35.
    let event = crowd(1000).with(Signal::Opacity, &opacities([0.1, 0.2, 0.3, 0.4, 0.6, 0.9]));
    let pruned = |set: &str| run(&event, &format!("faint_opacity = 0.0\n{set}")).pruned;
    assert_eq!(pruned(""), [20, 21, 22]);
    // 2.154 + 1.79·2.148 = 5.999; with 1.80 the sum is 6.02.
    assert_eq!(pruned("deviations = 1.79"), [20, 21, 22]);
    assert!(pruned("deviations = 1.8").is_empty());
    // R must exceed `min_redundancy`.
    assert_eq!(pruned("min_redundancy = 5.9"), [20, 21, 22]);
    assert!(pruned("min_redundancy = 6.0").is_empty());
    // With two neighbours R is 3, which does not exceed the default `min_redundancy` of 3.
    assert!(pruned("neighbours = 2").is_empty());
    assert_eq!(pruned("neighbours = 3"), [20, 21, 22]);
    let done = run(&event, "");
    assert_eq!(done.ops.cause, "densify+prune");
    assert!(done.ops.reset_signals.contains(Signal::PixelSizeMin));
    // With the default `min_redundancy`, an R of 3 is not enough and 4 is.
    let pruned_at = |xs: &[f32]| {
        let opacity: Vec<f32> = (0..xs.len()).map(|row| 0.1 + 0.1 * row as f32).collect();
        let event = self::event(1000, xs).with(Signal::Opacity, &opacity);
        run(&event, "faint_opacity = 0.0\ndeviations = 0.0").pruned
    };
    assert!(pruned_at(&[0.0, 0.0, 0.0, 9.0]).is_empty());
    assert_eq!(pruned_at(&[0.0, 0.0, 0.0, 0.0, 9.0]), [0, 1]);
}

#[test]
fn the_smallest_pixel_determines_the_size_of_a_sphere() {
    // Balls 1.45 apart: the next surface is 0.45 away from each mean. √3/2 · 0.577 = 0.5 reaches it;
    // √3/2 · 0.51 = 0.44 does not. With half-axes of 2.6/3 the next surface is farther away.
    let shifted = event(1000, &[0.0, 1.45, 2.9, -1.45, -2.9, 40.0]);
    let redundancy = |event: &Event, set: &str| {
        let growth = Vanilla::new(Default::default(), &event.scene).unwrap();
        let policy = Reduced { params: toml::from_str(set).unwrap(), growth };
        let signals = event.signals(policy.needs(&event.scene).signals);
        let (step, scene) = (event.step, &event.scene);
        policy.redundancy(&Snapshot { step, scene, signals: &signals, candidates: &[] }).unwrap()
    };
    assert_eq!(redundancy(&shifted, ""), [3.0, 2.0, 2.0, 2.0, 2.0, 1.0]);
    assert_eq!(redundancy(&shifted.clone().with_all(Signal::PixelSizeMin, 0.51), ""), [1.0; 6]);
    assert_eq!(redundancy(&shifted, "sigmas = 2.6"), [1.0; 6]);
}

#[test]
fn the_faintest_rows_are_pruned() {
    // 101 rows: the 3 % quantile is the fourth lowest opacity, and below it are three.
    let xs: Vec<f32> = (0..101).map(|row| 10.0 * row as f32).collect();
    let opacities = |first: f32, step: f32| -> Vec<f32> {
        (0..101).rev().map(|rank| first + step * rank as f32).collect()
    };
    let event = event(1000, &xs);
    let pruned = |opacity: &[f32], set: &str| {
        run(&event.clone().with(Signal::Opacity, opacity), &format!("grow_every = 0\n{set}")).pruned
    };
    let faint = opacities(0.01, 0.001);
    assert_eq!(pruned(&faint, ""), [98, 99, 100]);
    assert_eq!(pruned(&faint, "faint_share = 0.05"), [96, 97, 98, 99, 100]);
    assert!(pruned(&faint, "faint_opacity = 0.0").is_empty());
    // If the quantile is above 0.05, the limit is 0.05: 0.048 and 0.049 are below it.
    assert_eq!(pruned(&opacities(0.048, 0.001), ""), [99, 100]);
    assert_eq!(pruned(&opacities(0.048, 0.001), "faint_opacity = 0.0485"), [100]);
    assert!(pruned(&opacities(0.5, 0.001), "").is_empty());
}

#[test]
fn invisible_rows_are_pruned_after_growth() {
    // 1/255 = 0.003922.
    let event = event(15_000, &[0.0, 10.0, 20.0]).with(Signal::Opacity, &[0.0039, 0.00393, 0.5]);
    let pruned_at = |step| run(&Event { step, ..event.clone() }, "faint_opacity = 0.0").pruned;
    assert_eq!((pruned_at(15_000), pruned_at(30_000)), (vec![0], vec![0]));
    // During growth vanilla prunes below 0.005.
    assert_eq!(pruned_at(14_000), [0, 1]);
    let early = Event { step: 14_000, ..event };
    assert!(run(&early, "faint_opacity = 0.0\ngrow_every = 0").pruned.is_empty());
}

#[test]
fn prunes_are_every_thousand_steps_except_at_resets() {
    let policy = |set: &str, iterations| {
        let scene = SceneInfo { iterations, ..Event::new(1, 1, 1).scene };
        let growth = Vanilla::new(Default::default(), &scene).unwrap();
        let set = find("reduced-3dgs").unwrap().effective(&set.parse().unwrap(), &scene).unwrap();
        (Reduced { params: set.try_into().unwrap(), growth }, iterations)
    };
    let prunes = |(policy, last): (Reduced, u32)| -> Vec<u32> {
        (0..=last).filter(|&step| policy.prunes_at(step)).collect()
    };
    let thousands = |at: &dyn Fn(u32) -> bool| -> Vec<u32> {
        (1..=30).filter(|&k| at(k)).map(|k| 1000 * k).collect()
    };
    let whole = prunes(policy("", REFERENCE_ITERATIONS));
    assert_eq!(whole, thousands(&|k| ![3, 6, 9, 12].contains(&k)));
    let until = prunes(policy("prune_until = 27000", REFERENCE_ITERATIONS));
    assert_eq!(until, thousands(&|k| k <= 27 && ![3, 6, 9, 12].contains(&k)));
    assert!(prunes(policy("prune_every = 0", REFERENCE_ITERATIONS)).is_empty());
    // 1,000 · 7,000/30,000 = 233.3.
    let entry = find("reduced-3dgs").unwrap();
    let scene = SceneInfo { iterations: 7000, ..Event::new(1, 1, 1).scene };
    let table = entry.effective(&Default::default(), &scene).unwrap();
    let at = |name: &str| table[name].as_integer().unwrap();
    assert_eq!((at("prune_every"), at("prune_until"), at("grow_until")), (233, 7000, 3500));
    let due = due_steps("reduced-3dgs", "grow_every = 0", &Event::new(1, 1, 1).scene);
    assert_eq!(due, thousands(&|_| true));
}

#[test]
fn the_mean_opacity_is_a_term_of_the_loss() {
    let scene = Event::new(1, 1, 1).scene;
    let terms = |set: &str| build("reduced-3dgs", set, &scene).needs(&scene).loss_terms;
    assert_eq!(terms(""), LossTerms { opacity: 0.001, scale: 0.0 });
    assert!(terms("opacity_term = 0.0").is_none());
}

#[test]
fn growth_is_that_of_vanilla() {
    let event = event(600, &[0.0, 10.0, 20.0, 30.0]);
    // The smallest pixel is reset by prunes only.
    assert!(!run(&event, "").ops.reset_signals.contains(Signal::PixelSizeMin));
    assert_grows_like_vanilla("reduced-3dgs", event, "");
}

#[test]
fn rows_that_grow_are_not_pruned_and_one_row_is_kept() {
    // Row 20 is the faintest of the six at one place, and is cloned.
    let mut gradient = [0.0; 26];
    gradient[20] = 1.0;
    let event = Event { budget: 27, ..crowd(1000) }
        .with(Signal::Opacity, &opacities([0.1, 0.2, 0.3, 0.4, 0.6, 0.9]))
        .with(Signal::ScreenGradient, &gradient);
    let done = run(&event, "faint_opacity = 0.0");
    assert_eq!((done.cloned.as_slice(), done.pruned.as_slice()), (&[20][..], &[21, 22][..]));
    assert_eq!(done.ops.counts.denied, 0);
    // All rows are invisible: the most opaque is kept.
    let last = self::event(20_000, &[0.0, 10.0, 20.0]).with(Signal::Opacity, &[1e-3, 3e-3, 2e-3]);
    assert_eq!(run(&last, "").pruned, [0, 2]);
}

#[test]
fn the_control_prunes_the_same_number_at_random() {
    let event = crowd(1000).with(Signal::Opacity, &opacities([0.1, 0.2, 0.3, 0.4, 0.6, 0.9]));
    let done = run(&event, "victims = \"random\"\nfaint_opacity = 0.0");
    assert_eq!(done.pruned.len(), 3);
    assert_ne!(done.pruned, [20, 21, 22]);
}

#[test]
fn the_control_may_end_at_a_given_number() {
    // From 810 to 10 over the four prunes at 27,000 to 30,000: each leaves a third.
    let xs: Vec<f32> = (0..810).map(|row| 10.0 * row as f32).collect();
    let kept = |step, rows: usize, set: &str| {
        let set = format!("victims = \"random\"\nrandom_keep = 10\n{set}");
        run(&event(step, &xs[..rows]), &set).ops.rows_after
    };
    assert_eq!([kept(27_000, 810, ""), kept(28_000, 270, ""), kept(29_000, 90, "")], [270, 90, 30]);
    assert_eq!([kept(30_000, 30, ""), kept(30_000, 810, ""), kept(30_000, 5, "")], [10, 10, 5]);
    assert_eq!(kept(27_000, 810, "prune_until = 27500"), 10);
    // Prunes after the run's last step do not count.
    assert_eq!(kept(29_000, 90, "prune_until = 90000"), 30);
    // The first of the sixteen prunes after growth leaves 810·(1/81)^(1/16) = 615.47.
    assert_eq!(kept(15_000, 810, ""), 615);
    let keep_one = "victims = \"random\"\nrandom_keep = 1";
    assert_eq!(run(&event(30_000, &xs[..30]), keep_one).ops.rows_after, 1);
    // During growth the control prunes as many as the real policy would, here none.
    assert_eq!(kept(14_000, 810, "grow_every = 0"), 810);
}

#[test]
fn mean_and_deviation_match_values_worked_out_by_hand() {
    assert_eq!(mean_and_deviation(&[1.0, 3.0, 5.0]), (3.0, 2.0));
    assert_eq!((mean_and_deviation(&[4.0]), mean_and_deviation(&[])), ((4.0, 0.0), (0.0, 0.0)));
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "reduced-3dgs",
        &[
            "prune_every = 1\nneighbours = 1\ndeviations = 0.0\nmin_redundancy = 0.0",
            "prune_every = 7\nneighbours = 1000\nsigmas = 1e30\nfaint_share = 1.0\nfaint_opacity = 1.0",
            "victims = \"random\"\nprune_every = 50\nsigmas = 1e-30",
            "victims = \"random\"\nrandom_keep = 3\ngrow_until = 100\nprune_every = 20",
        ],
    );
}
