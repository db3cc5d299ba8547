//! Growth on made-up measurements: where it stops, and what a shrink test removes.

use super::*;

const LENGTH: u32 = 100;
const BUDGET: usize = 200_000;
/// What a model of so many rows reaches: a doubling brings half of what the one before has brought.
fn reached(rows: usize) -> f64 {
    38.0 - 1.6 * (4_000.0 / rows as f64)
}

/// Leads a limit through rungs; training alone brings so much in each.
fn climb(first: usize, training: f64) -> Growth {
    let mut growth = Growth::new(first, BUDGET);
    let mut rows = first;
    for end in 1..=20_u32 {
        let psnr = reached(rows) + training * f64::from(end);
        assert!(growth.note(end * LENGTH, rows, psnr), "it only becomes better");
        growth.judge(10 * BUDGET);
        if growth.stopped.is_some() {
            break;
        }
        rows = growth.limit;
    }
    growth
}

#[test]
fn growth_stops_where_rows_do_not_pay_twice_in_a_row() {
    let growth = climb(1_000, 0.0);
    let gains: Vec<Option<f64>> = growth.rungs.iter().map(|rung| rung.gain).collect();
    assert_eq!(gains[..2], [None, None], "two points are no slope");
    let gains: Vec<f64> = gains.into_iter().flatten().collect();
    // Three points at equal distances: what is between the outer two, a doubling apart.
    let [first, .., third] = [0, 1, 2].map(|i| growth.rungs[i].psnr);
    assert!((gains[0] - (third - first)).abs() < 1e-2, "{} for {}", gains[0], third - first);
    let (paid, idle) = gains.split_at(gains.len() - 2);
    assert!(paid.len() > 5 && paid.iter().all(|gain| *gain >= PAYS), "{gains:?}");
    assert!(idle.iter().all(|gain| *gain < PAYS), "it stops at the second: {gains:?}");
    assert_eq!(growth.limit, growth.rungs.last().unwrap().rows, "no row more");
}

#[test]
fn what_training_brings_lets_growth_go_on() {
    let (still, training) = (climb(1_000, 0.0), climb(1_000, 0.03));
    assert!(still.stopped.is_some() && training.stopped > still.stopped, "{training:?}");
    assert_eq!(climb(1_000, 0.06).stopped, None, "0.12 dB per doubling by training alone");
}

#[test]
fn a_limit_that_is_not_reached_says_nothing_and_rises_to_the_budget_at_most() {
    let mut growth = Growth::new(100_000, BUDGET);
    for end in 1..=6 {
        growth.note(end * LENGTH, 20_000, 30.0);
        growth.judge(BUDGET);
    }
    assert_eq!((growth.limit, growth.stopped), (BUDGET, None));
    assert!(growth.rungs.iter().all(|rung| rung.gain.is_none()), "{:?}", growth.rungs);
    // Nor do rows that become more far below the limit.
    for end in 7..=12 {
        growth.note(end * LENGTH, 1_000 << (end - 7), 30.0);
        growth.judge(BUDGET);
    }
    assert!(growth.rungs.last().unwrap().gain.unwrap() < PAYS);
    assert_eq!((growth.idle, growth.stopped), (0, None));
    assert_eq!(Growth::new(10, BUDGET).limit, LEAST_ROWS);
    assert_eq!(Growth::new(10, 400).limit, 400);
}

#[test]
fn nothing_is_concluded_until_an_edit_is_recovered_from() {
    let psnr = [30.0, 33.0, 35.0, 35.6, 35.2, 29.0, 35.0, 35.2, 36.0];
    let mut growth = Growth::new(5_000, BUDGET);
    let settled: Vec<bool> = (1..).zip(psnr).map(|(end, psnr)| growth.note(end, 0, psnr)).collect();
    assert_eq!(settled, [true, true, true, true, true, false, false, true, true]);
    // What does not come back is forgotten.
    let mut growth = Growth::new(5_000, BUDGET);
    let lost: Vec<bool> =
        (0..8).map(|end| growth.note(end, 0, if end == 0 { 30.0 } else { 20.0 })).collect();
    assert_eq!(lost, [true, false, false, false, false, false, false, true]);
    // The slope is that of the settled rungs, and goes over the others.
    let mut growth = Growth::new(4_000, BUDGET);
    for (rows, psnr) in [(4_000, 30.0), (8_000, 31.0), (12_000, 12.0), (16_000, 32.0)] {
        if growth.note(rows as u32, rows, psnr) {
            growth.judge(BUDGET);
        }
    }
    let gains: Vec<Option<f64>> = growth.rungs.iter().map(|rung| rung.gain).collect();
    assert_eq!(gains[..3], [None; 3]);
    assert!((gains[3].unwrap() - 1.0).abs() < 1e-9, "1 dB per doubling: {gains:?}");
    assert_eq!(growth.limit, 11_314, "it has risen at three of four rungs");
}

#[test]
fn rows_are_removed_after_growth_and_not_at_the_end() {
    let mut growth = Growth::new(10_000, BUDGET);
    assert!(!growth.may_shrink(500, 1_000), "it grows");
    assert!(growth.may_shrink(600, 1_000), "policies have stopped");
    growth.stopped = Some(300);
    assert!(growth.may_shrink(400, 1_000));
    assert!(!growth.may_shrink(900, 1_000), "those that stay must settle");
}

#[test]
fn rungs_are_whole_intervals_of_policies() {
    for (iterations, steps) in [(30_000, 1_500), (2_000, 100), (5_000, 300), (100, 100)] {
        assert_eq!(rung(iterations), steps);
    }
}
