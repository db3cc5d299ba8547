//! Failures as Python exceptions. Their classes are declared in Python (`densify/_errors.py`), as a class made here
//! could have only one base.

use std::cell::RefCell;

use densify_core::spelling::Spelling;
use densify_run::failure::{DEVICE, Failure, INPUT};
use pyo3::exceptions::{PyKeyboardInterrupt, PyRuntimeError};
use pyo3::import_exception;
use pyo3::prelude::*;
use pyo3::types::PyTraceback;

import_exception!(densify._errors, DensifyError);
import_exception!(densify._errors, DeviceError);
import_exception!(densify._errors, InputError);
import_exception!(densify._errors, Interrupted);
import_exception!(densify._errors, PolicyError);
import_exception!(densify._errors, Undeclared);

/// Exit codes of processes that SIGINT and SIGTERM have ended.
const SIGNALS: [u8; 2] = [130, 143];

thread_local! {
    /// The last exception of a policy, and the text that stands for it in messages. Policies are called on the thread
    /// that trains, which is the thread that raises the failure.
    static CAUSE: RefCell<Option<(String, PyErr)>> = const { RefCell::new(None) };
}

/// Keeps an exception of a policy for [`raise`]; returns its text, with file and line.
pub(crate) fn keep(py: Python<'_>, error: PyErr) -> String {
    let text = describe(py, &error);
    CAUSE.with_borrow_mut(|cause| *cause = Some((text.clone(), error)));
    text
}

/// An exception as text: its message, and the line of the policy that raised it.
fn describe(py: Python<'_>, error: &PyErr) -> String {
    match error.traceback(py).and_then(|trace| place(&trace).ok().flatten()) {
        Some(place) => format!("{error} ({place})"),
        None => error.to_string(),
    }
}

/// File and line of the innermost frame outside this package.
fn place(trace: &Bound<'_, PyTraceback>) -> PyResult<Option<String>> {
    let mut found = None;
    let mut next = Some(trace.clone().into_any());
    while let Some(frame) = next {
        let code = frame.getattr("tb_frame")?.getattr("f_code")?;
        let file: String = code.getattr("co_filename")?.extract()?;
        let file_name = std::path::Path::new(&file).file_name().unwrap_or_default();
        if file_name != "_policy.py" && file_name != "_edits.py" {
            let line: u32 = frame.getattr("tb_lineno")?.extract()?;
            found = Some(format!("{file}:{line}"));
        }
        next = Some(frame.getattr("tb_next")?).filter(|next| !next.is_none());
    }
    Ok(found)
}

/// Raises a failure. If a policy's exception has caused it, that exception is its `__cause__`.
pub(crate) fn raise(py: Python<'_>, failure: &Failure) -> PyErr {
    let words = failure.words(Spelling::Keyword);
    let cause = CAUSE.take().filter(|(text, _)| words.contains(text.as_str()));
    let cause = cause.map(|(_, error)| error);
    // A second Ctrl-C within a policy.
    if let Some(error) = &cause
        && error.is_instance_of::<PyKeyboardInterrupt>(py)
    {
        return error.clone_ref(py);
    }
    let raised = match failure.code {
        INPUT => InputError::new_err(words),
        DEVICE => DeviceError::new_err(words),
        code if SIGNALS.contains(&code) => Interrupted::new_err(words),
        _ if cause.is_some() => PolicyError::new_err(words),
        _ => DensifyError::new_err(words),
    };
    raised.set_cause(py, cause);
    raised
}

/// Does work without holding the interpreter, so that other Python threads continue.
pub(crate) fn detached<T: Send>(
    py: Python<'_>,
    work: impl FnOnce() -> Result<T, Failure> + Send,
) -> PyResult<T> {
    CAUSE.take();
    py.detach(work).map_err(|failure| raise(py, &failure))
}

/// Raises an exception for an object that another thread uses.
pub(crate) fn in_use(what: &str) -> PyErr {
    PyRuntimeError::new_err(format!("{what} is in use by another thread"))
}
