//! Times the stages of a step on the device, for benchmarks: a timestamp is written at the beginning of each stage.

use std::time::Duration;

use wgpu::{
    Buffer, BufferDescriptor, BufferUsages, Features, QuerySet, QuerySetDescriptor, QueryType,
    Queue,
};

use super::device::Device;
use super::readback;
use crate::BackendError;

/// Features that timestamps require.
pub(super) const FEATURES: Features =
    Features::TIMESTAMP_QUERY.union(Features::TIMESTAMP_QUERY_INSIDE_PASSES);
/// Largest number of timestamps per submission; later stages are not timed.
const MAX_TIMES: u32 = 512;
const BYTES: u64 = MAX_TIMES as u64 * size_of::<u64>() as u64;

#[derive(Debug)]
pub(super) struct Clock {
    times: QuerySet,
    resolved: Buffer,
    staging: Buffer,
    /// Unit of the timestamps `[ns]`.
    period: f32,
}

impl Clock {
    /// Creates a clock on a device with [`FEATURES`].
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
                count: MAX_TIMES,
            }),
            resolved: buffer(BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC),
            staging: buffer(BufferUsages::MAP_READ | BufferUsages::COPY_DST),
            period: queue.get_timestamp_period(),
        }
    }

    /// Duration of each stage of the last submission, in order. Stages of the same name are added up.
    pub(super) fn stage_times(
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
        let mut times_by_stage: Vec<(&'static str, Duration)> = Vec::new();
        for (name, ends) in stages.iter().zip(times.windows(2)) {
            let units = ends[1].saturating_sub(ends[0]) as f64;
            let time = Duration::from_nanos((units * f64::from(self.period)) as u64);
            match times_by_stage.iter_mut().find(|(known, _)| known == name) {
                Some((_, sum)) => *sum += time,
                None => times_by_stage.push((name, time)),
            }
        }
        Ok(times_by_stage)
    }
}

/// The stages of a submission while it is encoded.
#[derive(Debug, Default)]
pub(super) struct Stages<'c> {
    pub(super) clock: Option<&'c Clock>,
    /// Names in order; the end has an empty name.
    pub(super) names: Vec<&'static str>,
}

impl Stages<'_> {
    /// Begins a stage.
    pub(super) fn begin(&mut self, pass: &mut wgpu::ComputePass<'_>, name: &'static str) {
        let Some(clock) = self.clock else { return };
        let number = self.names.len() as u32;
        if number < MAX_TIMES {
            pass.write_timestamp(&clock.times, number);
            self.names.push(name);
        }
    }
}
