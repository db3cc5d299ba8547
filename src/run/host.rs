//! What the caller of a run provides.

use crate::companion::Companion;
use crate::observer::{Observer, Silent};
use crate::process::ProcessMemory;

/// What a run is given besides its description.
#[derive(Clone, Copy)]
pub struct Host<'a> {
    /// Follows the run.
    pub observer: &'a dyn Observer,
    /// How the process's memory is measured.
    pub process: ProcessMemory,
    /// The part of the program that stays beside the run while it trains.
    pub companion: Option<Companion>,
}

impl<'a> Host<'a> {
    /// A host that measures the process as the operating system reports it.
    #[must_use]
    pub fn new(observer: &'a dyn Observer) -> Self {
        Self { observer, process: ProcessMemory::SYSTEM, companion: None }
    }
}

impl Default for Host<'static> {
    fn default() -> Self {
        Self::new(&Silent)
    }
}
