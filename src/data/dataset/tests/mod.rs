//! Whole datasets: written here, good and bad, and real ones where they are at hand.

mod archives;
mod bad_input;
mod exif;
mod formats;
mod lenses;
mod phones;
mod realitycapture;
mod shared;
