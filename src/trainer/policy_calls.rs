//! Calls into a policy, with panics turned into errors.
//!
//! A policy may come from anywhere. If it panics, the run ends with an error that names it, and the model
//! can still be read.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};

use densify_policies::policy::PolicyError;

/// The result of `call`. After a panic the policy is not called again, so its state does not matter; its
/// calls change nothing else but the plan, which is dropped.
///
/// # Errors
/// [`PolicyError::Other`] with the message of the panic.
pub(super) fn call_policy<T>(call: impl FnOnce() -> T) -> Result<T, PolicyError> {
    catch_unwind(AssertUnwindSafe(call)).map_err(|panic| {
        let message = panic_message(&*panic);
        PolicyError::Other(format!("it panicked: {message}; this is a bug in the policy"))
    })
}

fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message")
}
