//! SIGINT (Ctrl-C) and SIGTERM: the first asks the run to stop cleanly, the second ends the process at once.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use densify_run::Interrupt;

/// The exit code of a process ended by a signal is the signal's number plus this.
const SIGNAL_EXIT_BASE: i32 = 128;

/// The signals that this process has received; all its runs share them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Interrupts {
    /// Number of the last signal, or 0.
    last: &'static Arc<AtomicUsize>,
}

impl Interrupts {
    /// Starts to handle signals.
    pub(super) fn listen() -> Self {
        static LAST: OnceLock<Arc<AtomicUsize>> = OnceLock::new();
        Self { last: LAST.get_or_init(register) }
    }

    /// The last signal, if there was one.
    pub(super) fn received(self) -> Option<Interrupt> {
        let last = i32::try_from(self.last.load(Ordering::SeqCst)).unwrap_or_default();
        let name = match last {
            SIGINT => "SIGINT",
            SIGTERM => "SIGTERM",
            _ => return None,
        };
        let exit_code = u8::try_from(SIGNAL_EXIT_BASE + last).unwrap_or(u8::MAX);
        Some(Interrupt { name, exit_code })
    }
}

fn register() -> Arc<AtomicUsize> {
    let last = Arc::new(AtomicUsize::new(0));
    let was_interrupted = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // Registered in this order, so that the first signal finds `was_interrupted` unset. If registration fails, a
        // signal ends the process as it does by default.
        let exit_code = SIGNAL_EXIT_BASE + signal;
        let _ = flag::register_conditional_shutdown(signal, exit_code, was_interrupted.clone());
        let _ = flag::register_usize(signal, last.clone(), signal.unsigned_abs() as usize);
        let _ = flag::register(signal, was_interrupted.clone());
    }
    last
}
