//! `room`: a room from inside. Its walls have no texture except small text.
//!
//! The inside of |x| <= 2.5, 0 <= y <= 2.6, |z| <= 2: floor of boards, plain walls and ceiling. Posters
//! of 0.9 x 0.6 m hang 1 cm in front of the middle of each wall at height 1.5 m, with five lines of text whose
//! strokes are 6 mm wide. A table (top 1.2 x 0.04 x 0.7 m at height 0.72 m, four legs of 5 cm) in the
//! middle, a shelf (0.8 x 1.8 x 0.3 m) at the wall x = −2.5, a sphere of 0.25 m and a cube of 0.4 m.
//! Lit by a point light at (0, 1.9, 0) and even ambient light. All Lambert.

use glam::{DQuat, DVec2, DVec3, Vec3};

use super::{Build, Preset, Staging};
use crate::mesh::{Light, LightKind, Material, Model};
use crate::primitives::marbled;
use crate::rig::{Rig, RigKind};
use crate::shade::Ambient;
use crate::sky::Sky;

pub(super) const PRESET: Preset = Preset {
    name: "room",
    summary: "a room from inside: plain walls, small text",
    build: Build::Fixed(build),
};

const HALF: DVec3 = DVec3::new(2.5, 1.3, 2.0);
const LINES: [&str; 5] = ["DENSIFY", "ROWS 200K", "DEPTH 2.50", "PRUNE GROW", "0123456789"];

fn build() -> Staging {
    let mut model = Model::default();
    let wall = model.material(Material::lambert("wall", [0.7, 0.68, 0.62]));
    let boards = model.painted("boards", 1024, |at| {
        let board = (at.x * 16.0).floor();
        let gap = (at.x * 16.0).fract() < 0.04;
        let along = DVec2::new(at.x * 4.0, (at.y + 0.37 * board).fract());
        if gap {
            Vec3::splat(0.05)
        } else {
            marbled(along, 8, 61, [0.3, 0.17, 0.08], [0.62, 0.42, 0.25])
        }
    });
    model.cuboid(DVec3::Y * HALF.y, -HALF, DQuat::IDENTITY, wall);
    // The floor lies 1 mm above the box's bottom.
    let corner = DVec3::new(-HALF.x, 1e-3, HALF.z);
    model.quad(corner, 2.0 * HALF.x * DVec3::X, -2.0 * HALF.z * DVec3::Z, boards);
    let poster = model.painted("poster", 512, poster);
    for (normal, right) in [
        (DVec3::Z, DVec3::X),
        (DVec3::NEG_Z, DVec3::NEG_X),
        (DVec3::X, DVec3::NEG_Z),
        (DVec3::NEG_X, DVec3::Z),
    ] {
        let middle = DVec3::Y * 1.5 - normal * (HALF * normal.abs() - 0.01 * normal.abs());
        let (u, v) = (0.9 * right, 0.6 * DVec3::Y);
        model.quad(middle - 0.5 * (u + v), u, v, poster);
    }
    let wood = model.painted("wood", 256, |at| {
        marbled(at * DVec2::new(1.0, 6.0), 4, 62, [0.2, 0.1, 0.04], [0.5, 0.3, 0.15])
    });
    let upright = DQuat::IDENTITY;
    model.cuboid(DVec3::new(0.0, 0.72, 0.0), DVec3::new(0.6, 0.02, 0.35), upright, wood);
    for (x, z) in [(-0.55, -0.3), (0.55, -0.3), (0.55, 0.3), (-0.55, 0.3)] {
        model.cuboid(DVec3::new(x, 0.35, z), DVec3::new(0.025, 0.35, 0.025), upright, wood);
    }
    let shelf = model.painted("shelf", 256, |at| {
        let (row, book) = ((at.y * 5.0).floor(), (at.x * 14.0).floor());
        let edge = (at.y * 5.0).fract() < 0.08;
        let hue = (row * 5.3 + book * 2.1) as f32;
        let tone = |shift: f32| 0.35 + 0.3 * (hue + shift).cos();
        if edge { Vec3::new(0.3, 0.18, 0.1) } else { Vec3::new(tone(0.0), tone(2.0), tone(4.0)) }
    });
    let half = DVec3::new(0.15, 0.9, 0.4);
    model.cuboid(DVec3::new(-HALF.x + half.x, half.y, -1.2), half, upright, shelf);
    let ball =
        model.painted("ball", 256, |at| marbled(at, 6, 63, [0.7, 0.25, 0.1], [0.95, 0.8, 0.5]));
    model.sphere(DVec3::new(1.7, 0.25, -1.3), 0.25, 4, ball);
    let cube =
        model.painted("cube", 128, |at| marbled(at, 6, 64, [0.1, 0.3, 0.5], [0.5, 0.75, 0.8]));
    model.cuboid(DVec3::new(1.6, 0.2, 1.2), DVec3::splat(0.2), DQuat::from_rotation_y(0.5), cube);
    model.lights.push(Light {
        kind: LightKind::Point { position: DVec3::new(0.0, 1.9, 0.0) },
        intensity: Vec3::new(1.5, 1.4, 1.3),
        range: f64::INFINITY,
    });
    let rig = Rig {
        kind: RigKind::Inside,
        fov: 80.0,
        radius: 0.45,
        elevation: [-25.0, 15.0],
        clearance: 0.02,
        target: Some([0.0, 1.35, 0.0]),
        ..Rig::default()
    };
    Staging { model, sky: Sky::uniform(0.42), rig, ambient: Ambient::Open }
}

