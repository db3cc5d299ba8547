//! The logs of a run and its totals so far. Both go into checkpoints, so that the records of an interrupted
//! run have no gap.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::time::{Duration, Instant};

use cpu_time::ProcessTime;
use serde::{Deserialize, Serialize};

use densify_core::files::FileError;
use densify_core::memory::{peak_resident, resident};
use densify_render::StepOutput;
use densify_train::output::{Mean, RecordLog, StepRecord, TensorBoard};

/// Sums and scores so far.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Totals {
    window: Window,
    /// Wall time of all steps.
    pub(super) wall: Duration,
    /// Processor time of all steps, where the system says.
    pub(super) cpu: Option<Duration>,
    /// Wall time by stage.
    pub(super) stages: BTreeMap<String, Duration>,
    /// Whether anything was drawn in each of the last steps, one for each training view.
    #[serde(default)]
    pub(super) drawn: VecDeque<bool>,
    /// Scores of the views held out.
    pub(super) tested: BTreeMap<u32, Mean>,
    /// Largest resident memory of the processes before this one.
    peak_before: Option<u64>,
}

/// Sums over the steps since the last record.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Window {
    steps: u32,
    loss: f32,
    l1: f32,
    ssim: f32,
}

impl Totals {
    pub(super) fn new() -> Self {
        Self { cpu: Some(Duration::ZERO), ..Self::default() }
    }

    /// Counts the time since the two.
    pub(super) fn time(&mut self, wall: Instant, cpu: Option<ProcessTime>) {
        self.wall = self.wall.saturating_add(wall.elapsed());
        let spent = cpu.and_then(|start| start.try_elapsed().ok());
        self.cpu = self.cpu.zip(spent).map(|(sum, spent)| sum.saturating_add(spent));
    }

    pub(super) fn stage(&mut self, stage: &str, time: Duration) {
        match self.stages.get_mut(stage) {
            Some(sum) => *sum = sum.saturating_add(time),
            None => _ = self.stages.insert(stage.to_owned(), time),
        }
    }

    /// Counts a step of a run with so many training views.
    pub(super) fn step(&mut self, output: &StepOutput, views: usize) {
        self.drawn.push_back(output.entries > 0);
        while self.drawn.len() > views {
            self.drawn.pop_front();
        }
        let Window { steps, loss, l1, ssim } = &mut self.window;
        *steps = steps.saturating_add(1);
        *loss += output.loss;
        *l1 += output.l1;
        *ssim += output.ssim;
    }

    /// The means since the last record.
    pub(super) fn record(&mut self, step: u32, rows: usize) -> StepRecord {
        let Window { steps, loss, l1, ssim } = std::mem::take(&mut self.window);
        let steps = steps as f32;
        StepRecord {
            step,
            loss: loss / steps,
            l1: l1 / steps,
            ssim: ssim / steps,
            rows,
            seconds: self.wall.as_secs_f64(),
            resident_bytes: resident(),
        }
    }

    /// Largest resident memory of all processes of this run.
    pub(super) fn peak_bytes(&self) -> Option<u64> {
        peak_resident().max(self.peak_before)
    }
}

/// The files that grow along a run.
pub(super) struct Logs {
    pub(super) steps: RecordLog,
    pub(super) events: RecordLog,
    pub(super) board: TensorBoard,
}

/// How long they were when a checkpoint was written `[bytes]`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Lengths {
    steps: u64,
    events: u64,
    board: (String, u64),
}

/// What a checkpoint holds of the session.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SavedSession {
    totals: Totals,
    logs: Lengths,
}

const STEPS: &str = "stats/train.jsonl";
const EVENTS: &str = "stats/events.jsonl";

impl Logs {
    pub(super) fn create(folder: &Path) -> Result<Self, FileError> {
        Ok(Self {
            steps: RecordLog::create(&folder.join(STEPS))?,
            events: RecordLog::create(&folder.join(EVENTS))?,
            board: TensorBoard::create(folder)?,
        })
    }

    /// The session as it is now, as JSON; all that the logs hold is on disk then.
    pub(super) fn keep(&self, totals: &Totals) -> Result<serde_json::Value, FileError> {
        let lengths = Lengths {
            steps: self.steps.synced()?,
            events: self.events.synced()?,
            board: self.board.synced()?,
        };
        let peak = totals.peak_bytes();
        let mut totals = serde_json::to_value(totals).unwrap_or_default();
        totals["peak_before"] = peak.into();
        Ok(serde_json::json!({ "totals": totals, "logs": lengths }))
    }

    /// Goes on with the logs as they were; names those that have lost something meanwhile.
    pub(super) fn resume(
        folder: &Path,
        kept: SavedSession,
    ) -> Result<(Self, Totals, Vec<&'static str>), FileError> {
        let SavedSession { totals, logs } = kept;
        let (steps, steps_whole) = RecordLog::resume(&folder.join(STEPS), logs.steps)?;
        let (events, events_whole) = RecordLog::resume(&folder.join(EVENTS), logs.events)?;
        let board = TensorBoard::resume(folder, &logs.board.0, logs.board.1)?;
        let lost = [(STEPS, steps_whole), (EVENTS, events_whole)];
        let lost = lost.into_iter().filter(|(_, whole)| !whole).map(|(name, _)| name).collect();
        Ok((Self { steps, events, board }, totals, lost))
    }
}
