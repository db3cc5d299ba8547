//! Environment light: a gradient between ground and zenith, or an image.
//!
//! A gradient's radiance is linear in the sine of the elevation. Its irradiance then has a closed form, so that
//! scenes without occlusion of the sky need no secondary rays.

use std::f32::consts::PI;
use std::sync::Arc;

use glam::Vec3;
use serde::{Serialize, Serializer};

use crate::panorama::Panorama;

/// The sky. It lights the scene but is not visible: pixels without a surface are transparent.
#[derive(Debug, Clone, Serialize)]
#[serde(untagged)]
pub enum Sky {
    /// A gradient between two colours.
    Gradient {
        /// Linear radiance straight up.
        zenith: [f32; 3],
        /// Linear radiance straight down.
        ground: [f32; 3],
        /// Upward direction, unit length.
        up: [f32; 3],
    },
    /// An image.
    Image(#[serde(serialize_with = "serialize_shared")] Arc<Panorama>),
}

/// Serializes a shared panorama.
fn serialize_shared<S: Serializer>(image: &Panorama, to: S) -> Result<S::Ok, S::Error> {
    image.serialize(to)
}

impl Sky {
    /// A sky with equal radiance in all directions.
    pub fn uniform(radiance: f32) -> Self {
        Self::Gradient { zenith: [radiance; 3], ground: [radiance; 3], up: [0.0, 1.0, 0.0] }
    }

    /// Multiplies a gradient's light by a factor; an image is unchanged.
    pub(crate) fn dimmed(self, factor: f32) -> Self {
        match self {
            Self::Gradient { zenith, ground, up } => Self::Gradient {
                zenith: zenith.map(|v| v * factor),
                ground: ground.map(|v| v * factor),
                up,
            },
            Self::Image(image) => Self::Image(image),
        }
    }

    /// Radiance from a direction of unit length.
    pub(crate) fn radiance(&self, direction: Vec3) -> Vec3 {
        match self {
            Self::Gradient { zenith, ground, up } => {
                let (mean, half) = mean_and_half_difference(zenith, ground);
                mean + half * direction.dot(Vec3::from(*up))
            }
            Self::Image(image) => image.radiance(direction),
        }
    }

    /// Irradiance of a surface with this normal: the integral of radiance times cosine over its hemisphere. For
    /// a gradient it is pi · (mean + 2/3 · half · n·up).
    pub(crate) fn irradiance(&self, normal: Vec3) -> Vec3 {
        match self {
            Self::Gradient { zenith, ground, up } => {
                let (mean, half) = mean_and_half_difference(zenith, ground);
                PI * (mean + (2.0 / 3.0) * half * normal.dot(Vec3::from(*up)))
            }
            Self::Image(image) => PI * image.blurred(normal, 1.0),
        }
    }

    /// Mean radiance of a lobe around a direction: sharp at roughness 0, a cosine lobe at 1.
    pub(crate) fn blurred(&self, direction: Vec3, roughness: f32) -> Vec3 {
        match self {
            Self::Gradient { zenith, ground, up } => {
                let (mean, half) = mean_and_half_difference(zenith, ground);
                let sharpness = 1.0 - roughness * roughness / 3.0;
                mean + half * (sharpness * direction.dot(Vec3::from(*up)))
            }
            Self::Image(image) => image.blurred(direction, roughness),
        }
    }
}

/// Mean of zenith and ground, and half their difference.
fn mean_and_half_difference(zenith: &[f32; 3], ground: &[f32; 3]) -> (Vec3, Vec3) {
    let (zenith, ground) = (Vec3::from(*zenith), Vec3::from(*ground));
    (0.5 * (zenith + ground), 0.5 * (zenith - ground))
}
