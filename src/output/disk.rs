//! Operations on the disk that can fail. Everything a run writes passes here, so that tests can make
//! each of them fail; outside of tests nothing is added.

use std::io::{self, Write};
use std::path::Path;

/// What is done to a file or folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Operation {
    /// A file or a folder is made.
    Create,
    /// Bytes are handed to the system.
    Write,
    /// Buffered bytes are handed to the system.
    Flush,
    /// Bytes are brought to the disk.
    Sync,
    /// A complete file takes its name.
    Rename,
}

/// Fails where a test wants it to.
///
/// # Errors
/// What the test wants.
#[cfg(not(test))]
pub(super) fn attempt(_: Operation, _: &Path) -> io::Result<()> {
    Ok(())
}

#[cfg(test)]
pub(super) use faults::attempt;
#[cfg(test)]
pub(crate) use faults::{Fault, with_fault};

/// A file with its name.
pub(super) struct Named<'a, W> {
    pub(super) file: W,
    pub(super) path: &'a Path,
}

impl<W: Write> Write for Named<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        attempt(Operation::Write, self.path)?;
        #[cfg(test)]
        let bytes = faults::shortened(bytes);
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        attempt(Operation::Flush, self.path)?;
        self.file.flush()
    }
}

#[cfg(test)]
mod faults {
    //! Faults on demand, for the thread that asks for them.

    use std::cell::RefCell;

    use super::{Operation, Path, io};

    /// What is to fail.
    #[derive(Debug, Clone, Copy)]
    pub(crate) struct Fault {
        pub(crate) operation: Operation,
        /// In files and folders whose path ends so.
        pub(crate) file: &'static str,
        /// So many times it still works.
        pub(crate) spared: u32,
        pub(crate) kind: io::ErrorKind,
    }

    #[derive(Default)]
    struct Plan {
        fault: Option<Fault>,
        met: u32,
        /// Whether every write takes one byte at most.
        short: bool,
    }

    thread_local! {
        static PLAN: RefCell<Plan> = RefCell::default();
    }

    /// Runs `f` with a fault from its turn on, or, without one, with short writes. Returns how often
    /// the fault was met, too.
    pub(crate) fn with_fault<T>(fault: Option<Fault>, f: impl FnOnce() -> T) -> (T, u32) {
        PLAN.replace(Plan { fault, met: 0, short: fault.is_none() });
        let done = f();
        (done, PLAN.take().met)
    }

    pub(crate) fn attempt(operation: Operation, path: &Path) -> io::Result<()> {
        PLAN.with_borrow_mut(|plan| match &mut plan.fault {
            Some(fault)
                if fault.operation == operation
                    && path.to_string_lossy().replace('\\', "/").ends_with(fault.file) =>
            {
                if fault.spared > 0 {
                    fault.spared -= 1;
                    return Ok(());
                }
                plan.met += 1;
                Err(fault.kind.into())
            }
            _ => Ok(()),
        })
    }

    pub(super) fn shortened(bytes: &[u8]) -> &[u8] {
        let short = PLAN.with_borrow(|plan| plan.short);
        if short { &bytes[..bytes.len().min(1)] } else { bytes }
    }
}
