//! Whole datasets: written here, good and bad, and real ones where they are at hand.

mod bad_input;
mod formats;
mod lenses;
mod shared;
pub(crate) mod write;
pub(crate) use shared::shared;
