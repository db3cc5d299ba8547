//! `spheres`, the smoke test: five marbled spheres on a chequered floor.
//!
//! Floor: the square |x|, |z| <= 1.6 at y = 0. Spheres of radius 0.5, 0.35, 0.3, 0.25 and 0.2 rest
//! on it at (x, z) = (0, 0), (0.8, 0.25), (−0.7, 0.45), (0.3, −0.85), (−0.45, −0.6); each has 5,120
//! triangles whose corners lie on the sphere. All Lambert. The finest features are marble veins of 2 cm.

use glam::DVec3;

use super::{Build, Preset, Staging};
use crate::mesh::Model;
use crate::primitives::{chequered, marbled};
use crate::rig::Rig;

pub(super) const PRESET: Preset = Preset {
    name: "spheres",
    summary: "five marbled spheres on a floor: the smoke test (128 px, 40 views)",
    build: Build::Fixed(build),
};

/// (radius, x, z, colours)
type Ball = (f64, f64, f64, [[f32; 3]; 2]);

const BALLS: [Ball; 5] = [
    (0.5, 0.0, 0.0, [[0.75, 0.2, 0.12], [0.95, 0.75, 0.45]]),
    (0.35, 0.8, 0.25, [[0.1, 0.25, 0.6], [0.6, 0.8, 0.9]]),
    (0.3, -0.7, 0.45, [[0.12, 0.4, 0.15], [0.75, 0.85, 0.4]]),
    (0.25, 0.3, -0.85, [[0.5, 0.3, 0.55], [0.95, 0.8, 0.9]]),
    (0.2, -0.45, -0.6, [[0.8, 0.6, 0.1], [0.3, 0.15, 0.05]]),
];

fn build() -> Staging {
    let mut model = Model::default();
    let floor = model.painted("floor", 512, |at| {
        let light = chequered(at, 8.0);
        let (a, b) = if light { (0.55, 0.75) } else { (0.15, 0.3) };
        marbled(at, 8, 1, [a, a * 0.95, a * 0.85], [b, b * 0.97, b * 0.9])
    });
    let corner = DVec3::new(-1.6, 0.0, 1.6);
    model.quad(corner, 3.2 * DVec3::X, -3.2 * DVec3::Z, floor);
    for (number, (radius, x, z, [from, to])) in BALLS.into_iter().enumerate() {
        let seed = number as u64 + 2;
        let ball = model.painted("sphere", 256, |at| marbled(at, 6, seed, from, to));
        model.sphere(DVec3::new(x, radius, z), radius, 4, ball);
    }
    let staging = Staging::outdoors(model);
    let rig = Rig {
        train: 30,
        test: 10,
        width: 128,
        height: 128,
        focus: Some(1.3),
        target: Some([0.0, 0.3, 0.0]),
        elevation: [12.0, 70.0],
        ..Rig::default()
    };
    Staging { rig, ..staging }
}
