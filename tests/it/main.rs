//! The integration tests: one binary, so that it links once.
//!
//! `central` checks the float64 renderer of `densify::verify` by central differences, and `oracle` holds
//! it and the backends against stored float64 renders; `extremes` runs the cases of the selftest and says
//! where every extreme is tested; `signals` and
//! `loss` hold the rest against the reference; `properties` are of any scene; `sameness` compares
//! bits; `shortcuts` holds the knobs of the backends
//! to their errors; `declared` and `aux_views` hold the backend to what policies declare; `edits` applies any plan
//! to the backend and to a plain vector; `cli` runs the program on photographs of a small scene;
//! `fuzz` damages files; `gpu` holds the GPU backend against the native one; `geometry` holds policies
//! to surfaces that are known; `invariants` keeps the walls of ARCHITECTURE.md standing.

mod aux_views;
mod central;
mod cli;
mod declared;
mod edits;
mod extremes;
mod fuzz;
mod geometry;
mod gpu;
mod invariants;
mod loss;
mod oracle;
mod photographs;
mod probes;
mod properties;
mod quarantine;
mod sameness;
mod shortcuts;
mod signals;
mod source_text;
mod storage;
mod subject;
