//! Which photographs stay on the device. A view's is packed and uploaded when it is first seen and
//! copied there from then on, as far as there is room; those beyond are uploaded at every step.
//!
//! Which ones stay is not changed afterwards: views come in a new random order in each epoch, so that
//! to keep the newest instead would keep none of them until its turn comes again.

use std::collections::HashMap;

/// Photographs that may stay on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KeptPhotographs {
    /// How many.
    pub count: usize,
    /// Whether any of them has a mask.
    pub with_masks: bool,
}

/// What stays where.
#[derive(Debug, Default)]
pub(super) struct Kept {
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
