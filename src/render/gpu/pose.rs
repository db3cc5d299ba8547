//! The gradient with respect to the camera's pose: what the kernels of `shaders/project_bwd.wgsl` leave.

use super::GpuBackend;
use crate::BackendError;
use densify_core::pose::{PoseGradient, Twist};

/// Bytes of the sums of a group of rows, or of all rows.
pub(super) const SUMS: u64 = 2 * 16;
/// Rows per group.
pub(super) const GROUP: u64 = 256;

/// The gradient from the sums over all rows.
pub(super) fn gradient(sums: [[f32; 4]; 2]) -> PoseGradient {
    let [[x, y, z, _], [a, b, c, log_focal]] = sums.map(|sums| sums.map(f64::from));
    Twist::from_array([x, y, z, a, b, c, log_focal])
}

impl GpuBackend {
    /// Reads the sums over all rows that a step has left after its last readback.
    pub(super) fn read_pose_sums(&self) -> Result<[[f32; 4]; 2], BackendError> {
        let sums = self.read("pose total", 0, SUMS)?;
        Ok(bytemuck::pod_read_unaligned(bytemuck::cast_slice(&sums)))
    }
}
