//! Readers of models and points by other programs, one folder per format.

pub mod ply;
