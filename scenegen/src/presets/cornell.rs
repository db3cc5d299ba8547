//! `cornell`: soft light in a box (after Goral et al., SIGGRAPH 1984, with dimensions of our own).
//!
//! The inside of |x| <= 1, 0 <= y <= 2, −1 <= z <= 1, open towards +z: white floor, ceiling and back,
//! red left and green right wall. A lamp of 0.5 x 0.5 m at y = 1.99, facing down, radiance 14. Two
//! white boxes: 0.6 x 1.2 x 0.6 m at (−0.35, −0.3) in (x, z), turned by 18 degrees, and a cube of
//! 0.6 m at (0.35, 0.35), turned by −16 degrees. All Lambert. One light bounce, 64 rays per pixel.

use glam::{DQuat, DVec3, Vec3};

use super::{Build, Preset, Staging};
use crate::mesh::{Light, LightKind, Material, Model};
use crate::rig::{Rig, RigKind};
use crate::shade::Ambient;
use crate::sky::Sky;

pub(super) const PRESET: Preset = Preset {
    name: "cornell",
    summary: "an area light in a coloured box: soft shadows, one bounce",
    build: Build::Fixed(build),
};

fn build() -> Staging {
    let mut model = Model::default();
    let white = model.material(Material::lambert("white", [0.73; 3]));
    let red = model.material(Material::lambert("red", [0.63, 0.06, 0.05]));
    let green = model.material(Material::lambert("green", [0.12, 0.45, 0.1]));
    let (x, y, z) = (2.0 * DVec3::X, 2.0 * DVec3::Y, 2.0 * DVec3::Z);
    model.quad(DVec3::new(-1.0, 0.0, 1.0), x, -z, white);
    model.quad(DVec3::new(-1.0, 2.0, -1.0), x, z, white);
    model.quad(DVec3::new(-1.0, 0.0, -1.0), x, y, white);
    model.quad(DVec3::new(-1.0, 0.0, 1.0), -z, y, red);
    model.quad(DVec3::new(1.0, 0.0, -1.0), z, y, green);
    let block = |model: &mut Model, place: DVec3, half: DVec3, degrees: f64| {
        let turn = DQuat::from_rotation_y(f64::to_radians(degrees));
        model.cuboid(place, half, turn, white);
    };
    block(&mut model, DVec3::new(-0.35, 0.6, -0.3), DVec3::new(0.3, 0.6, 0.3), 18.0);
    block(&mut model, DVec3::new(0.35, 0.3, 0.35), DVec3::splat(0.3), -16.0);
    let radiance = Vec3::new(14.0, 12.5, 10.0);
    let glow =
        Material { emissive: radiance, is_light: true, ..Material::lambert("lamp", [0.0; 3]) };
    let lamp = model.material(glow);
    let (corner, u, v) = (DVec3::new(-0.25, 1.99, -0.25), 0.5 * DVec3::X, 0.5 * DVec3::Z);
    model.quad(corner, u, v, lamp);
    let kind = LightKind::Area { corner, u, v };
    model.lights.push(Light { kind, intensity: radiance, range: f64::INFINITY });
    let rig = Rig {
        kind: RigKind::Orbit,
        arc: 45.0,
        // Every pixel costs 64 rays and their shadow rays.
        width: 128,
        height: 128,
        elevation: [-12.0, 20.0],
        target: Some([0.0, 1.0, 0.0]),
        focus: Some(1.45),
        ..Rig::default()
    };
    Staging { model, sky: Sky::uniform(0.0), rig, ambient: Ambient::Bounce(64) }
}
