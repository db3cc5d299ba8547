//! Tests of the rules of `lightgaussian`, each worked out by hand.

#![expect(clippy::float_cmp, reason = "values are exact, or rounded before they are compared")]

use super::*;
use crate::event::{
    Event, Outcome, View, assert_conforms, assert_grows_like_vanilla, build, due_steps,
};
use crate::parameters::REFERENCE_ITERATIONS;
use crate::policy::SignalSet;

fn run(event: &Event, set: &str) -> Outcome {
    event.run("lightgaussian", set)
}

/// Rows of opacity 0.5 and volume 1, and no auxiliary view; the growth rules neither densify nor prune them.
fn event(step: u32, rows: usize) -> Event {
    Event::small_rows(step, rows, rows).with_all(Signal::ScaleProduct, 1.0)
}

/// A view in which rows are blended into these numbers of pixels, with these sums of blend weights.
fn view(pixels: &[f32], weights: &[f32]) -> View {
    let columns =
        vec![(AuxColumn::PixelCount, pixels.to_vec()), (AuxColumn::WeightSum, weights.to_vec())];
    View { columns, ..View::default() }
}

#[test]
fn significance_is_summed_over_all_views() {
    // Row by row, pixels of both views · opacity: 30·0.5 = 15, 12·0.9 = 10.8, 100·0.1 = 10, 24·0.5 = 12.
    // The first view alone would rank row 0 lowest, and pixels alone row 1.
    let mut event = event(16_000, 4).with(Signal::Opacity, &[0.5, 0.9, 0.1, 0.5]);
    event.views =
        vec![view(&[0.0, 12.0, 50.0, 12.0], &[0.0; 4]), view(&[30.0, 0.0, 50.0, 12.0], &[0.0; 4])];
    assert_eq!(run(&event, "first_share = 0.25").pruned, [2]);
    assert_eq!(run(&event, "first_share = 0.5").pruned, [1, 2]);
    assert_eq!(run(&event, "first_share = 0.75").pruned, [1, 2, 3]);
    let done = run(&event, "");
    assert_eq!((done.ops.cause.as_str(), done.ops.rows_after), ("prune", 2));
    assert!(done.ops.clamp_opacity.is_none() && done.cloned.is_empty() && done.split.is_empty());
}

#[test]
fn the_blend_weight_is_not_multiplied_by_the_opacity() {
    // The weights of both views are 3, 2, 4; multiplied by the opacity, row 2 would be lowest with 0.4.
    let mut event = event(16_000, 3).with(Signal::Opacity, &[0.5, 0.9, 0.1]);
    event.views = vec![view(&[9.0; 3], &[1.0, 2.0, 4.0]), view(&[9.0; 3], &[2.0, 0.0, 0.0])];
    assert_eq!(run(&event, "hit = \"blend-weight\"\nfirst_share = 0.34").pruned, [1]);
    assert_eq!(run(&event, "hit = \"blend-weight\"\nfirst_share = 0.67").pruned, [0, 1]);
    // With the default `hit`, pixels · opacity: 9, 16.2, 1.8.
    assert_eq!(run(&event, "first_share = 0.34").pruned, [2]);
}

#[test]
fn significance_grows_with_the_tenth_root_of_the_volume() {
    // Volumes 1 and 1024: factors 1 and 1024^0.1 = 2. Pixels · ½ · factor: 5, 4.5·2 = 9, 4, 2.45·2 = 4.9.
    let mut event = event(16_000, 4).with(Signal::ScaleProduct, &[1.0, 1024.0, 1.0, 1024.0]);
    event.views = vec![view(&[10.0, 9.0, 8.0, 4.9], &[0.0; 4])];
    // In ascending order: 4, 4.9, 5, 9.
    let pruned = |set: &str| run(&event, set).pruned;
    assert_eq!(pruned("first_share = 0.25"), [2]);
    assert_eq!(pruned("first_share = 0.5"), [2, 3]);
    // Without the volume: 10, 9, 8, 4.9.
    assert_eq!(pruned("first_share = 0.5\nvolume_power = 0"), [2, 3]);
    assert_eq!(pruned("first_share = 0.25\nvolume_power = 0"), [3]);
    // With the volume itself as the factor: 5, 4608, 4, 2508.8.
    assert_eq!(pruned("first_share = 0.5\nvolume_power = 1"), [0, 2]);
}

/// The significance of the rows of an event with these numbers of pixels in its one view.
fn significance(event: &Event, set: &str, pixels: &[f32]) -> Vec<f32> {
    let growth = Vanilla::new(Default::default(), &event.scene).unwrap();
    let params: LightGaussianParams = toml::from_str(set).unwrap();
    let policy = LightGaussian { params, growth, hits: ViewAccumulator::default() };
    let signals = event.signals(SignalSet::from([Signal::Opacity, Signal::ScaleProduct]));
    let (step, scene) = (event.step, &event.scene);
    let now = Snapshot { step, scene, signals: &signals, candidates: &[] };
    policy.significance(&now, pixels).unwrap()
}

