//! How long the stages of a step take on the device, for benchmarks: it writes the time at the beginning of each.

use std::time::Duration;

use wgpu::{
    Buffer, BufferDescriptor, BufferUsages, Features, QuerySet, QuerySetDescriptor, QueryType,
    Queue,
};

use super::device::Device;
use super::readback;
use crate::BackendError;

/// What it needs.
pub(super) const FEATURES: Features =
    Features::TIMESTAMP_QUERY.union(Features::TIMESTAMP_QUERY_INSIDE_PASSES);
/// Most times of one submission; what comes later is not told apart.
const MOST: u32 = 512;
const BYTES: u64 = MOST as u64 * size_of::<u64>() as u64;

#[derive(Debug)]
pub(super) struct Clock {
    times: QuerySet,
    resolved: Buffer,
    staging: Buffer,
    /// Of a unit of time `[ns]`.
    period: f32,
}

impl Clock {
    /// A clock of a device with [`FEATURES`].
    pub(super) fn new(device: &wgpu::Device, queue: &Queue) -> Self {
        let buffer = |usage| {
            let descriptor =
                BufferDescriptor { label: None, size: BYTES, usage, mapped_at_creation: false };
            device.create_buffer(&descriptor)
        };
        Self {
            times: device.create_query_set(&QuerySetDescriptor {
                label: None,
                ty: QueryType::Timestamp,
                count: MOST,
            }),
            resolved: buffer(BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC),
            staging: buffer(BufferUsages::MAP_READ | BufferUsages::COPY_DST),
            period: queue.get_timestamp_period(),
        }
    }

    /// The time of each of these stages of what was submitted last, in order; those of one name are one.
    pub(super) fn laps(
        &self,
        device: &Device,
        stages: &[&'static str],
    ) -> Result<Vec<(&'static str, Duration)>, BackendError> {
        let count = stages.len() as u32;
        let bytes = u64::from(count) * size_of::<u64>() as u64;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        encoder.resolve_query_set(&self.times, 0..count, &self.resolved, 0);
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.staging, 0, bytes);
        let read = readback::finish(device, &self.staging, encoder, bytes)?;
        let times: Vec<u64> = read.chunks_exact(8).map(bytemuck::pod_read_unaligned).collect();
        let mut laps: Vec<(&'static str, Duration)> = Vec::new();
        for (name, ends) in stages.iter().zip(times.windows(2)) {
            let units = ends[1].saturating_sub(ends[0]) as f64;
            let time = Duration::from_nanos((units * f64::from(self.period)) as u64);
            match laps.iter_mut().find(|(known, _)| known == name) {
                Some((_, sum)) => *sum += time,
                None => laps.push((name, time)),
            }
        }
        Ok(laps)
    }
}

/// The stages of a submission as it is encoded.
#[derive(Debug, Default)]
pub(super) struct Stages<'c> {
    pub(super) clock: Option<&'c Clock>,
    /// As they began, and the end, which has no name.
    pub(super) names: Vec<&'static str>,
}

impl Stages<'_> {
    /// Begins a stage.
    pub(super) fn begin(&mut self, pass: &mut wgpu::ComputePass<'_>, name: &'static str) {
        let Some(clock) = self.clock else { return };
        let number = self.names.len() as u32;
        if number < MOST {
            pass.write_timestamp(&clock.times, number);
            self.names.push(name);
        }
    }
}
