//! Scene normalisation, in f64: far-off or tiny scenes lose nothing to f32.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// scene = (world − centre) · scale.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Normalisation {
    /// World point that becomes the origin.
    pub centre: DVec3,
    /// Scene units per world unit, > 0.
    pub scale: f64,
}
