//! Numerical checks of a backend: a [mod@reference] renderer in `f64` that shares no arithmetic with the backends,
//! comparisons with tolerances, and the numerically hardest [`cases`].
//!
//! `densify selftest` runs the cases on the user's own machine and driver; the tests run them on every
//! available backend. The table at the head of `tests/it/extremes.rs` has the same case numbers, and lists
//! the other tests of each case.

mod cases;
pub mod compare;
#[cfg(test)]
mod fault_injection;
mod findings;
pub mod reference;
mod report;
pub mod scenes;
mod subject;
mod trial;
pub mod values;

use std::panic::{AssertUnwindSafe, catch_unwind};

pub use cases::cases;
use densify_render::BackendError;
pub use densify_render::{Differentiable, Setup};
pub use findings::{Finding, SubjectReport};
pub use report::{markdown, table};
pub use subject::Subject;
use trial::Trial;

/// A set of checks that every backend must pass.
#[derive(Debug, Clone, Copy)]
pub struct Case {
    /// Number by which the user selects the case.
    pub number: u8,
    /// The numerical difficulty, in a few words.
    pub title: &'static str,
    run: fn(&mut Trial<'_>) -> Result<(), BackendError>,
}

impl Case {
    /// Runs the case and returns the worst finding for each kind of measurement (image, gradient, …). `long`
    /// includes checks that take minutes.
    pub fn run(&self, subject: &Subject, long: bool) -> Vec<Finding> {
        let mut trial = Trial::new(subject, long);
        // A panic is a bug; the figures of the other cases are still needed.
        match catch_unwind(AssertUnwindSafe(|| (self.run)(&mut trial))) {
            Ok(Ok(())) => {}
            Ok(Err(error)) => trial.table.fail(error.to_string()),
            Err(_) => trial.table.fail("a panic, which is a bug".into()),
        }
        findings::worst(self.number, &trial.table)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panics(_: &mut Trial<'_>) -> Result<(), BackendError> {
        panic!("on purpose")
    }

    fn fails(trial: &mut Trial<'_>) -> Result<(), BackendError> {
        trial.record("a", "steps", 0.0, 0.0);
        Err(BackendError::NoAdapter("gone".into()))
    }

    #[test]
    fn panics_and_errors_are_failures() {
        let subject = Subject::NATIVE;
        for (run, findings) in [(panics as fn(&mut Trial<'_>) -> _, 1), (fails, 2)] {
            let reported = Case { number: 1, title: "x", run }.run(&subject, false);
            assert_eq!(reported.len(), findings);
            assert!(!reported.last().unwrap().passes(), "{reported:?}");
        }
    }
}
