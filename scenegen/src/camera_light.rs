//! What cameras do to the light of training views: gains of the channels, and a vignette.
//!
//! The vignette is the cos⁴ law of a simple lens, 1/(1 + q·d²)², where d is the distance from the picture's middle,
//! 1 at its corners. It is no polynomial, so that it also tests trainers whose vignettes are polynomials.

use glam::{DVec2, Vec3};

use crate::error::Error;

/// Factors on the linear light of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CameraLight {
    /// Factors on the channels.
    pub(crate) gains: [f32; 3],
    /// Share of the light that is lost at the picture's corners, in `[0, 1)`.
    pub(crate) vignette: f32,
}

impl CameraLight {
    /// The factors at a position in a picture of this size `[px]`.
    pub(crate) fn at(&self, position: DVec2, size: [u32; 2]) -> Vec3 {
        let half = 0.5 * DVec2::from(size.map(f64::from));
        let squared = (position - half).length_squared() / half.length_squared();
        let q = (1.0 - f64::from(self.vignette)).powf(-0.5) - 1.0;
        Vec3::from(self.gains) * (1.0 + q * squared).powi(-2) as f32
    }
}

/// Fails if the strength of a vignette is out of range.
pub(crate) fn check_vignette(strength: f32) -> Result<(), Error> {
    /// At the corners at least a hundredth of the light remains.
    const STRONGEST: f32 = 0.99;
    if (0.0..=STRONGEST).contains(&strength) {
        return Ok(());
    }
    let problem = format!(
        "{strength} is not between 0 and {STRONGEST}, the share of the light that corners lose"
    );
    Err(Error::option("--vignette", problem))
}
