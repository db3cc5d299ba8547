use super::*;

const LENGTH: u32 = 100;
const BUDGET: usize = 200_000;
/// Probes differ in how hard they are.
const PROBES: [f64; 4] = [-3.0, -1.0, 1.0, 3.0];

/// What a model of so many rows reaches: a doubling brings half of what the one before has brought.
fn reached(rows: usize) -> f64 {
    38.0 - 1.6 * (4_000.0 / rows as f64)
}

/// Leads a limit through rungs on a model that trains as the logarithm of the step; `noise` is what
/// each probe deviates by at each end.
fn climb(first: usize, trend: f64, noise: impl Fn(u32, usize) -> f64) -> Growth {
    let mut growth = Growth::new(first, BUDGET);
    let mut rows = first;
    for end in 1..=14_u32 {
        let at = |rows: usize, step: u32, end: u32| -> Vec<f64> {
            let base = reached(rows) + trend * f64::from(step).ln();
            PROBES.iter().enumerate().map(|(i, of)| base + of + noise(end, i)).collect()
        };
        let step = end * LENGTH;
        growth.middle = at(rows, step - LENGTH / 2, 0);
        growth.judge((step, LENGTH), rows, at(rows, step, end), BUDGET);
        if growth.stopped.is_some() {
            break;
        }
        rows = growth.limit;
    }
    growth
}

#[test]
fn what_training_brings_is_not_taken_for_what_rows_bring() {
    for trend in [0.0, 3.0] {
        let growth = climb(1_000, trend, |_, _| 0.0);
        let mut judged = 0;
        for pair in growth.rungs.windows(2) {
            let Some([gain, low]) = pair[1].gain else { continue };
            let doublings = (pair[1].rows as f64 / pair[0].rows as f64).log2();
            let expected = (reached(pair[1].rows) - reached(pair[0].rows)) / doublings;
            assert!((gain - expected).abs() < 1e-9, "{gain} for {expected}");
            assert!((gain - low).abs() < 1e-9, "probes agree");
            judged += 1;
        }
        assert!(judged > 8, "{judged}");
        let gains: Vec<f64> = growth.rungs.iter().filter_map(|rung| Some(rung.gain?[0])).collect();
        let (paid, idle) = gains.split_at(gains.len() - 2);
        assert!(paid.iter().all(|gain| *gain >= PAYS), "{gains:?}");
        assert!(idle.iter().all(|gain| *gain < PAYS), "it stops at the second: {gains:?}");
        assert_eq!(growth.limit, growth.rungs.last().unwrap().rows, "no row more");
    }
}

#[test]
fn more_rows_must_be_shown_to_pay() {
    // Every rung brings 0.5 dB per doubling, but the probes do not agree on it.
    let unsure =
        climb(1_000, 0.0, |end, probe| if end == 0 { 0.0 } else { PROBES[probe] * f64::from(end) });
    assert!(unsure.stopped.is_some_and(|step| step <= 4 * LENGTH), "{:?}", unsure.stopped);
    let sure = climb(1_000, 0.0, |_, _| 0.0);
    assert!(sure.stopped > unsure.stopped);
}

#[test]
fn rungs_without_growth_say_nothing_and_the_limit_is_the_budget_at_most() {
    let mut growth = Growth::new(150_000, BUDGET);
    for end in 1..=6 {
        growth.middle = vec![30.0; 4];
        growth.judge((end * LENGTH, LENGTH), 150_000, vec![30.0; 4], BUDGET);
        assert!(growth.rungs.iter().all(|rung| rung.gain.is_none()));
    }
    assert_eq!((growth.limit, growth.stopped), (BUDGET, None));
    assert_eq!(Growth::new(10, BUDGET).limit, LEAST_ROWS);
    assert_eq!(Growth::new(10, 400).limit, 400);
}

#[test]
fn rows_are_removed_after_growth_until_it_shows_and_not_at_the_end() {
    let mut growth = Growth::new(10_000, BUDGET);
    assert!(!growth.may_shrink(400, 1_000), "it grows");
    assert!(growth.may_shrink(500, 1_000), "policies have stopped");
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
