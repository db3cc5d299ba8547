//! PLY files as tables of numbers: elements with rows, whose columns are properties.
//!
//! Accepts ascii, little and big endian, and properties in any order and of any numeric type;
//! unknown properties are skipped. Nothing is allocated from a declared count alone.

mod header;
mod rows;

pub(crate) use header::{Element, Scalar};
pub(crate) use rows::Ply;
