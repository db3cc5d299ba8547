//! `table`: clutter with much occlusion.
//!
//! A table top of 1.6 x 0.06 x 1 m whose upper side is y = 0.76, on four legs of 6 x 6 cm, on a
//! floor |x|, |z| <= 1.5 at y = 0. On it, placed by a fixed seed on a grid of 5 x 3 cells of 30 cm:
//! boxes (half sides 4 to 11 cm), cylinders (radius 3 to 7 cm, height 8 to 28 cm) and spheres
//! (radius 4 to 9 cm), each resting on the top; on every third box stands a sphere of radius 4 cm.
//! All Lambert.

use glam::{DQuat, DVec3};

use super::{Build, Preset, Staging};
use crate::mesh::Model;
use crate::primitives::marbled;
use crate::random::Draws;
use crate::rig::Rig;

pub(super) const PRESET: Preset = Preset {
    name: "table",
    summary: "a cluttered table: many objects, much occlusion",
    build: Build::Fixed(build),
};

const TOP: f64 = 0.76;

fn build() -> Staging {
    let mut model = Model::default();
    let wood = model.painted("wood", 512, |at| {
        marbled(at * glam::DVec2::new(1.0, 8.0), 4, 21, [0.25, 0.12, 0.05], [0.6, 0.38, 0.2])
    });
    let floor = model.painted("floor", 512, |at| marbled(at, 24, 22, [0.3; 3], [0.55, 0.55, 0.5]));
    model.quad(DVec3::new(-1.5, 0.0, 1.5), 3.0 * DVec3::X, -3.0 * DVec3::Z, floor);
    let upright = DQuat::IDENTITY;
    model.cuboid(DVec3::new(0.0, TOP - 0.03, 0.0), DVec3::new(0.8, 0.03, 0.5), upright, wood);
    for (x, z) in [(-0.75, -0.45), (0.75, -0.45), (0.75, 0.45), (-0.75, 0.45)] {
        let half = DVec3::new(0.03, 0.5 * (TOP - 0.06), 0.03);
        model.cuboid(DVec3::new(x, half.y, z), half, upright, wood);
    }
    let mut draws = Draws::new(23, &[]);
    for cell in 0..15_u32 {
        let mut between = |low: f64, high: f64| low + (high - low) * draws.unit64();
        let (column, row) = (f64::from(cell % 5) - 2.0, f64::from(cell / 5) - 1.0);
        let foot =
            DVec3::new(0.3 * column + between(-0.04, 0.04), TOP, 0.3 * row + between(-0.04, 0.04));
        let mut colour =
            || [between(0.05, 0.9) as f32, between(0.05, 0.9) as f32, between(0.05, 0.9) as f32];
        let (from, to) = (colour(), colour());
        let skin =
            model.painted("object", 128, |at| marbled(at, 5, 30 + u64::from(cell), from, to));
        let mut between = |low: f64, high: f64| low + (high - low) * draws.unit64();
        match cell % 3 {
            0 => {
                let half =
                    DVec3::new(between(0.04, 0.11), between(0.04, 0.11), between(0.04, 0.11));
                let turn = DQuat::from_rotation_y(between(0.0, 1.5));
                model.cuboid(foot + half.y * DVec3::Y, half, turn, skin);
                if cell % 9 == 0 {
                    model.sphere(foot + (2.0 * half.y + 0.04) * DVec3::Y, 0.04, 3, skin);
                }
            }
            1 => {
                let (radius, height) = (between(0.03, 0.07), between(0.08, 0.28));
                model.cylinder(foot, foot + height * DVec3::Y, radius, 48, skin);
            }
            _ => {
                let radius = between(0.04, 0.09);
                model.sphere(foot + radius * DVec3::Y, radius, 4, skin);
            }
        }
    }
    let rig = Rig {
        target: Some([0.0, 0.78, 0.0]),
        focus: Some(0.85),
        elevation: [5.0, 60.0],
        ..Rig::default()
    };
    Staging { rig, ..Staging::outdoors(model) }
}
