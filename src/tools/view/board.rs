//! What the page of a run in training says, and what it asks of the run: written and read by both threads.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};

use densify_train::evaluate::Mean;
use densify_train::output::StepRecord;
use densify_train::trainer::EditEvent;

/// Most points of a curve; with more, every second is dropped.
const MOST_POINTS: usize = 512;
/// Edits that are kept.
const MOST_EDITS: usize = 100;
/// What a board takes at most, and its text on the way to a page `[bytes]`.
pub(crate) const BYTES: u64 = 256 << 10;

/// How the run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum State {
    /// Nothing has been trained yet.
    #[default]
    Preparing,
    Training,
    Paused,
    /// It ends in order.
    Stopping,
    Ended,
}

/// What a page may ask of the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Order {
    Pause,
    Continue,
    /// One step, and then a pause.
    Step,
    Checkpoint,
    Stop,
}

/// A point of the curves: the means of a record.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Point {
    step: u32,
    loss: f32,
    rows: usize,
}

/// What is said.
#[derive(Debug, Clone, Default, Serialize)]
struct Said {
    state: State,
    step: u32,
    last: u32,
    rows: usize,
    budget: usize,
    /// Time of all steps `[s]`.
    seconds: f64,
    points: Vec<Point>,
    /// Records that a point stands for.
    #[serde(skip)]
    stride: usize,
    #[serde(skip)]
    records: usize,
    /// PSNR of the test views.
    tests: Vec<(u32, f64)>,
    /// The newest edits, the oldest first.
    edits: VecDeque<EditEvent>,
    /// The newest checkpoint.
    checkpoint: Option<u32>,
    /// What could not be done.
    trouble: Option<String>,
}

/// What is asked, and not done yet.
#[derive(Debug, Default)]
struct Asked {
    is_paused: bool,
    steps: u32,
    checkpoint: bool,
    stop: bool,
}

/// Both.
#[derive(Debug, Default)]
pub(super) struct Board {
    said: Mutex<Said>,
    asked: Mutex<Asked>,
}

