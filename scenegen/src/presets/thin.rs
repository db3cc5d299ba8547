//! `thin`: wires of known radius in front of a textured wall.
//!
//! Wall: the rectangle |x| <= 1.4, 0 <= y <= 2 at z = −0.6, floor: |x| <= 1.4, −0.6 <= z <= 0.8 at
//! y = 0. Wires of radius 6, 12, 24 and 48 mm; at the default 256 px, 50 degrees and distance
//! their radii are 0.5, 1, 2 and 4 px. Eight stand upright at z = 0 from y = 0 to 1.8, at x = −1.05
//! to 1.05 every 0.3 m, with alternating radii; four run along x at z = 0.15 and y = 0.5, 0.9, 1.3, 1.7,
//! the thinnest at the top. Each has 16 sides with corners on the circle. All Lambert.

use glam::{DVec3, Vec3};

use super::{Build, Preset, Staging};
use crate::mesh::{Material, Model};
use crate::primitives::marbled;
use crate::rig::{Rig, RigKind};

pub(super) const PRESET: Preset = Preset {
    name: "thin",
    summary: "wires of radius 0.5 to 4 px in front of a textured wall",
    build: Build::Fixed(build),
};

const RADII: [f64; 4] = [0.006, 0.012, 0.024, 0.048];

fn build() -> Staging {
    let mut model = Model::default();
    let wall = model.painted("wall", 1024, |at| {
        let a = marbled(at, 10, 11, [0.12, 0.2, 0.35], [0.85, 0.75, 0.55]);
        a.lerp(marbled(at, 64, 12, [0.1; 3], [0.9; 3]), 0.35)
    });
    let floor =
        model.painted("floor", 512, |at| marbled(at, 16, 13, [0.3, 0.2, 0.1], [0.7, 0.55, 0.4]));
    model.quad(DVec3::new(-1.4, 0.0, -0.6), 2.8 * DVec3::X, 2.0 * DVec3::Y, wall);
    model.quad(DVec3::new(-1.4, 0.0, 0.8), 2.8 * DVec3::X, -1.4 * DVec3::Z, floor);
    let colours = [[0.85, 0.12, 0.08], [0.05, 0.05, 0.06], [0.9, 0.85, 0.2], [0.85, 0.85, 0.85]];
    let wires = colours.map(|colour| {
        let wire = Material::lambert("wire", colour);
        model.material(Material { thin: true, base: Vec3::from(colour).extend(1.0), ..wire })
    });
    for i in 0..8 {
        let x = -1.05 + 0.3 * i as f64;
        let foot = DVec3::new(x, 0.0, 0.0);
        model.cylinder(foot, foot + 1.8 * DVec3::Y, RADII[i % 4], 16, wires[i % 4]);
    }
    for i in 0..4 {
        let y = 1.7 - 0.4 * i as f64;
        let end = DVec3::new(-1.2, y, 0.15);
        model.cylinder(end, end + 2.4 * DVec3::X, RADII[i], 16, wires[i]);
    }
    let rig = Rig {
        kind: RigKind::Orbit,
        arc: 110.0,
        elevation: [2.0, 35.0],
        target: Some([0.0, 0.9, 0.0]),
        focus: Some(1.4),
        ..Rig::default()
    };
    Staging { rig, ..Staging::outdoors(model) }
}
