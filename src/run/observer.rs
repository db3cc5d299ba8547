//! Who follows a run: hears what there is to say, sees each step, and may ask it to stop.

use std::fmt;

/// A signal that asks a run to end in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Interrupt {
    /// Its name, such as SIGINT.
    pub name: &'static str,
    /// The exit code of a process that it ends.
    pub exit_code: u8,
}

/// Follows a run. All methods do nothing unless they are implemented.
pub trait Observer {
    /// A line of information.
    fn say(&self, _line: fmt::Arguments<'_>) {}

    /// Training begins after `done` steps and goes to step `last`, with at most `budget` rows.
    fn begin(&self, _done: u32, _last: u32, _budget: usize) {}

    /// A step is done.
    fn step(&self, _step: u32, _loss: f32, _rows: usize) {}

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
