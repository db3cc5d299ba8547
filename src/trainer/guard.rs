//! Calls into a policy. A policy may come from anywhere; if it panics, the run ends with an error that
//! names it, and the model is still there.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};

use densify_policies::policy::PolicyError;

/// What the policy answers. After a panic it is not asked again, so that it does not matter in which
/// state the policy was left; nothing else is changed by its calls but the plan, which is dropped.
///
/// # Errors
/// [`PolicyError::Other`] with what the panic said.
pub(super) fn asked<T>(ask: impl FnOnce() -> T) -> Result<T, PolicyError> {
    catch_unwind(AssertUnwindSafe(ask)).map_err(|panic| {
        PolicyError::Other(format!("it panicked: {}; this is a bug in the policy", said(&*panic)))
    })
}

fn said(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("it did not say why")
}
