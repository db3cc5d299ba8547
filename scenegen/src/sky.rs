//! Light from all around: a gradient between ground and zenith.
//!
//! Its radiance is linear in the sine of elevation. Irradiance then has a closed form, so a scene
//! that asks for no occlusion of the sky needs no secondary ray for it.

use std::f32::consts::PI;

use glam::Vec3;
use serde::{Deserialize, Serialize};

/// The sky.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sky {
    /// Linear radiance straight up.
    pub zenith: [f32; 3],
    /// Linear radiance straight down.
    pub ground: [f32; 3],
    /// Upward direction, unit length.
    pub up: [f32; 3],
}

impl Sky {
    /// The same radiance from everywhere.
    #[must_use]
    pub fn uniform(radiance: f32) -> Self {
        Self { zenith: [radiance; 3], ground: [radiance; 3], up: [0.0, 1.0, 0.0] }
    }

    /// Mean of zenith and ground, and half their difference.
    fn parts(&self) -> (Vec3, Vec3) {
        let (zenith, ground) = (Vec3::from(self.zenith), Vec3::from(self.ground));
        (0.5 * (zenith + ground), 0.5 * (zenith - ground))
    }

    /// Radiance from a direction of unit length.
    pub(crate) fn radiance(&self, direction: Vec3) -> Vec3 {
        let (mean, half) = self.parts();
        mean + half * direction.dot(Vec3::from(self.up))
    }

    /// Irradiance of a surface with this normal: the integral of radiance times cosine over its
    /// hemisphere, pi · (mean + 2/3 · half · n·up).
    pub(crate) fn irradiance(&self, normal: Vec3) -> Vec3 {
        let (mean, half) = self.parts();
        PI * (mean + (2.0 / 3.0) * half * normal.dot(Vec3::from(self.up)))
    }

    /// Mean radiance of a lobe about a direction that is sharp at roughness 0 and a cosine lobe
    /// at 1.
    pub(crate) fn blurred(&self, direction: Vec3, roughness: f32) -> Vec3 {
        let (mean, half) = self.parts();
        let sharpness = 1.0 - roughness * roughness / 3.0;
        mean + half * (sharpness * direction.dot(Vec3::from(self.up)))
    }
}
