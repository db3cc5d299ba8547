//! The integration tests, in one binary to link only once.
//!
//! Most tests run on every backend of `subject`: the native one with every instruction set, and every GPU adapter.
//!
//! - Reference: `central` checks the float64 renderer by central differences; `oracle` compares it and the backends
//!   with stored float64 renders; `extremes` runs the selftest, and its head lists the tests of each numerical extreme.
//! - Backends: `agreement` compares them with the native one; `properties` tests arbitrary scenes; `sameness` and
//!   `resuming` compare bit by bit; `exposure`, `vignette`, `poses`, `frozen`, `painted` and `undeclared` test single
//!   features; `gpu` tests
//!   features that only the GPU backend has.
//! - Policies: `edits` applies random plans to a backend and to a plain vector; `spatial` is a policy with spatial rules.
//! - Program: `cli` runs it on a small scene and on scenes with known surfaces; `fuzz` damages input files.
//! - Project: `invariants` enforces the dependency rules of ARCHITECTURE.md; `documents` checks the documents.

mod agreement;
mod antialiasing;
mod aux_views;
mod candidates;
mod central;
mod cli;
mod declared;
mod depth;
mod documents;
mod edits;
mod exposure;
mod extremes;
mod frozen;
mod fuzz;
mod gpu;
mod invariants;
mod oracle;
mod painted;
mod photographs;
mod poses;
mod probes;
mod properties;
mod quarantine;
mod resuming;
mod sameness;
mod shortcuts;
mod signals;
mod spatial;
mod storage;
mod subject;
mod undeclared;
mod vignette;
