//! `glossy`: view-dependent colours.
//!
//! A plate |x|, |z| <= 1.5 at y = 0 (Lambert, chequered). On it are nine GGX spheres of radius 0.22 m on a grid
//! of 0.6 m: metalness 0, 0.5 and 1 along z, roughness 0.15, 0.35 and 0.6 along x. Each has 5,120 triangles
//! with smooth normals. The spheres reflect sun and sky, but not each other.

use glam::{DVec3, Vec3, Vec4};

use super::{Build, Preset, Staging};
use crate::mesh::{Material, Model, Reflection};
use crate::primitives::{chequered, marbled};
use crate::rig::Rig;

pub(super) const PRESET: Preset = Preset {
    name: "glossy",
    summary: "GGX spheres: view-dependent colours",
    build: Build::Fixed(build),
};

fn build() -> Staging {
    let mut model = Model::default();
    let plate = model.painted("plate", 512, |at| {
        let tone = if chequered(at, 10.0) { 0.6 } else { 0.2 };
        marbled(at, 12, 51, [tone; 3], [tone + 0.15; 3])
    });
    model.quad(DVec3::new(-1.5, 0.0, 1.5), 3.0 * DVec3::X, -3.0 * DVec3::Z, plate);
    for i in 0..9_u8 {
        let (column, row) = (i % 3, i / 3);
        let hue = f32::from(i) / 9.0 * std::f32::consts::TAU;
        let channel = |shift: f32| 0.5 + 0.4 * (hue + shift).cos();
        let colour = Vec3::new(channel(0.0), channel(2.1), channel(4.2));
        let texture = model.paint(128, |at| {
            marbled(at, 6, 52 + u64::from(i), (colour * 0.5).to_array(), colour.to_array())
        });
        let skin = model.material(Material {
            name: "glossy".into(),
            reflection: Reflection::MetalRough,
            base: Vec4::ONE,
            base_texture: Some(texture),
            metallic: 0.5 * f32::from(row),
            roughness: [0.15, 0.35, 0.6][usize::from(column)],
            ..Material::default()
        });
        let (x, z) = (0.6 * (f64::from(column) - 1.0), 0.6 * (f64::from(row) - 1.0));
        model.sphere(DVec3::new(x, 0.22, z), 0.22, 4, skin);
    }
    let rig = Rig {
        target: Some([0.0, 0.15, 0.0]),
        focus: Some(1.15),
        elevation: [10.0, 70.0],
        ..Rig::default()
    };
    Staging { rig, ..Staging::outdoors(model) }
}
