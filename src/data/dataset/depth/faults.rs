//! Faults of depth maps that are met in training, when they cost only the depth of a view.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

use super::super::LoadError;

/// Faults, each of them once.
#[derive(Debug, Default)]
pub(super) struct Faults(Mutex<Met>);

#[derive(Debug, Default)]
struct Met {
    new: Vec<LoadError>,
    /// The messages of all faults.
    all: BTreeSet<String>,
}

impl Faults {
    /// Adds a fault, unless it is known.
    pub(super) fn add(&self, fault: LoadError) {
        let mut met = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if met.all.insert(fault.to_string()) {
            met.new.push(fault);
        }
    }

    /// The faults added since the last call.
    pub(super) fn take(&self) -> Vec<LoadError> {
        std::mem::take(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner).new)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_fault_is_returned_once() {
        let faults = Faults::default();
        for name in ["a", "b", "a"] {
            faults.add(LoadError::Data(name.to_owned()));
        }
        let names: Vec<String> = faults.take().iter().map(ToString::to_string).collect();
        assert_eq!(names, ["a", "b"]);
        faults.add(LoadError::Data("b".to_owned()));
        assert_eq!(faults.take(), []);
    }
}
