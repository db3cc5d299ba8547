//! Observers of a run: they receive its progress and may ask it to stop.

use std::fmt;

use densify_core::spelling::Spelling;
use densify_data::dataset::Note;
use densify_render::Backend;
use densify_train::evaluate::Mean;
use densify_train::output::StepRecord;
use densify_train::trainer::{EditEvent, RowHistory};

use crate::failure::{Failure, TrainingProblem, notes};

/// A signal that asks a run to end in an orderly way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Interrupt {
    /// Name of the signal, such as SIGINT.
    pub name: &'static str,
    /// Exit code of a process that the signal has ended.
    pub exit_code: u8,
}

/// The observer's decision between two steps: what the run does next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NextAction {
    /// Continue with the next step.
    Step,
    /// Write a checkpoint, then ask again.
    Checkpoint,
}

/// Passes the notes of a dataset to an observer.
pub fn say_notes(observer: &dyn Observer, notes: &[Note]) {
    for note in notes {
        observer.say(format_args!("{}", notes::dataset(observer.spelling(), note)));
    }
}

/// Observes a run. Methods that are not implemented do nothing.
pub trait Observer {
    /// The spelling of options in [lines](Self::say).
    fn spelling(&self) -> Spelling {
        Spelling::Terminal
    }

    /// A line of information for the user.
    fn say(&self, _line: fmt::Arguments<'_>) {}

    /// Lines of detail, such as the table of memory, for users who ask for details.
    fn detail(&self, _lines: fmt::Arguments<'_>) {}

    /// Training begins after `done` steps and continues to step `last`, with at most `budget` rows.
    fn begin(&self, _done: u32, _last: u32, _budget: usize) {}

    /// A step is done.
    fn step(&self, _step: u32, _loss: f32, _rows: usize) {}

    /// A record was added to the log; it covers the steps since the previous record.
    fn recorded(&self, _record: &StepRecord) {}

    /// The rows were edited.
    fn edited(&self, _event: &EditEvent) {}

    /// The test views were measured.
    fn tested(&self, _step: u32, _mean: &Mean) {}

    /// A step of a trial run is done, of which there are two before training: the step and the last one, the loss, the
    /// rows and their budget.
    fn trial_step(&self, _step: [u32; 2], _loss: f32, _rows: [usize; 2]) {}

    /// A checkpoint was written, or could not be written because of `trouble`.
    fn checkpoint_written(&self, _step: u32, _trouble: Option<&str>) {}

    /// Called before every step, so that the model can be rendered while training waits; rendering changes nothing. The
    /// history of rows is known if there is a [companion](crate::Companion).
    fn between_steps(&self, _model: &mut dyn Backend, _rows: Option<&RowHistory>) -> NextAction {
        NextAction::Step
    }

    /// Training has ended or failed.
    fn end(&self) {}

    /// The signal that asks the run to stop, if one was received. Called before every step.
    fn interrupt(&self) -> Option<Interrupt> {
        None
    }
}

/// Fails if a signal asks to stop. For loops that have written nothing yet.
///
/// # Errors
/// When the observer reports a signal; the exit code is that of the signal.
pub fn check_interrupt(observer: &dyn Observer) -> Result<(), Failure> {
    let Some(Interrupt { name, exit_code }) = observer.interrupt() else { return Ok(()) };
    let stopped = TrainingProblem::Stopped { by: name, step: None };
    Err(Failure::with_code(exit_code, stopped))
}

/// Ignores everything.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Observer for Silent {}
