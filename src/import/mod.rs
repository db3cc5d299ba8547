//! Readers of models and points by other programs, one folder per format.

pub mod ply;

use glam::DVec3;

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

    /// Drops the points whose positions fail `keep`; returns how many.
    pub(crate) fn retain(&mut self, keep: impl Fn(DVec3) -> bool) -> usize {
        let before = self.positions.len();
        let mut kept = self.positions.iter().map(|&p| keep(p));
        self.colours.retain(|_| kept.next().unwrap_or(false));
        self.positions.retain(|&p| keep(p));
        before - self.positions.len()
    }
}
