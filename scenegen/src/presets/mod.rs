//! The built-in scenes: exact geometry without external data.
//!
//! Each scene's file documents its geometry. Lengths are in metres; +y is up.

mod chirp;
mod cornell;
mod glossy;
mod layers;
mod room;
mod spec;
mod spheres;
mod table;
mod thin;
mod town;

use glam::{DVec3, Vec3};
pub use spec::PresetSpec;

use crate::mesh::{Light, LightKind, Model};
use crate::rig::Rig;
use crate::shade::Ambient;
use crate::sky::Sky;

/// A built-in scene.
#[derive(Debug, Clone, Copy)]
pub struct Preset {
    /// Name on the command line.
    pub name: &'static str,
    /// One-line description for lists.
    pub summary: &'static str,
    pub(crate) build: Build,
}

/// The function that builds a preset.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Build {
    /// Always builds the same scene.
    Fixed(fn() -> Staging),
    /// Builds a scene of a given size, which also depends on the seed.
    Sized {
        /// Default size.
        default: u32,
        /// Largest size; the smallest is 1.
        largest: u32,
        build: fn(size: u32, seed: u64) -> Staging,
    },
}

/// Geometry, light and camera arrangement of a preset or file.
pub(crate) struct Staging {
    pub(crate) model: Model,
    pub(crate) sky: Sky,
    pub(crate) rig: Rig,
    pub(crate) ambient: Ambient,
}

/// All built-in scenes.
pub const PRESETS: [Preset; 9] = [
    spheres::PRESET,
    thin::PRESET,
    chirp::PRESET,
    table::PRESET,
    layers::PRESET,
    room::PRESET,
    glossy::PRESET,
    cornell::PRESET,
    town::PRESET,
];

impl Staging {
    /// A scene lit by the sun and an open sky, with the default rig.
    fn outdoors(model: Model) -> Self {
        let mut model = model;
        model.lights.push(sun());
        Self { model, sky: open_sky(), rig: Rig::default(), ambient: Ambient::Open }
    }
}

/// Parallel light from the upper front right. Together with the open sky, white surfaces reflect at most 1.
pub(crate) fn sun() -> Light {
    let direction = -DVec3::new(0.5, 0.8, 0.6).normalize();
    let intensity = Vec3::new(1.0, 0.96, 0.9) * (0.55 * std::f32::consts::PI);
    Light { kind: LightKind::Directional { direction }, intensity, range: f64::INFINITY }
}

/// A slightly blue sky over slightly brown ground.
pub(crate) fn open_sky() -> Sky {
    Sky::Gradient { zenith: [0.42, 0.46, 0.52], ground: [0.22, 0.2, 0.17], up: [0.0, 1.0, 0.0] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Surface;

    #[test]
    fn every_preset_builds_and_is_described() {
        for preset in PRESETS {
            let spec: PresetSpec = preset.name.parse().expect("a preset");
            let staging = spec.build(0);
            assert!(!preset.summary.is_empty(), "{}", preset.name);
            let surface = Surface::new(&staging.model).expect("triangles");
            let (train, test) = staging.rig.cameras(&surface, &[]).expect("cameras");
            assert_eq!(train.len(), staging.rig.train as usize, "{}", preset.name);
            let reach = train.iter().map(|c| c.centre.distance(train[0].centre));
            let apart = 1e-3 * reach.fold(0.0, f64::max);
            for a in &train {
                let same = test.iter().find(|b| a.centre.distance(b.centre) < apart);
                assert!(same.is_none(), "{}: a test view is a training view", preset.name);
            }
        }
    }
}
