//! Which photographs stay on the device: the first ones seen, as many as there is room for. The others
//! are uploaded at every step.
//!
//! The choice is never changed: views come in a new random order in each epoch, so that the newest
//! ones would be gone before they are needed again.

use std::collections::HashMap;

/// Photographs that may stay on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KeptPhotographs {
    /// How many.
    pub count: usize,
    /// Whether any of them has a mask.
    pub with_masks: bool,
}

/// Where the photographs on the device are.
#[derive(Debug, Default)]
pub(super) struct PhotographPlaces {
    /// By view: place among those kept, size, and the bits that say what it has.
    pub(super) places: HashMap<usize, (u64, [u32; 2], u32)>,
}

impl KeptPhotographs {
    /// Bytes that one takes on the device, where the largest has this size: its pixels, and its mask.
    #[must_use]
    pub fn bytes((width, height): (u32, u32), with_masks: bool) -> [u64; 2] {
        let pixels = u64::from(width) * u64::from(height);
        [4 * pixels, if with_masks { pixels.next_multiple_of(4) } else { 0 }]
    }
}