/// What the run does next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Next {
    Step,
    Checkpoint,
    Stop,
    Wait,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Each change is whole before anything can fail.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Board {
    /// All of it, as JSON.
    pub(super) fn json(&self) -> String {
        let said = locked(&self.said).clone();
        serde_json::to_string(&said).unwrap_or_default()
    }

    /// Takes an order.
    pub(super) fn order(&self, order: Order) {
        let mut asked = locked(&self.asked);
        match order {
            Order::Pause => asked.is_paused = true,
            Order::Continue => (asked.is_paused, asked.steps) = (false, 0),
            Order::Step => (asked.is_paused, asked.steps) = (true, asked.steps.saturating_add(1)),
            Order::Checkpoint => asked.checkpoint = true,
            Order::Stop => asked.stop = true,
        }
    }

    /// What the run is to do now; that is done with it.
    pub(super) fn next(&self) -> Next {
        let (next, state) = {
            let mut asked = locked(&self.asked);
            if asked.stop {
                (Next::Stop, State::Stopping)
            } else if std::mem::take(&mut asked.checkpoint) {
                return Next::Checkpoint;
            } else if !asked.is_paused {
                (Next::Step, State::Training)
            } else if asked.steps > 0 {
                asked.steps -= 1;
                (Next::Step, State::Paused)
            } else {
                (Next::Wait, State::Paused)
            }
        };
        locked(&self.said).state = state;
        next
    }

    /// Whether the run is to end.
    pub(super) fn stops(&self) -> bool {
        locked(&self.asked).stop
    }

    pub(super) fn begin(&self, step: u32, last: u32, budget: usize, rows: usize) {
        let mut said = locked(&self.said);
        (said.step, said.last, said.budget, said.rows) = (step, last, budget, rows);
    }

    pub(super) fn step(&self, step: u32, rows: usize) {
        let mut said = locked(&self.said);
        (said.step, said.rows) = (step, rows);
    }

    /// Adds a record; where there are too many, every second goes, so that all of the run stays in sight.
    pub(super) fn record(&self, record: &StepRecord) {
        let mut said = locked(&self.said);
        said.seconds = record.seconds;
        said.stride = said.stride.max(1);
        if said.records.is_multiple_of(said.stride) {
            let &StepRecord { step, loss, rows, .. } = record;
            said.points.push(Point { step, loss, rows });
        }
        said.records += 1;
        if said.points.len() > MOST_POINTS {
            let mut at = 0;
            said.points.retain(|_| {
                at += 1;
                at % 2 == 1
            });
            said.stride *= 2;
        }
    }

    pub(super) fn edit(&self, event: &EditEvent) {
        let mut said = locked(&self.said);
        if said.edits.len() == MOST_EDITS {
            said.edits.pop_front();
        }
        said.edits.push_back(event.clone());
    }

    pub(super) fn tested(&self, step: u32, mean: &Mean) {
        let mut said = locked(&self.said);
        if said.tests.len() < MOST_POINTS {
            said.tests.push((step, mean.psnr));
        }
    }

    /// A checkpoint was written, or why it could not be.
    pub(super) fn kept(&self, step: u32, trouble: Option<&str>) {
        let mut said = locked(&self.said);
        if trouble.is_none() {
            said.checkpoint = Some(step);
        }
        said.trouble = trouble.map(str::to_owned);
    }

    pub(super) fn end(&self) {
        locked(&self.said).state = State::Ended;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(step: u32) -> StepRecord {
        let (loss, rows) = (1.0 / step as f32, step as usize);
        StepRecord { step, loss, l1: 0.0, ssim: 0.0, rows, seconds: 1.0, resident_bytes: None }
    }

    #[test]
    fn orders_are_done_once_and_a_paused_run_waits() {
        let board = Board::default();
        assert_eq!(board.next(), Next::Step);
        board.order(Order::Pause);
        assert_eq!([board.next(), board.next()], [Next::Wait; 2]);
        board.order(Order::Step);
        board.order(Order::Step);
        assert_eq!([(); 3].map(|()| board.next()), [Next::Step, Next::Step, Next::Wait]);
        board.order(Order::Checkpoint);
        assert_eq!([board.next(), board.next()], [Next::Checkpoint, Next::Wait]);
        board.order(Order::Step);
        board.order(Order::Continue);
        assert_eq!([(); 3].map(|()| board.next()), [Next::Step; 3]);
        board.order(Order::Stop);
        assert!(board.next() == Next::Stop && board.stops());
        assert!(board.json().contains("\"stopping\""));
    }

    #[test]
    fn a_long_run_stays_in_sight_and_within_its_bytes() {
        let board = Board::default();
        board.begin(0, 1_000_000, 9, 9);
        for step in 1..=100_000 {
            board.record(&record(10 * step));
        }
        let event = |step| EditEvent {
            step,
            before: usize::MAX,
            removed: usize::MAX,
            added: usize::MAX,
            updated: usize::MAX,
            denied: usize::MAX,
            after: usize::MAX,
            cause: "x".repeat(64),
        };
        (0..1000).for_each(|step| board.edit(&event(step)));
        (0..1000).for_each(|step| {
            board.tested(
                step,
                &Mean { psnr: 1.0 / 3.0, ssim: 0.0, flip: 0.0, lpips: None, fitted: None },
            );
        });
        let text = board.json();
        let said: serde_json::Value = serde_json::from_str(&text).unwrap();
        let points = said["points"].as_array().unwrap();
        assert!((256..=512).contains(&points.len()), "{}", points.len());
        assert_eq!(points[0]["step"], 10);
        let steps: Vec<u64> = points.iter().map(|point| point["step"].as_u64().unwrap()).collect();
        let gap = steps[1] - steps[0];
        assert!(steps.windows(2).all(|pair| pair[1] - pair[0] == gap), "{steps:?}");
        assert!(*steps.last().unwrap() > 990_000, "{steps:?}");
        assert_eq!(said["edits"].as_array().unwrap().len(), MOST_EDITS);
        assert_eq!(said["edits"][99]["step"], 999);
        assert!(2 * text.len() as u64 <= BYTES, "{}", text.len());
    }
}
