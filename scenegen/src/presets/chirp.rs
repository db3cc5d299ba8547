//! `chirp`: detail of every scale. Siemens stars, a chirp, and walls without texture.
//!
//! Three walls, 1.6 m wide and high, each at y = 0 to 1.6: the middle one at z = −0.8, |x| <= 0.8,
//! with four Siemens stars of 36 spokes; the left one from (−0.8, −0.8) to (−1.6, 0.585786) in
//! (x, z) with a chirp whose period falls from 16 cm to 1 cm; the right one, its mirror image,
//! without texture. Floor: |x| <= 1.6, −0.8 <= z <= 1 at y = 0, without texture. All Lambert.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3, Vec3};

use super::{Build, Preset, Staging};
use crate::mesh::{Material, Model};
use crate::rig::{Rig, RigKind};

pub(super) const PRESET: Preset = Preset {
    name: "chirp",
    summary: "Siemens stars, a chirp and flat walls: detail of every scale, and none",
    build: Build::Fixed(build),
};

const HEIGHT: f64 = 1.6;

fn build() -> Staging {
    let mut model = Model::default();
    let stars = model.painted("stars", 1024, |at| {
        let within = (at * 2.0).fract() - 0.5;
        let dark = within.length() < 0.46 && (within.y.atan2(within.x) * 36.0).sin() < 0.0;
        Vec3::splat(if dark { 0.05 } else { 0.8 })
    });
    let chirp = model.painted("chirp", 1024, |at: DVec2| {
        // The frequency grows exponentially, from 10 to 160 periods per wall.
        let phase = TAU * 10.0 / 16.0_f64.ln() * (16.0_f64.powf(at.x) - 1.0);
        let value = 0.45 + 0.4 * phase.sin() * if at.y < 0.5 { 1.0 } else { 0.25 };
        Vec3::new(value as f32, 0.9 * value as f32, 0.7 * value as f32)
    });
    let flat = model.material(Material::lambert("flat", [0.55, 0.6, 0.65]));
    let floor = model.material(Material::lambert("floor", [0.35, 0.33, 0.3]));
    let (inner, outer) = (DVec3::new(0.8, 0.0, -0.8), DVec3::new(1.6, 0.0, 0.585_786));
    let mirror = DVec3::new(-1.0, 1.0, 1.0);
    let up = HEIGHT * DVec3::Y;
    model.quad(inner * mirror, 1.6 * DVec3::X, up, stars);
    model.quad(outer * mirror, (inner - outer) * mirror, up, chirp);
    model.quad(inner, outer - inner, up, flat);
    model.quad(DVec3::new(-1.6, 0.0, 1.0), 3.2 * DVec3::X, -1.8 * DVec3::Z, floor);
    let rig = Rig {
        kind: RigKind::Orbit,
        arc: 80.0,
        elevation: [5.0, 40.0],
        target: Some([0.0, 0.7, -0.3]),
        focus: Some(1.5),
        ..Rig::default()
    };
    Staging { rig, ..Staging::outdoors(model) }
}
