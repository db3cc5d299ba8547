//! Tests of the automatic budget with synthetic measurements: the end of growth, and the removal of rows.

use super::*;

const LENGTH: u32 = 100;
const BUDGET: usize = 200_000;
/// PSNR of a model by number of rows: each doubling gains half as much as the one before.
fn psnr_of_rows(rows: usize) -> f64 {
    38.0 - 1.6 * (4_000.0 / rows as f64)
}

/// Simulates intervals, each of which gains `training` dB by training alone.
fn grow(first: usize, training: f64) -> AutoBudget {
    let mut auto = AutoBudget::new(first, BUDGET);
    let mut rows = first;
    for end in 1..=20_u32 {
        let psnr = psnr_of_rows(rows) + training * f64::from(end);
        assert!(auto.record(end * LENGTH, rows, psnr), "the PSNR only rises");
        auto.update_limit(10 * BUDGET);
        if auto.stopped.is_some() {
            break;
        }
        rows = auto.limit;
    }
    auto
}

#[test]
fn growth_stops_when_the_gain_is_too_low_twice_in_a_row() {
    let auto = grow(1_000, 0.0);
    let gains: Vec<Option<f64>> = auto.intervals.iter().map(|interval| interval.gain).collect();
    assert_eq!(gains[..2], [None, None], "two points give no slope");
    let gains: Vec<f64> = gains.into_iter().flatten().collect();
    // For three equally spaced points the slope is the difference of the outer two, which are a doubling apart.
    let [first, .., third] = [0, 1, 2].map(|i| auto.intervals[i].psnr);
    assert!((gains[0] - (third - first)).abs() < 1e-2, "{} for {}", gains[0], third - first);
    let (sufficient, low) = gains.split_at(gains.len() - 2);
    let all_sufficient = sufficient.iter().all(|gain| *gain >= MIN_GAIN);
    assert!(sufficient.len() > 5 && all_sufficient, "{gains:?}");
    assert!(low.iter().all(|gain| *gain < MIN_GAIN), "stopped too late: {gains:?}");
    assert_eq!(auto.limit, auto.intervals.last().unwrap().rows, "the model grows no further");
}

#[test]
fn gains_by_training_alone_prolong_growth() {
    let (without, with) = (grow(1_000, 0.0), grow(1_000, 0.03));
    assert!(without.stopped.is_some() && with.stopped > without.stopped, "{with:?}");
    assert_eq!(grow(1_000, 0.06).stopped, None, "0.12 dB per doubling by training alone");
}

#[test]
fn a_limit_that_is_not_reached_rises_at_most_to_the_budget() {
    let mut auto = AutoBudget::new(100_000, BUDGET);
    for end in 1..=6 {
        auto.record(end * LENGTH, 20_000, 30.0);
        auto.update_limit(BUDGET);
    }
    assert_eq!((auto.limit, auto.stopped), (BUDGET, None));
    assert!(auto.intervals.iter().all(|interval| interval.gain.is_none()), "{:?}", auto.intervals);
    // The limit also rises if the number of rows increases but stays far below it.
    for end in 7..=12 {
        auto.record(end * LENGTH, 1_000 << (end - 7), 30.0);
        auto.update_limit(BUDGET);
    }
    assert!(auto.intervals.last().unwrap().gain.unwrap() < MIN_GAIN);
    assert_eq!((auto.idle, auto.stopped), (0, None));
    assert_eq!(AutoBudget::new(10, BUDGET).limit, MIN_LIMIT);
    assert_eq!(AutoBudget::new(10, 400).limit, 400);
}

#[test]
fn intervals_count_only_after_the_psnr_has_recovered() {
    let psnr = [30.0, 33.0, 35.0, 35.6, 35.2, 29.0, 35.0, 35.2, 36.0];
    let mut auto = AutoBudget::new(5_000, BUDGET);
    let settled: Vec<bool> = (1..).zip(psnr).map(|(end, psnr)| auto.record(end, 0, psnr)).collect();
    assert_eq!(settled, [true, true, true, true, true, false, false, true, true]);
    // A drop from which the PSNR does not recover counts as permanent.
    let mut auto = AutoBudget::new(5_000, BUDGET);
    let lost: Vec<bool> =
        (0..8).map(|end| auto.record(end, 0, if end == 0 { 30.0 } else { 20.0 })).collect();
    assert_eq!(lost, [true, false, false, false, false, false, false, true]);
    // The slope is fitted to the settled intervals only.
    let mut auto = AutoBudget::new(4_000, BUDGET);
    for (rows, psnr) in [(4_000, 30.0), (8_000, 31.0), (12_000, 12.0), (16_000, 32.0)] {
        if auto.record(rows as u32, rows, psnr) {
            auto.update_limit(BUDGET);
        }
    }
    let gains: Vec<Option<f64>> = auto.intervals.iter().map(|interval| interval.gain).collect();
    assert_eq!(gains[..3], [None; 3]);
    assert!((gains[3].unwrap() - 1.0).abs() < 1e-9, "1 dB per doubling: {gains:?}");
    assert_eq!(auto.limit, 11_314, "it has risen in three of four intervals");
}

#[test]
fn rows_are_removed_after_growth_and_not_at_the_end() {
    let mut auto = AutoBudget::new(10_000, BUDGET);
    assert!(!auto.may_remove(500, 1_000), "the model still grows");
    assert!(auto.may_remove(600, 1_000), "policies have stopped");
    auto.stopped = Some(300);
    assert!(auto.may_remove(400, 1_000));
    assert!(!auto.may_remove(900, 1_000), "the remaining rows must adapt");
}

#[test]
fn intervals_are_multiples_of_100_steps() {
    for (iterations, steps) in [(30_000, 1_500), (2_000, 100), (5_000, 300), (100, 100)] {
        assert_eq!(interval_steps(iterations), steps);
    }
}
