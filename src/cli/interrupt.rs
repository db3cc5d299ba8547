//! SIGINT (Ctrl-C) and SIGTERM: the first asks the run to end in order, a second one ends the
//! process at once.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use densify_run::Interrupt;

/// Offset that shells add to a signal's number for the exit code of a process that the signal ended.
const BY_SIGNAL: i32 = 128;

/// The signals received so far; one value for all runs of a process.
#[derive(Debug, Clone, Copy)]
pub(super) struct Interrupts {
    /// The number of the last signal; 0 if none has come.
    last: &'static Arc<AtomicUsize>,
}

impl Interrupts {
    /// Installs the handlers.
    pub(super) fn listen() -> Self {
        static LAST: OnceLock<Arc<AtomicUsize>> = OnceLock::new();
        Self { last: LAST.get_or_init(register) }
    }

    /// The signal received, if any.
    pub(super) fn received(self) -> Option<Interrupt> {
        let last = i32::try_from(self.last.load(Ordering::SeqCst)).unwrap_or_default();
        let name = match last {
            SIGINT => "SIGINT",
            SIGTERM => "SIGTERM",
            _ => return None,
        };
        Some(Interrupt { name, exit_code: u8::try_from(BY_SIGNAL + last).unwrap_or(u8::MAX) })
    }
}

fn register() -> Arc<AtomicUsize> {
    let (last, any) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(false)));
    for signal in [SIGINT, SIGTERM] {
        // In this order, because the first signal must find nothing set. If a handler cannot be installed, a
        // signal ends the process as it would without it.
        let _ = flag::register_conditional_shutdown(signal, BY_SIGNAL + signal, any.clone());
        let _ = flag::register_usize(signal, last.clone(), signal.unsigned_abs() as usize);
        let _ = flag::register(signal, any.clone());
    }
    last
}
