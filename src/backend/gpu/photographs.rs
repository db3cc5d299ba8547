//! Photographs that stay on the device. A view's is packed and uploaded when it is first seen and
//! copied there from then on, as far as there is room; those beyond are uploaded at every step.
//!
//! Which ones stay is not changed afterwards: views come in a new random order in each epoch, so that
//! to keep the newest instead would keep none of them until its turn comes again.

use std::collections::HashMap;

use super::GpuBackend;
use super::buffers::Sizes;
use super::frame::target::HAS_MASK;
use crate::dataset::images::Image8;

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
    places: HashMap<usize, (u64, [u32; 2], u32)>,
}

impl KeptPhotographs {
    /// Bytes that one takes on the device, where the largest has this size: its pixels, and its mask.
    #[must_use]
    pub fn bytes((width, height): (u32, u32), with_masks: bool) -> [u64; 2] {
        let pixels = u64::from(width) * u64::from(height);
        [4 * pixels, if with_masks { pixels.next_multiple_of(4) } else { 0 }]
    }
}

impl Sizes {
    /// Bytes of each photograph that is kept.
    pub(super) fn photograph_bytes(&self) -> [u64; 2] {
        KeptPhotographs::bytes(self.image, self.photographs.with_masks)
    }
}

impl Kept {
    /// Forgets all of them: their places have moved.
    pub(super) fn clear(&mut self) {
        self.places.clear();
    }
}

impl GpuBackend {
    /// Brings a view's photograph to where the loss reads it; returns the bits that say what it has.
    /// Views keep their photographs.
    pub(super) fn bring_photograph(&mut self, view: usize, image: &Image8) -> u32 {
        let size = [image.width, image.height];
        if let Some(&(place, kept, bits)) = self.kept.places.get(&view)
            && kept == size
        {
            self.copy_photograph(place, size, bits, false);
            return bits;
        }
        let bits = self.upload_target(image);
        let room = self.sizes.photographs;
        // A view whose image has another size now keeps its place.
        let own = self.kept.places.get(&view).map(|&(place, ..)| place);
        let place = own.unwrap_or(self.kept.places.len() as u64);
        if place < room.count as u64 && (bits & HAS_MASK == 0 || room.with_masks) {
            self.copy_photograph(place, size, bits, true);
            self.kept.places.insert(view, (place, size, bits));
        }
        bits
    }

    /// Copies between a place and where the loss reads.
    fn copy_photograph(&self, place: u64, [width, height]: [u32; 2], bits: u32, keeps: bool) {
        let pixels = u64::from(width) * u64::from(height);
        let [truth_bytes, mask_bytes] = self.sizes.photograph_bytes();
        let truth = place * (truth_bytes + mask_bytes);
        let mut parts = vec![("truth", truth, 4 * pixels)];
        if bits & HAS_MASK != 0 {
            parts.push(("mask", truth + truth_bytes, pixels.next_multiple_of(4)));
        }
        let all = self.buffers.get("photographs");
        let mut encoder = self.device.device.create_command_encoder(&Default::default());
        for (name, at, bytes) in parts {
            let one = self.buffers.get(name);
            match keeps {
                true => encoder.copy_buffer_to_buffer(one, 0, all, at, bytes),
                false => encoder.copy_buffer_to_buffer(all, at, one, 0, bytes),
            }
        }
        self.device.queue.submit([encoder.finish()]);
    }
}
