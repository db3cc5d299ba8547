//! Keeps damaged files from causing panics in the crate that decompresses LAZ.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Checks the first bytes of an arithmetic code.
///
/// They are a number below the length of the first interval, `u32::MAX`, and all later steps keep it below the length
/// of the current one. With a larger number, the crate may look beyond the ends of its tables, which is a panic.
pub(super) fn check_start(code: &[u8]) -> io::Result<()> {
    if code.starts_with(&[0xff; 4]) {
        return Err(io::Error::other("it begins with an impossible number"));
    }
    Ok(())
}

/// Calls a function of the crate. Its arithmetic relies on overflow, so it panics on some damaged files where overflow
/// is checked, as in the development profile of programs that use this package.
pub(super) fn without_panic<T>(decode: impl FnOnce() -> io::Result<T>) -> io::Result<T> {
    catch_unwind(AssertUnwindSafe(decode))
        .unwrap_or_else(|_| Err(io::Error::other("the decoder failed")))
}

/// The problem in a message about this error.
pub(super) fn problem(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::UnexpectedEof => "it is cut off".to_owned(),
        _ => error.to_string(),
    }
}