fn poster(at: DVec2) -> Vec3 {
    let (line, column) = (at.y * 6.0 - 0.5, at.x * 12.0 - 0.6);
    let blank = Vec3::new(0.85, 0.85, 0.8);
    if line < 0.0 || column < 0.0 || line >= 5.0 {
        return blank;
    }
    let Some(letter) = LINES[line as usize].as_bytes().get(column as usize) else {
        return blank;
    };
    // Letters are 5 x 7 dots in cells of 6 x 9.
    let (x, y) = ((column.fract() * 6.0) as u32, (line.fract() * 9.0) as usize);
    if x >= 5 || y >= 7 {
        return blank;
    }
    let dark = glyph(*letter)[y] >> (4 - x) & 1 == 1;
    if dark { Vec3::new(0.05, 0.06, 0.12) } else { blank }
}

/// Rows of 5 dots, the leftmost in bit 4.
fn glyph(letter: u8) -> [u8; 7] {
    match letter {
        b'0' => [14, 17, 19, 21, 25, 17, 14],
        b'1' => [4, 12, 4, 4, 4, 4, 14],
        b'2' => [14, 17, 1, 6, 8, 16, 31],
        b'3' => [14, 17, 1, 6, 1, 17, 14],
        b'4' => [2, 6, 10, 18, 31, 2, 2],
        b'5' => [31, 16, 30, 1, 1, 17, 14],
        b'6' => [14, 16, 30, 17, 17, 17, 14],
        b'7' => [31, 1, 2, 4, 8, 8, 8],
        b'8' => [14, 17, 17, 14, 17, 17, 14],
        b'9' => [14, 17, 17, 15, 1, 1, 14],
        b'D' => [30, 17, 17, 17, 17, 17, 30],
        b'E' => [31, 16, 16, 30, 16, 16, 31],
        b'F' => [31, 16, 16, 30, 16, 16, 16],
        b'G' => [14, 17, 16, 23, 17, 17, 14],
        b'H' => [17, 17, 17, 31, 17, 17, 17],
        b'I' => [14, 4, 4, 4, 4, 4, 14],
        b'K' => [17, 18, 20, 24, 20, 18, 17],
        b'N' => [17, 25, 21, 19, 17, 17, 17],
        b'O' => [14, 17, 17, 17, 17, 17, 14],
        b'P' => [30, 17, 17, 30, 16, 16, 16],
        b'R' => [30, 17, 17, 30, 20, 18, 17],
        b'S' => [15, 16, 16, 14, 1, 1, 30],
        b'T' => [31, 4, 4, 4, 4, 4, 4],
        b'U' => [17, 17, 17, 17, 17, 17, 14],
        b'W' => [17, 17, 17, 21, 21, 27, 17],
        b'Y' => [17, 17, 10, 4, 4, 4, 4],
        b'.' => [0, 0, 0, 0, 0, 12, 12],
        _ => [0; 7],
    }
}
