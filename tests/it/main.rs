//! The integration tests: one binary, so that it links once.
//!
//! `reference` is a second renderer in `f64` that shares no arithmetic with the backends;
//! `oracle` holds both against stored float64 renders; `gradients` holds the backend against the
//! reference on scenes of its own; `invariants` keeps the walls of ARCHITECTURE.md standing.

mod compare;
mod invariants;
mod oracle;
mod reference;
mod scenes;
mod source_text;
mod subject;