#[test]
fn the_largest_tenth_of_volumes_is_clipped() {
    // Two of twenty volumes are larger than V90 = 32^10 and are clipped: factors 1, 32, 32 and 32
    // instead of 1, 32, 64 and 128. The factor pixels · opacity is 2 · ½ = 1.
    let mut volume = [1.0; 20];
    volume[7] = 32_f32.powi(10);
    volume[8] = 64_f32.powi(10);
    volume[9] = 128_f32.powi(10);
    let event = event(16_000, 20).with(Signal::ScaleProduct, &volume);
    let factors = |set: &str| {
        let all = significance(&event, set, &[2.0; 20]);
        [6, 7, 8, 9].map(|row: usize| (all[row] * 1e4).round() / 1e4)
    };
    assert_eq!(factors(""), [1.0, 32.0, 64.0, 128.0]);
    assert_eq!(factors("volume = \"clipped\""), [1.0, 32.0, 32.0, 32.0]);
    assert_eq!(percentile_90(&[1.0, 3.0, 2.0]), 3.0);
    assert_eq!(percentile_90(&[1.0, 9.0, 3.0, 2.0, 0.0, 0.0, 0.0, 0.0, 8.0, 0.0]), 8.0);
    assert!(percentile_90(&[]).is_infinite());
}

#[test]
fn rows_with_nan_have_no_significance() {
    let event = event(16_000, 3).with(Signal::ScaleProduct, &[1.0, f32::NAN, 1.0]);
    assert_eq!(significance(&event, "", &[f32::NAN, 4.0, 4.0]), [0.0, 0.0, 2.0]);
}

#[test]
fn the_published_shares_leave_30_percent() {
    // 1,000 → 500 → 300, the second share being 0.5·0.8; once: 1,000 → 340.
    let rows_after = |step, rows: usize, set: &str| {
        let mut event = event(step, rows);
        event.views = vec![view(&vec![1.0; rows], &vec![1.0; rows])];
        run(&event, set).ops.rows_after
    };
    assert_eq!([rows_after(16_000, 1000, ""), rows_after(24_000, 500, "")], [500, 300]);
    assert_eq!(rows_after(20_000, 1000, "schedule = \"once\""), 340);
    // ⌊0.5·7⌋ = 3.
    assert_eq!(rows_after(16_000, 7, ""), 4);
    // At least one row is kept.
    assert_eq!(rows_after(16_000, 7, "first_share = 1.0"), 1);
    assert_eq!(rows_after(16_000, 1, ""), 1);
}

#[test]
fn prunes_come_after_growth_and_scale_with_the_run() {
    let due = |set: &str, iterations| {
        let scene = SceneInfo { iterations, ..Event::new(1, 1, 1).scene };
        due_steps("lightgaussian", &format!("grow_every = 0\nreset_every = 0\n{set}"), &scene)
    };
    assert_eq!(due("", REFERENCE_ITERATIONS), [16_000, 24_000]);
    assert_eq!(due("schedule = \"once\"", REFERENCE_ITERATIONS), [20_000]);
    // Steps scale by 7,000/30,000: to 3733.3 and 5600; with `once` to 4666.7.
    assert_eq!(due("", 7000), [3733, 5600]);
    assert_eq!(due("schedule = \"once\"", 7000), [4667]);
    assert_eq!(due("first_share = 0.0", REFERENCE_ITERATIONS), [24_000]);
    assert_eq!(due("first_at = 0", REFERENCE_ITERATIONS), [24_000]);
    let growth = due_steps("lightgaussian", "", &Event::new(1, 1, 1).scene);
    assert_eq!((growth.len(), growth[143]), (146, 14_900));
}

#[test]
fn growth_is_that_of_vanilla() {
    assert_grows_like_vanilla("lightgaussian", event(600, 4), "");
}

#[test]
fn rows_that_grow_in_an_event_are_not_pruned_in_it() {
    // Row 0 has the lowest significance and is cloned; of four rows two are pruned.
    let mut event =
        Event { budget: 9, ..event(600, 4) }.with(Signal::ScreenGradient, &[1.0, 0.0, 0.0, 0.0]);
    event.views = vec![view(&[1.0, 2.0, 3.0, 4.0], &[0.0; 4])];
    let done = run(&event, "first_at = 600");
    assert_eq!((done.cloned.as_slice(), done.pruned.as_slice()), (&[0][..], &[1, 2][..]));
    assert_eq!((done.ops.cause.as_str(), done.ops.counts.denied), ("densify+prune", 0));
}

#[test]
fn the_control_prunes_the_same_number_at_random_and_renders_nothing() {
    let event = event(16_000, 1000);
    let random = "victims = \"random\"";
    let done = run(&event, random);
    assert_eq!(done.ops.rows_after, 500);
    assert!(run(&Event { step: 24_000, ..event.clone() }, random).pruned != done.pruned);
    let views = |set: &str, step| build("lightgaussian", set, &event.scene).aux_views(step, 9, 9);
    assert_eq!([15_999, 16_000, 24_000].map(|step| views("", step)), [0, u32::MAX, u32::MAX]);
    assert_eq!([16_000, 24_000].map(|step| views(random, step)), [0, 0]);
    let needs = |set: &str| build("lightgaussian", set, &event.scene).needs(&event.scene);
    assert_eq!(needs("").aux.unwrap().columns, [AuxColumn::PixelCount]);
    assert_eq!(needs("hit = \"blend-weight\"").aux.unwrap().columns, [AuxColumn::WeightSum]);
    assert_eq!(needs(random), build("vanilla", "", &event.scene).needs(&event.scene));
}

#[test]
fn without_a_view_nothing_is_pruned() {
    assert!(run(&event(16_000, 10), "").pruned.is_empty());
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "lightgaussian",
        &[
            "schedule = \"once\"\nhit = \"blend-weight\"",
            "volume = \"clipped\"\nvolume_power = 1.0",
            "victims = \"random\"\ngovernor = true",
            "first_at = 200\nsecond_at = 300\nfirst_share = 1.0\nsecond_share = 1.0",
        ],
    );
}
