//! The progress of a run in training, and the page's commands to it; shared by the training and the HTTP threads.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};

use densify_train::evaluate::Mean;
use densify_train::output::StepRecord;
use densify_train::trainer::EditEvent;

/// Maximum number of points of a curve; when exceeded, every second point is dropped.
const MAX_POINTS: usize = 512;
/// Number of newest edits that are kept.
const MAX_EDITS: usize = 100;
/// Memory for the status and for its JSON text `[bytes]`.
pub(crate) const BYTES: u64 = 256 << 10;

/// The state of the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum State {
    /// Before the first step.
    #[default]
    Preparing,
    Training,
    Paused,
    /// Stopped by the page; writes a checkpoint.
    Stopping,
    Ended,
}

/// A command from the page. The protocol calls it an order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Command {
    Pause,
    Continue,
    /// Takes one step and pauses.
    Step,
    Checkpoint,
    Stop,
}

/// A point of the curves: the means over the steps of one record.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Point {
    step: u32,
    loss: f32,
    rows: usize,
}

/// The progress, as the page receives it.
#[derive(Debug, Clone, Default, Serialize)]
struct Progress {
    state: State,
    step: u32,
    last: u32,
    rows: usize,
    budget: usize,
    /// Time of all steps `[s]`.
    seconds: f64,
    points: Vec<Point>,
    /// One of this many records is kept as a point.
    #[serde(skip)]
    stride: usize,
    /// Number of records so far.
    #[serde(skip)]
    records: usize,
    /// Steps at which the test views were evaluated, with their mean PSNR `[dB]`.
    tests: Vec<(u32, f64)>,
    /// The newest edits, the oldest first.
    edits: VecDeque<EditEvent>,
    /// Step of the newest checkpoint.
    checkpoint: Option<u32>,
    /// The reason why the last checkpoint could not be written, if it failed.
    trouble: Option<String>,
}

/// Commands that have not been executed yet.
#[derive(Debug, Default)]
struct Pending {
    is_paused: bool,
    steps: u32,
    checkpoint: bool,
    stop: bool,
}

/// Progress and pending commands.
#[derive(Debug, Default)]
pub(super) struct RunStatus {
    progress: Mutex<Progress>,
    pending: Mutex<Pending>,
}

