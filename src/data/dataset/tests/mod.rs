//! Tests of whole datasets: generated good and bad ones, and real ones if available.

mod archives;
mod bad_input;
mod exif;
mod formats;
mod lenses;
mod phones;
mod realitycapture;
mod shared;
