//! Fault injection for tests: everything that a run writes passes through here and can be made to fail. Without a
//! fault, this costs only reads of a thread-local variable.

use std::io::{self, Write};
use std::path::Path;

/// Operations on files and folders.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operation {
    /// Creates a file or folder.
    Create,
    /// Writes to a file.
    Write,
    /// Flushes a buffer.
    Flush,
    /// Syncs a file to the disk.
    Sync,
    /// Renames a complete file.
    Rename,
}

pub use faults::{Fault, attempt, with_fault};

/// A writer whose operations can be made to fail.
pub struct WatchedFile<'a, W> {
    /// The writer.
    pub file: W,
    /// The path of its file, which decides whether the fault applies.
    pub path: &'a Path,
}

impl<W: Write> Write for WatchedFile<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        attempt(Operation::Write, self.path)?;
        let bytes = faults::shortened(bytes);
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        attempt(Operation::Flush, self.path)?;
        self.file.flush()
    }
}

mod faults {
    //! The fault that a test has set, for its own thread.

    use std::cell::RefCell;

    use super::{Operation, Path, io};

    /// A fault: an operation that fails.
    #[derive(Debug, Clone, Copy)]
    pub struct Fault {
        /// The operation.
        pub operation: Operation,
        /// The end of the path of the file it applies to.
        pub file: &'static str,
        /// The number of times that the operation succeeds before it fails.
        pub spared: u32,
        /// The error returned.
        pub kind: io::ErrorKind,
    }

    #[derive(Default)]
    struct Injection {
        fault: Option<Fault>,
        /// Number of times that the fault has occurred.
        count: u32,
        /// True if every write accepts at most one byte.
        short_writes: bool,
    }

    thread_local! {
        static INJECTION: RefCell<Injection> = RefCell::default();
    }

    /// Runs `f` with a fault; with `None`, every write accepts at most one byte instead. Also returns the number of
    /// times that the fault occurred.
    pub fn with_fault<T>(fault: Option<Fault>, f: impl FnOnce() -> T) -> (T, u32) {
        INJECTION.replace(Injection { fault, count: 0, short_writes: fault.is_none() });
        let result = f();
        (result, INJECTION.take().count)
    }

    /// Fails if the fault applies to this operation and path.
    ///
    /// # Errors
    /// The error of the fault.
    pub fn attempt(operation: Operation, path: &Path) -> io::Result<()> {
        INJECTION.with_borrow_mut(|injection| match &mut injection.fault {
            Some(fault)
                if fault.operation == operation
                    && path.to_string_lossy().replace('\\', "/").ends_with(fault.file) =>
            {
                if fault.spared > 0 {
                    fault.spared -= 1;
                    return Ok(());
                }
                injection.count += 1;
                Err(fault.kind.into())
            }
            _ => Ok(()),
        })
    }

    /// The bytes that one call of `write` accepts.
    pub(super) fn shortened(bytes: &[u8]) -> &[u8] {
        let short_writes = INJECTION.with_borrow(|injection| injection.short_writes);
        if short_writes { &bytes[..bytes.len().min(1)] } else { bytes }
    }
}