/// The next action of the training thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Action {
    Step,
    Checkpoint,
    Stop,
    Wait,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // A panicking holder cannot leave a change half done, so a poisoned lock is still valid.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl RunStatus {
    /// The progress as JSON.
    pub(super) fn json(&self) -> String {
        let progress = locked(&self.progress).clone();
        serde_json::to_string(&progress).unwrap_or_default()
    }

    /// Records a command for [`next_action`](Self::next_action).
    pub(super) fn command(&self, command: Command) {
        let mut pending = locked(&self.pending);
        match command {
            Command::Pause => pending.is_paused = true,
            Command::Continue => (pending.is_paused, pending.steps) = (false, 0),
            Command::Step => {
                (pending.is_paused, pending.steps) = (true, pending.steps.saturating_add(1));
            }
            Command::Checkpoint => pending.checkpoint = true,
            Command::Stop => pending.stop = true,
        }
    }

    /// Takes the next action for the training thread from the pending commands.
    pub(super) fn next_action(&self) -> Action {
        let (action, state) = {
            let mut pending = locked(&self.pending);
            if pending.stop {
                (Action::Stop, State::Stopping)
            } else if std::mem::take(&mut pending.checkpoint) {
                return Action::Checkpoint;
            } else if !pending.is_paused {
                (Action::Step, State::Training)
            } else if pending.steps > 0 {
                pending.steps -= 1;
                (Action::Step, State::Paused)
            } else {
                (Action::Wait, State::Paused)
            }
        };
        locked(&self.progress).state = state;
        action
    }

    /// True once the page has stopped the run.
    pub(super) fn is_stopped(&self) -> bool {
        locked(&self.pending).stop
    }

    pub(super) fn begin(&self, step: u32, last: u32, budget: usize, rows: usize) {
        let mut progress = locked(&self.progress);
        (progress.step, progress.last, progress.budget, progress.rows) = (step, last, budget, rows);
    }

    pub(super) fn step(&self, step: u32, rows: usize) {
        let mut progress = locked(&self.progress);
        (progress.step, progress.rows) = (step, rows);
    }

    /// Adds a point to the curves. When there are too many points, drops every second one, so that the curves still
    /// cover the whole run.
    pub(super) fn record(&self, record: &StepRecord) {
        let mut progress = locked(&self.progress);
        progress.seconds = record.seconds;
        progress.stride = progress.stride.max(1);
        if progress.records.is_multiple_of(progress.stride) {
            let &StepRecord { step, loss, rows, .. } = record;
            progress.points.push(Point { step, loss, rows });
        }
        progress.records += 1;
        if progress.points.len() > MAX_POINTS {
            let mut at = 0;
            progress.points.retain(|_| {
                at += 1;
                at % 2 == 1
            });
            progress.stride *= 2;
        }
    }

    pub(super) fn record_edit(&self, event: &EditEvent) {
        let mut progress = locked(&self.progress);
        if progress.edits.len() == MAX_EDITS {
            progress.edits.pop_front();
        }
        progress.edits.push_back(event.clone());
    }

    pub(super) fn record_test(&self, step: u32, mean: &Mean) {
        let mut progress = locked(&self.progress);
        if progress.tests.len() < MAX_POINTS {
            progress.tests.push((step, mean.psnr));
        }
    }

    /// Records that a checkpoint was written, or why it failed.
    pub(super) fn record_checkpoint(&self, step: u32, trouble: Option<&str>) {
        let mut progress = locked(&self.progress);
        if trouble.is_none() {
            progress.checkpoint = Some(step);
        }
        progress.trouble = trouble.map(str::to_owned);
    }

    pub(super) fn end(&self) {
        locked(&self.progress).state = State::Ended;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(step: u32) -> StepRecord {
        let (loss, rows) = (1.0 / step as f32, step as usize);
        StepRecord {
            step,
            loss,
            l1: 0.0,
            ssim: 0.0,
            depth: None,
            rows,
            seconds: 1.0,
            resident_bytes: None,
        }
    }

    #[test]
    fn commands_are_executed_once_and_a_paused_run_waits() {
        let run_status = RunStatus::default();
        let next = || [(); 3].map(|()| run_status.next_action());
        assert_eq!(run_status.next_action(), Action::Step);
        run_status.command(Command::Pause);
        assert_eq!(next(), [Action::Wait; 3]);
        run_status.command(Command::Step);
        run_status.command(Command::Step);
        assert_eq!(next(), [Action::Step, Action::Step, Action::Wait]);
        run_status.command(Command::Checkpoint);
        assert_eq!(next(), [Action::Checkpoint, Action::Wait, Action::Wait]);
        run_status.command(Command::Step);
        run_status.command(Command::Continue);
        assert_eq!(next(), [Action::Step; 3]);
        run_status.command(Command::Stop);
        assert!(run_status.next_action() == Action::Stop && run_status.is_stopped());
        assert!(run_status.json().contains("\"stopping\""));
    }

    #[test]
    fn curves_cover_a_long_run_within_the_planned_memory() {
        let run_status = RunStatus::default();
        run_status.begin(0, 1_000_000, 9, 9);
        for step in 1..=100_000 {
            run_status.record(&record(10 * step));
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
        (0..1000).for_each(|step| run_status.record_edit(&event(step)));
        (0..1000).for_each(|step| {
            run_status.record_test(
                step,
                &Mean { psnr: 1.0 / 3.0, ssim: 0.0, flip: 0.0, lpips: None, fitted: None },
            );
        });
        let text = run_status.json();
        let progress: serde_json::Value = serde_json::from_str(&text).unwrap();
        let points = progress["points"].as_array().unwrap();
        assert!((256..=512).contains(&points.len()), "{}", points.len());
        assert_eq!(points[0]["step"], 10);
        let steps: Vec<u64> = points.iter().map(|point| point["step"].as_u64().unwrap()).collect();
        let gap = steps[1] - steps[0];
        assert!(steps.windows(2).all(|pair| pair[1] - pair[0] == gap), "{steps:?}");
        assert!(*steps.last().unwrap() > 990_000, "{steps:?}");
        assert_eq!(progress["edits"].as_array().unwrap().len(), MAX_EDITS);
        assert_eq!(progress["edits"][99]["step"], 999);
        assert!(2 * text.len() as u64 <= BYTES, "{}", text.len());
    }
}
