//! Growth on made-up measurements: where it stops, and what a shrink test removes.

use super::*;

const LENGTH: u32 = 100;
const BUDGET: usize = 200_000;
/// Probes differ in how hard they are.
const PROBES: [f64; 4] = [-3.0, -1.0, 1.0, 3.0];

/// What a model of so many rows reaches: a doubling brings half of what the one before has brought.
fn reached(rows: usize) -> f64 {
    38.0 - 1.6 * (4_000.0 / rows as f64)
}

/// Leads a limit through rungs; `doubt` is how much the probes disagree on what the least tenth brings.
fn climb(first: usize, doubt: f64) -> Growth {
    let mut growth = Growth::new(first, BUDGET);
    let mut rows = first;
    for end in 1..=14_u32 {
        let all = PROBES.map(|of| reached(rows) + of);
        let fewer = PROBES.map(|of| reached(rows - tenth(rows)) + of + doubt * of);
        growth.judge(end * LENGTH, rows, [&all, &fewer], BUDGET);
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
    for Rung { rows, gain: [gain, low], .. } in &growth.rungs {
        let fewer = rows - tenth(*rows);
        let expected = (reached(*rows) - reached(fewer)) / (*rows as f64 / fewer as f64).log2();
        assert!(
            (gain - expected).abs() < 1e-9 && (gain - low).abs() < 1e-9,
            "{gain} for {expected}"
        );
    }
    let gains: Vec<f64> = growth.rungs.iter().map(|rung| rung.gain[0]).collect();
    let (paid, idle) = gains.split_at(gains.len() - 2);
    assert!(paid.len() > 5 && paid.iter().all(|gain| *gain >= PAYS), "{gains:?}");
    assert!(idle.iter().all(|gain| *gain < PAYS), "it stops at the second: {gains:?}");
    assert_eq!(growth.limit, growth.rungs.last().unwrap().rows, "no row more");
}

#[test]
fn more_rows_must_be_shown_to_pay() {
    let (sure, unsure) = (climb(1_000, 0.0), climb(1_000, 0.05));
    assert!(unsure.stopped.is_some() && unsure.stopped < sure.stopped, "{:?}", unsure.stopped);
    let means = |growth: &Growth| growth.rungs[0].gain[0];
    assert!((means(&sure) - means(&unsure)).abs() < 1e-9, "on the whole they say the same");
}

#[test]
fn a_limit_that_is_not_reached_says_nothing_and_rises_to_the_budget_at_most() {
    let mut growth = Growth::new(100_000, BUDGET);
    for end in 1..=6 {
        growth.judge(end * LENGTH, 20_000, [&[30.0; 4], &[30.0; 4]], BUDGET);
    }
    assert_eq!((growth.limit, growth.stopped), (BUDGET, None));
    assert_eq!(Growth::new(10, BUDGET).limit, LEAST_ROWS);
    assert_eq!(Growth::new(10, 400).limit, 400);
}

#[test]
fn rows_are_removed_after_growth_until_it_shows_and_not_at_the_end() {
    let mut growth = Growth::new(10_000, BUDGET);
    assert!(!growth.may_shrink(500, 1_000), "it grows");
    assert!(growth.may_shrink(600, 1_000), "policies have stopped");
    growth.stopped = Some(300);
    assert!(growth.may_shrink(400, 1_000));
    assert!(!growth.may_shrink(900, 1_000), "those that stay must settle");
    growth.shrinks.push(Shrink { step: 400, before: 10, after: 9, change: 0.0, kept: true });
    assert!(growth.may_shrink(500, 1_000));
    growth.shrinks.push(Shrink { step: 500, before: 9, after: 8, change: -0.1, kept: false });
    assert!(!growth.may_shrink(600, 1_000));
}

#[test]
fn rungs_are_whole_intervals_of_policies() {
    for (iterations, steps) in [(30_000, 1_500), (2_000, 100), (5_000, 300), (100, 100)] {
        assert_eq!(rung(iterations), steps);
    }
}
