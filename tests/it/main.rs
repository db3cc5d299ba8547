//! The integration tests: one binary, so that it links once.
//!
//! `reference` is a second renderer in `f64` that shares no arithmetic with the backends;
//! `oracle` holds both against stored float64 renders; `gradients`, `loss`, `signals` and
//! `extremes` hold the backend against the reference on scenes of their own; `sameness` compares
//! bits; `invariants` keeps the walls of ARCHITECTURE.md standing.

mod compare;
mod extremes;
mod gradients;
mod invariants;
mod loss;
mod oracle;
mod reference;
mod sameness;
mod scenes;
mod signals;
mod source_text;
mod subject;
