//! The knobs of `densify knobs` that make a backend compute less, for speed.

/// Where a backend computes less than it could. The default is the renderer as published, and what
/// every other renderer of Gaussian splats does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shortcuts {
    /// Alpha below this is not blended; above 0.
    pub alpha_min: f32,
    /// A pixel stops before its transmittance reaches this; above 0.
    pub transmittance_min: f32,
}

impl Default for Shortcuts {
    fn default() -> Self {
        Self { alpha_min: 1.0 / 255.0, transmittance_min: 1e-4 }
    }
}

impl Shortcuts {
    /// log₂ of 1/[`alpha_min`](Self::alpha_min): a splat reaches as far as its exponent stays above
    /// minus this.
    #[must_use]
    pub fn log2_reach(&self) -> f32 {
        -f64::from(self.alpha_min).log2() as f32
    }
}
