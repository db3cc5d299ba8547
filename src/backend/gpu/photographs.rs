//! Which photographs stay on the device: the first ones seen, as many as there is room for. The others
//! are uploaded at every step.
//!
//! The choice is never changed: views come in a new random order in each epoch, so that the newest
//! ones would be gone before they are needed again.

use std::collections::HashMap;

/// Where the photographs on the device are.
#[derive(Debug, Default)]
pub(super) struct PhotographPlaces {
    /// By view: place among those kept, size, and the bits that say what it has.
    pub(super) places: HashMap<usize, (u64, [u32; 2], u32)>,
}
