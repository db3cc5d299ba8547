//! Stored float64 renders and gradients of small scenes, and what is held against them.
//!
//! The data is not part of the project; where it is absent these tests say so and pass.

mod backend;
pub(crate) mod case;
mod reference;
