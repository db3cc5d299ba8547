//! Readers of models and points by other programs, one file or folder per format.
//!
//! [`read_model`] recognises a format by its content. What a file says of its own size is never believed: the
//! bytes are there before anything is allocated for them, and what is compressed may unfold so far and no further
//! (`model.rs` says how far).

mod beside;
pub(crate) mod gltf;
mod model;
pub mod ply;
pub(crate) mod sog;
mod splat;
pub(crate) mod spz;
mod turn;
mod unfold;
mod zip;

use glam::DVec3;

pub use model::{SplatFile, read_model};
/// A coloured point cloud in structure of arrays.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Positions. Shape: `[points]`.
    pub positions: Vec<DVec3>,
    /// sRGB colours. Shape: `[points]`.
    pub colours: Vec<[u8; 3]>,
}

impl PointCloud {
    /// Number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there is no point.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// At most so many points, equally spaced in their order.
    #[must_use]
    pub fn thinned(&self, most: usize) -> Self {
        let stride = self.len().div_ceil(most.max(1)).max(1);
        Self {
            positions: self.positions.iter().copied().step_by(stride).collect(),
            colours: self.colours.iter().copied().step_by(stride).collect(),
        }
    }

    /// Drops the points whose positions fail `keep`; returns how many.
    pub(crate) fn retain(&mut self, keep: impl Fn(DVec3) -> bool) -> usize {
        let before = self.positions.len();
        let mut kept = self.positions.iter().map(|&p| keep(p));
        self.colours.retain(|_| kept.next().unwrap_or(false));
        self.positions.retain(|&p| keep(p));
        before - self.positions.len()
    }
}

#[cfg(test)]
mod tests;
