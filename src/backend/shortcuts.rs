//! Where a backend computes less than it could, for speed: the knobs of `densify knobs` that are a
//! backend's.

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[expect(clippy::float_cmp, reason = "the constant that results are the same with, to the bit")]
    fn the_default_reaches_as_far_as_ever() {
        assert_eq!(Shortcuts::default().log2_reach(), 7.994_353_4);
        assert_eq!(Shortcuts { alpha_min: 0.25, ..Shortcuts::default() }.log2_reach(), 2.0);
    }
}
