//! Services that the caller of a run provides: an observer, a way to measure the process's memory, and a companion.

use crate::companion::Companion;
use crate::observer::{Observer, Silent};
use crate::process::ProcessMemory;

/// The services that the caller of a run provides.
#[derive(Clone, Copy)]
pub struct Host<'a> {
    /// Receives all messages and progress, and may stop the run.
    pub observer: &'a dyn Observer,
    /// Measures the memory of the process.
    pub process: ProcessMemory,
    /// The part of the program that works alongside the run.
    pub companion: Option<Companion>,
}

impl<'a> Host<'a> {
    /// A host that measures the memory of the process as the operating system reports it.
    pub fn new(observer: &'a dyn Observer) -> Self {
        Self { observer, process: ProcessMemory::SYSTEM, companion: None }
    }
}

impl Default for Host<'static> {
    fn default() -> Self {
        Self::new(&Silent)
    }
}
