//! The logs of a run and its totals so far. Checkpoints contain the totals and the lengths of the logs, so that the
//! records of an interrupted run have no gap.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::time::{Duration, Instant};

use cpu_time::ProcessTime;
use serde::{Deserialize, Serialize};

use crate::observer::Observer;
use crate::process::ProcessMemory;
use densify_core::files::FileError;
use densify_render::StepOutput;
use densify_train::output::{Mean, RecordLog, StepRecord, TensorBoard};
use densify_train::trainer::EditEvent;

/// Sums and scores of the run so far.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Totals {
    window: Window,
    /// Wall time of all steps and of trial runs before them.
    pub(super) wall: Duration,
    /// Processor time of the same, if the system measures it.
    pub(super) cpu: Option<Duration>,
    /// Processor time of the trial runs alone.
    #[serde(default, skip_serializing_if = "Duration::is_zero")]
    cpu_of_trials: Duration,
    /// Wall time by stage.
    pub(super) stages: BTreeMap<String, Duration>,
    /// For each of the last steps, as many as there are training views: true if anything was rendered.
    #[serde(default)]
    pub(super) drawn: VecDeque<bool>,
    /// Scores of the test views, by step.
    pub(super) tested: BTreeMap<u32, Mean>,
    /// Peak resident memory of earlier processes of this run `[bytes]`.
    peak_before: Option<u64>,
}

/// Time that a part of a run took.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spent {
    wall: Duration,
    /// Processor time, if the system measures it.
    cpu: Option<Duration>,
}

impl Spent {
    /// The time since `wall` and `cpu`.
    pub(super) fn since(wall: Instant, cpu: Option<ProcessTime>) -> Self {
        let cpu = cpu.and_then(|start| start.try_elapsed().ok());
        Self { wall: wall.elapsed(), cpu }
    }
}

/// Sums over the steps since the last record.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Window {
    steps: u32,
    loss: f32,
    l1: f32,
    ssim: f32,
    /// Sum of the depth terms, and number of steps with one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    depth: Option<(f32, u32)>,
}

impl Totals {
    /// The totals of a run that begins, after the time that was spent before its first step.
    pub(super) fn after(trials: Option<Spent>) -> Self {
        let mut totals = Self { cpu: Some(Duration::ZERO), ..Self::default() };
        if let Some(trials) = trials {
            totals.add(trials);
            totals.stage("trial runs", trials.wall);
            totals.cpu_of_trials = trials.cpu.unwrap_or_default();
        }
        totals
    }

    /// Processor time of all steps, if the system measures it.
    pub(super) fn cpu_of_steps(&self) -> Option<Duration> {
        self.cpu.map(|cpu| cpu.saturating_sub(self.cpu_of_trials))
    }

    pub(super) fn add(&mut self, spent: Spent) {
        self.wall = self.wall.saturating_add(spent.wall);
        self.cpu = self.cpu.zip(spent.cpu).map(|(sum, cpu)| sum.saturating_add(cpu));
    }

    pub(super) fn stage(&mut self, stage: &str, time: Duration) {
        match self.stages.get_mut(stage) {
            Some(sum) => *sum = sum.saturating_add(time),
            None => _ = self.stages.insert(stage.to_owned(), time),
        }
    }

    /// Adds a step of a run with this many training views.
    pub(super) fn step(&mut self, output: &StepOutput, views: usize) {
        self.drawn.push_back(output.entries > 0);
        while self.drawn.len() > views {
            self.drawn.pop_front();
        }
        let Window { steps, loss, l1, ssim, depth } = &mut self.window;
        *steps = steps.saturating_add(1);
        *loss += output.loss;
        *l1 += output.l1;
        *ssim += output.ssim;
        if let Some(term) = output.depth {
            let (sum, count) = depth.unwrap_or_default();
            *depth = Some((sum + term, count.saturating_add(1)));
        }
    }

    /// The means since the last record.
    pub(super) fn record(&mut self, step: u32, rows: usize, resident: Option<u64>) -> StepRecord {
        let Window { steps, loss, l1, ssim, depth } = std::mem::take(&mut self.window);
        let steps = steps as f32;
        StepRecord {
            step,
            loss: loss / steps,
            l1: l1 / steps,
            ssim: ssim / steps,
            depth: depth.map(|(sum, count)| sum / count as f32),
            rows,
            seconds: self.wall.as_secs_f64(),
            resident_bytes: resident,
        }
    }

    /// Peak resident memory of all processes of this run `[bytes]`.
    pub(super) fn peak_bytes(&self, process: ProcessMemory) -> Option<u64> {
        (process.peak)().max(self.peak_before)
    }
}

/// The log files of a run.
pub(super) struct Logs {
    pub(super) steps: RecordLog,
    pub(super) events: RecordLog,
    pub(super) board: TensorBoard,
}

/// Edits and records that are not in the logs yet.
#[derive(Debug, Default)]
pub(super) struct Unwritten {
    pub(super) events: Vec<EditEvent>,
    pub(super) records: Vec<StepRecord>,
}

/// Lengths of the logs at a checkpoint `[bytes]`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Lengths {
    steps: u64,
    events: u64,
    board: (String, u64),
}

/// The state of the session in a checkpoint.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SavedSession {
    pub(super) totals: Totals,
    pub(super) logs: Lengths,
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

    /// Adds edits and records to the logs, and hands them to the observer.
    pub(super) fn write(
        &mut self,
        unwritten: &Unwritten,
        observer: &dyn Observer,
    ) -> Result<(), FileError> {
        for event in &unwritten.events {
            observer.edited(event);
            self.events.append(event)?;
        }
        for record in &unwritten.records {
            observer.recorded(record);
            self.steps.append(record)?;
            let depth = record.depth.map(|depth| ("depth", depth));
            let scalars = [("loss", record.loss), ("rows", record.rows as f32)].into_iter();
            self.board.scalars(record.step, &scalars.chain(depth).collect::<Vec<_>>())?;
        }
        Ok(())
    }

    /// Syncs all records to disk, and returns the state of the session as JSON.
    pub(super) fn save(
        &self,
        totals: &Totals,
        process: ProcessMemory,
    ) -> Result<serde_json::Value, FileError> {
        let lengths = Lengths {
            steps: self.steps.synced()?,
            events: self.events.synced()?,
            board: self.board.synced()?,
        };
        let peak = totals.peak_bytes(process);
        let mut totals = serde_json::to_value(totals).unwrap_or_default();
        totals["peak_before"] = peak.into();
        Ok(serde_json::json!({ "totals": totals, "logs": lengths }))
    }

    /// Reopens the logs at their saved lengths, and returns the names of logs that have lost records since.
    pub(super) fn resume(
        folder: &Path,
        logs: &Lengths,
    ) -> Result<(Self, Vec<&'static str>), FileError> {
        let (steps, steps_whole) = RecordLog::resume(&folder.join(STEPS), logs.steps)?;
        let (events, events_whole) = RecordLog::resume(&folder.join(EVENTS), logs.events)?;
        let board = TensorBoard::resume(folder, &logs.board.0, logs.board.1)?;
        let lost = [(STEPS, steps_whole), (EVENTS, events_whole)];
        let lost = lost.into_iter().filter(|(_, whole)| !whole).map(|(name, _)| name).collect();
        Ok((Self { steps, events, board }, lost))
    }
}
