//! The integration tests: one binary, so that it links once.
//!
//! Most run once on each of the backends of `subject`: the native one with every instruction set, and every adapter.
//! `central` checks the float64 renderer of `densify::selftest` by central differences, and `oracle` holds it and the
//! backends against stored float64 renders; `extremes` runs the cases of the selftest and says where every extreme is
//! tested; `exposure` is of photographs that are exposed differently; `agreement` holds every backend to the native
//! one; `properties` are of any scene; `sameness` and `resuming` compare bits; `edits` applies any plan to a backend
//! and to a plain vector; `frozen` is about rows that never change, `painted` about rows drawn in other colours;
//! `undeclared` is about what takes no bytes;
//! `spatial` is a policy that reads and edits where rows are. `cli` runs the program on photographs of a small scene,
//! and holds policies to surfaces that are known; `fuzz` damages files; `gpu` is what only the GPU backend has;
//! `invariants` keeps the walls of ARCHITECTURE.md standing, and `documents` keeps the documents true and short.

mod agreement;
mod aux_views;
mod candidates;
mod central;
mod cli;
mod declared;
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
