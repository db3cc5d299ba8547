//! Allocates the device's buffers at the planned sizes.

use std::collections::HashMap;

use wgpu::{BindingResource, Buffer, BufferBinding, BufferDescriptor};

use super::device::Device;
use super::sizes::{PlannedBuffer, SCRATCH, ScratchRange, Sizes};
use crate::{BackendError, Fit};

/// The buffers, by name.
#[derive(Debug)]
pub(super) struct Buffers {
    named: HashMap<&'static str, Buffer>,
    ranges: Vec<ScratchRange>,
    placeholder: Buffer,
}

impl Buffers {
    /// Allocates all buffers.
    pub(super) fn new(device: &Device, sizes: &Sizes) -> Result<Self, BackendError> {
        let mut planned = sizes.planned();
        check_sizes(device, &planned, sizes)?;
        // Largest first, so that small ones fill the allocator's blocks.
        planned.sort_by_key(|planned| std::cmp::Reverse(planned.bytes));
        let total = planned.iter().map(|p| p.bytes).sum();
        let named = device.guarded("the training buffers", total, |device| {
            planned
                .iter()
                .map(|p| (p.name, create(device, p)))
                .collect::<HashMap<&'static str, Buffer>>()
        })?;
        let placeholder = named["placeholder"].clone();
        Ok(Self { named, ranges: sizes.ranges(), placeholder })
    }

    /// Reallocates the buffers whose size has changed.
    pub(super) fn resize(&mut self, device: &Device, sizes: &Sizes) -> Result<(), BackendError> {
        let planned = sizes.planned();
        check_sizes(device, &planned, sizes)?;
        let mut changed: Vec<_> = planned
            .into_iter()
            .filter(|p| self.named.get(p.name).is_none_or(|b| b.size() != p.bytes))
            .collect();
        changed.sort_by_key(|planned| std::cmp::Reverse(planned.bytes));
        for p in &changed {
            if let Some(old) = self.named.remove(p.name) {
                old.destroy();
            }
        }
        let total = changed.iter().map(|p| p.bytes).sum();
        let new = device.guarded("larger images", total, |device| {
            changed.iter().map(|p| (p.name, create(device, p))).collect::<Vec<_>>()
        })?;
        self.named.extend(new);
        self.ranges = sizes.ranges();
        Ok(())
    }

    /// The buffer of this name. A buffer that does not exist, such as that of a band beyond the model's degree, is
    /// replaced by a few bytes that are never read.
    pub(super) fn get(&self, name: &str) -> &Buffer {
        self.named.get(name).unwrap_or(&self.placeholder)
    }

    /// The buffer that contains a buffer or range of this name, and its first byte there.
    pub(super) fn place(&self, name: &str) -> (&Buffer, u64) {
        match self.range(name) {
            Some(range) => (self.get(SCRATCH), range.at),
            None => (self.get(name), 0),
        }
    }

    /// The buffer or range of this name as a kernel binds it.
    pub(super) fn binding(&self, name: &str) -> BindingResource<'_> {
        let Some(range) = self.range(name) else { return self.get(name).as_entire_binding() };
        let buffer = self.get(SCRATCH);
        let size = std::num::NonZeroU64::new(range.bytes);
        BindingResource::Buffer(BufferBinding { buffer, offset: range.at, size })
    }

    fn range(&self, name: &str) -> Option<&ScratchRange> {
        self.ranges.iter().find(|range| range.name == name)
    }

    /// Current total size of all buffers `[bytes]`.
    pub(super) fn bytes(&self) -> u64 {
        self.named.values().map(Buffer::size).sum()
    }
}

fn create(device: &wgpu::Device, planned: &PlannedBuffer) -> Buffer {
    device.create_buffer(&BufferDescriptor {
        label: Some(planned.name),
        size: planned.bytes,
        usage: planned.usage,
        mapped_at_creation: false,
    })
}

/// Fails if a buffer or range is larger than the device can bind, or the scratch buffer larger than it can allocate: a
/// driver may accept it and fail later.
fn check_sizes(
    device: &Device,
    planned: &[PlannedBuffer],
    sizes: &Sizes,
) -> Result<(), BackendError> {
    // No kernel binds the whole of these two; that of photographs is planned within the device's largest buffer.
    let bound_buffers = planned.iter().filter(|p| !["photographs", SCRATCH].contains(&p.name));
    let bound_buffers = bound_buffers.map(|p| (p.name, p.line, p.bytes));
    let ranges = sizes.ranges().into_iter().map(|range| (range.name, range.line, range.bytes));
    let worst = bound_buffers.chain(ranges).max_by_key(|(.., bytes)| *bytes);
    let scratch = planned.iter().find(|p| p.name == SCRATCH).map(|p| (p.name, p.line, p.bytes));
    let limits = [(worst, device.largest_binding()), (scratch, device.summary.largest_buffer)];
    let too_large = limits.into_iter().find_map(|(buffer, most)| {
        buffer.filter(|(.., bytes)| *bytes > most).map(|buffer| (buffer, most))
    });
    let Some(((name, buffer, bytes), most)) = too_large else {
        return Ok(());
    };
    let fit = match name {
        "records" | "list" | "keys 0" | "keys 1" | "values" | "row of slot" | "sums" | SCRATCH => {
            Fit::TileCap(most / bytes.div_ceil(sizes.cap).max(1))
        }
        "canvas" | "finish" | "pixel gradient" | "exposed" | "edges" | "derivatives" => {
            Fit::ImageSize
        }
        _ => Fit::Budget(device.summary.largest_budget(sizes.sh_degree)),
    };
    Err(BackendError::BufferTooLarge {
        buffer,
        bytes,
        device: device.summary.name.clone(),
        most,
        fit,
    })
}
