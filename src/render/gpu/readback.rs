//! Copies from the device to the host, in pieces through one staging buffer of fixed size.

use wgpu::{Buffer, CommandEncoder, MapMode, PollType};

use super::device::Device;
use super::sizes::READ_BYTES;
use crate::BackendError;

/// Copies `bytes` bytes of `buffer` to the host, from byte `from` on.
pub(super) fn read(
    device: &Device,
    staging: &Buffer,
    buffer: &Buffer,
    from: u64,
    bytes: u64,
) -> Result<Vec<u8>, BackendError> {
    let mut all = Vec::with_capacity(usize::try_from(bytes).unwrap_or(0));
    let mut done = 0;
    while done < bytes {
        let length = (bytes - done).min(READ_BYTES);
        let mut encoder = device.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(buffer, from + done, staging, 0, length);
        all.extend_from_slice(&finish(device, staging, encoder, length)?);
        done += length;
    }
    Ok(all)
}

/// Submits the encoded commands, waits, and copies the first `bytes` bytes of `staging`.
pub(super) fn finish(
    device: &Device,
    staging: &Buffer,
    encoder: CommandEncoder,
    bytes: u64,
) -> Result<Vec<u8>, BackendError> {
    device.queue.submit([encoder.finish()]);
    let slice = staging.slice(..bytes);
    // `get_mapped_range` reports failures.
    slice.map_async(MapMode::Read, |_| ());
    device.device.poll(PollType::wait_indefinitely()).map_err(|e| device.failed(e.to_string()))?;
    device.uploads_are_done();
    device.check()?;
    let copied = slice.get_mapped_range().map_err(|e| device.failed(e.to_string()))?.to_vec();
    staging.unmap();
    Ok(copied)
}
