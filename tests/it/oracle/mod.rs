//! Stored float64 renders and gradients of small scenes, and what is held against them.

mod backend;
pub(crate) mod case;
mod reference;
