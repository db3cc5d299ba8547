//! Whether a backend computes what it should: a renderer in `f64` that shares no arithmetic with the
//! backends, comparisons with tolerances, and the cases where numbers are hardest.
//!
//! Needles, thousands of layers, saturated opacities, images of one pixel, rows that hold anything at
//! all: `densify selftest` holds a user's own machine and driver to the [`cases`], and the tests hold
//! every backend that they find to them. Their numbers are those of the table at the head of
//! `tests/it/extremes.rs`, which says where each of them is tested beside here.

mod cases;
pub mod compare;
mod findings;
pub mod reference;
mod report;
#[cfg(test)]
pub(crate) mod sabotage;
pub mod scenes;
mod subject;
mod trial;
pub mod values;

use std::panic::{AssertUnwindSafe, catch_unwind};

pub use cases::cases;
use densify_render::BackendError;
pub use densify_render::Differentiable;
pub use densify_render::Setup;
pub use findings::{Finding, Tested};
pub use report::{markdown, table};
pub use subject::Subject;
use trial::Trial;

/// Something that must hold on every backend.
#[derive(Debug, Clone, Copy)]
pub struct Case {
    /// Its number.
    pub number: u8,
    /// What is hard about it, in a few words.
    pub what: &'static str,
    run: fn(&mut Trial<'_>) -> Result<(), BackendError>,
}

impl Case {
    /// Tries the case: one finding for each kind of figure, the worst of its kind. With `long`, in
    /// full where that takes minutes.
    #[must_use]
    pub fn run(&self, subject: &Subject, long: bool) -> Vec<Finding> {
        let mut trial = Trial::new(subject, long);
        // A panic is a bug, and the other cases' figures are wanted all the same.
        let done = catch_unwind(AssertUnwindSafe(|| (self.run)(&mut trial)));
        match done {
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
        trial.figure("a", "steps", 0.0, 0.0);
        Err(BackendError::NoAdapter("gone".into()))
    }

    #[test]
    fn panics_and_errors_are_failures() {
        let subject = Subject::NATIVE;
        for (run, findings) in [(panics as fn(&mut Trial<'_>) -> _, 1), (fails, 2)] {
            let found = Case { number: 1, what: "x", run }.run(&subject, false);
            assert_eq!(found.len(), findings);
            assert!(!found.last().unwrap().holds(), "{found:?}");
        }
    }
}
