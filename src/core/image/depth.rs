//! Depth given beside a photograph: by a sensor, a reconstruction, a point cloud or a renderer.

use std::sync::Arc;

/// The given depth of a view, as inverse depth with a confidence per pixel: 3 bytes per pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthMap {
    /// Width `[px]`.
    pub width: u32,
    /// Height `[px]`.
    pub height: u32,
    /// Inverse camera-space depth 1/z in multiples of `unit`; 0 where it is unknown. Shape: `[height, width]`.
    pub inverse: Vec<u16>,
    /// Weight of each pixel in the loss: 0 ignores it, 255 counts it in full; 0 where the depth is unknown.
    /// Shape: `[height, width]`.
    pub confidence: Vec<u8>,
    /// Inverse depth of one step of `inverse` `[1/scene units]`.
    pub unit: f32,
    /// Median depth of the known pixels, which makes the loss independent of the scene's unit `[scene units]`.
    pub median: f32,
}

/// A depth map shared between a cache and its users.
pub type SharedDepth = Arc<DepthMap>;

impl DepthMap {
    /// The inverse depth of a pixel `[1/scene units]` with its confidence in `[0, 1]`; 0 and 0 where it is unknown.
    pub fn inverse_depth(&self, pixel: usize) -> [f32; 2] {
        let confidence = if self.inverse[pixel] == 0 { 0 } else { self.confidence[pixel] };
        [f32::from(self.inverse[pixel]) * self.unit, f32::from(confidence) / 255.0]
    }

    /// Sum of the confidences of all pixels with a known depth.
    pub fn total_confidence(&self) -> f32 {
        let known = self.inverse.iter().zip(&self.confidence).filter(|&(&inverse, _)| inverse > 0);
        known.map(|(_, &confidence)| u64::from(confidence)).sum::<u64>() as f32 / 255.0
    }

    /// Size of the pixels `[bytes]`.
    pub fn bytes(&self) -> u64 {
        (2 * self.inverse.len() + self.confidence.len()) as u64
    }
}
