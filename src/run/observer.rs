//! Who follows a run: hears what there is to say, sees each step, and may ask it to stop.

use std::fmt;

use densify_render::Backend;
use densify_train::evaluate::Mean;
use densify_train::output::StepRecord;
use densify_train::trainer::{EditEvent, RowHistory};

/// A signal that asks a run to end in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Interrupt {
    /// Its name, such as SIGINT.
    pub name: &'static str,
    /// The exit code of a process that it ends.
    pub exit_code: u8,
}

/// What a run does where an observer has looked at its model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Between {
    /// The next step.
    Step,
    /// It writes a checkpoint, and asks again.
    Checkpoint,
}

/// Follows a run. All methods do nothing unless they are implemented.
pub trait Observer {
    /// A line of information.
    fn say(&self, _line: fmt::Arguments<'_>) {}

    /// Training begins after `done` steps and goes to step `last`, with at most `budget` rows.
    fn begin(&self, _done: u32, _last: u32, _budget: usize) {}

    /// A step is done.
    fn step(&self, _step: u32, _loss: f32, _rows: usize) {}

    /// A record of the log, over the steps since the one before.
    fn recorded(&self, _record: &StepRecord) {}

    /// The rows were edited.
    fn edited(&self, _event: &EditEvent) {}

    /// The test views were measured.
    fn tested(&self, _step: u32, _mean: &Mean) {}

    /// A checkpoint was written, or this is why it could not be.
    fn kept(&self, _step: u32, _trouble: Option<&str>) {}

    /// Before every step the model may be looked at: what is rendered here changes nothing. Training waits. When rows
    /// were made and edited is known where there is a [companion](super::Companion).
    fn between(&self, _model: &mut dyn Backend, _rows: Option<&RowHistory>) -> Between {
        Between::Step
    }

    /// Training has ended, or failed.
    fn end(&self) {}

    /// What asks the run to stop, if anything does. It is asked for before every step.
    fn interrupt(&self) -> Option<Interrupt> {
        None
    }
}

/// Follows nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Observer for Silent {}
