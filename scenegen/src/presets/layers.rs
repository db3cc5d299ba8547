//! `layers`: near, middle and far layers, as in outdoor scenes.
//!
//! Far: the inside of a sphere of radius 30 m about the origin (20,480 triangles), painted with
//! hills under a sky. Ground: the square |x|, |z| <= 12 at y = 0. Middle: twelve boxes of 1 x (1 to
//! 3) x 1 m on a circle of 6 m. Near: six posts of radius 8 cm and height 1.2 m on a circle of
//! 1.2 m, and a sphere of radius 0.4 m at (0, 0.4, 0). The dome is unlit; everything else is Lambert.

use std::f64::consts::TAU;

use glam::{DQuat, DVec3, Vec3};

use super::{Build, Preset, Staging};
use crate::mesh::{Material, Model, Reflection};
use crate::primitives::{marbled, noise};
use crate::rig::{Rig, RigKind};

pub(super) const PRESET: Preset = Preset {
    name: "layers",
    summary: "near posts, buildings and a far dome: an outdoor scene with a horizon",
    build: Build::Fixed(build),
};

fn build() -> Staging {
    let mut model = Model::default();
    let dome = model.paint(1024, |at| {
        let hills = 0.49 - 0.06 * noise(glam::DVec2::new(at.x, 0.3), 6, 5, 41);
        if at.y > hills {
            marbled(at, 24, 42, [0.1, 0.16, 0.06], [0.3, 0.36, 0.15])
        } else {
            let cloud = (noise(at, 5, 5, 43) as f32 - 0.5).max(0.0) * 1.6;
            let blue = Vec3::new(0.3, 0.5, 0.85).lerp(Vec3::splat(0.75), (at.y * 1.6) as f32);
            blue.lerp(Vec3::splat(0.95), cloud.min(1.0))
        }
    });
    let dome = model.material(Material {
        base_texture: Some(dome),
        reflection: Reflection::Unlit,
        ..Material::lambert("dome", [1.0; 3])
    });
    model.sphere(DVec3::ZERO, 30.0, 5, dome);
    // Seen from inside, so winding and normals are reversed.
    for triangle in &mut model.triangles {
        triangle.swap(1, 2);
    }
    for normal in &mut model.normals {
        *normal = -*normal;
    }
    let ground = model
        .painted("ground", 1024, |at| marbled(at, 48, 44, [0.16, 0.2, 0.08], [0.45, 0.42, 0.25]));
    model.quad(DVec3::new(-12.0, 0.0, 12.0), 24.0 * DVec3::X, -24.0 * DVec3::Z, ground);
    for i in 0..12_u64 {
        let angle = TAU * i as f64 / 12.0;
        let height = 1.0 + 2.0 * ((i * 7 % 12) as f64 / 11.0);
        let middle = DVec3::new(6.0 * angle.sin(), 0.5 * height, 6.0 * angle.cos());
        let bricks = model.painted("building", 256, |at| {
            let row = (at.y * 12.0).floor();
            let joint = (at.y * 12.0).fract() < 0.1 || (at.x * 6.0 + 0.5 * row).fract() < 0.06;
            let tone = 0.25 + 0.05 * (i % 5) as f32;
            if joint {
                Vec3::splat(0.6)
            } else {
                marbled(at, 12, 45 + i, [tone, 0.15, 0.1], [tone + 0.3, 0.3, 0.2])
            }
        });
        let half = DVec3::new(0.5, 0.5 * height, 0.5);
        model.cuboid(middle, half, DQuat::from_rotation_y(angle), bricks);
    }
    let post = model.painted("post", 128, |at| {
        let red = (at.y * 6.0).fract() < 0.5;
        if red { Vec3::new(0.75, 0.08, 0.05) } else { Vec3::splat(0.85) }
    });
    for i in 0..6 {
        let angle = TAU * (f64::from(i) + 0.5) / 6.0;
        let foot = DVec3::new(1.2 * angle.sin(), 0.0, 1.2 * angle.cos());
        model.cylinder(foot, foot + 1.2 * DVec3::Y, 0.08, 32, post);
    }
    let ball =
        model.painted("ball", 256, |at| marbled(at, 8, 60, [0.1, 0.3, 0.5], [0.9, 0.8, 0.5]));
    model.sphere(DVec3::new(0.0, 0.4, 0.0), 0.4, 4, ball);
    let rig = Rig {
        kind: RigKind::Orbit,
        target: Some([0.0, 0.5, 0.0]),
        focus: Some(1.1),
        fov: 65.0,
        elevation: [8.0, 35.0],
        ..Rig::default()
    };
    // The sky lights the scene in closed form; the dome only depicts it.
    let mut staging = Staging { rig, ..Staging::outdoors(model) };
    // The dome would occlude a sun outside it.
    staging.model.lights = vec![inside_sun()];
    staging
}

/// A light within the dome that is far enough for its rays to be nearly parallel.
fn inside_sun() -> crate::mesh::Light {
    let sun = super::sun();
    let position = DVec3::new(0.5, 0.8, 0.6).normalize() * 29.0;
    crate::mesh::Light {
        kind: crate::mesh::LightKind::Point { position },
        intensity: sun.intensity * (29.0 * 29.0),
        range: f64::INFINITY,
    }
}
