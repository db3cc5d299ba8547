//! `town`: streets, houses and trees. The size is the number of blocks along a side: `town:4` has 4 x 4 blocks.
//!
//! The ground is flat at y = 0. Streets 11 m wide, including 2 m of pavement on each side, run along x and z
//! every 50 m, around every block and around the town; the centre of the town is the origin. Blocks are
//! 39 x 39 m and cycle through houses, flats and parks, starting at a position given by the seed. Around the
//! town is a meadow of 30 m with trees.
//!
//! Houses (`houses.rs`) are closed solids, eight to a block, of two to four floors of 2.9 m, with gabled or
//! flat roofs; blocks of flats have two slabs of four to six floors with balconies. Trees (`outdoors.rs`) have a
//! trunk and a lumpy crown of 320 triangles. Cars are parked along the streets, lamps (thin structures, 12 cm)
//! stand on the pavement. Windows, doors and road markings are painted. All Lambert. There are about 9,000
//! triangles per block; the seed determines the layout.
//!
//! Each block has 24 training views, two thirds from 45 m above and a third from the street at 1.7 m, and 6
//! test views.

mod houses;
mod materials;
mod outdoors;

use glam::{DVec3, dvec3};

use super::{Build, Preset, Staging};
use crate::mesh::Model;
use crate::random::Draws;
use crate::rig::{Rig, RigKind, Survey};
use materials::Materials;

pub(super) const PRESET: Preset = Preset {
    name: "town",
    summary: "streets, houses and trees, from above and from the street; town:4 has 4x4 blocks (1 to 16; default 2)",
    build: Build::Sized { default: 2, largest: 16, build },
};

/// Distance between the centre lines of neighbouring streets.
const PITCH: f64 = 50.0;
/// Half the width of a street, including pavements.
const HALF_STREET: f64 = 5.5;
/// Half the side of a block.
const HALF_BLOCK: f64 = 0.5 * PITCH - HALF_STREET;
/// Width of the meadow around the town.
const MEADOW: f64 = 30.0;
/// Height of the views from above.
const FLIGHT: f64 = 45.0;
/// Height of the views from the street.
const EYE: f64 = 1.7;
/// Smallest distance of a camera from any surface.
const CLEARANCE: f64 = 0.5;

/// The use of a block.
#[derive(Debug, Clone, Copy)]
enum Use {
    Houses,
    Flats,
    Park,
}

/// The cycle of uses of consecutive blocks.
const USES: [Use; 6] = [Use::Houses, Use::Flats, Use::Houses, Use::Park, Use::Houses, Use::Flats];

/// A town that is being built.
struct Town {
    model: Model,
    materials: Materials,
}

fn build(size: u32, seed: u64) -> Staging {
    let mut model = Model::default();
    let materials = Materials::paint(&mut model);
    let mut town = Town { model, materials };
    town.ground(size);
    for block in 0..size * size {
        let (column, row) = (block % size, block / size);
        let middle = dvec3(street_at(size, column), 0.0, street_at(size, row));
        let middle = middle + 0.5 * PITCH * (DVec3::X + DVec3::Z);
        let use_index = u64::from(block + row / 2) + seed;
        let mut draws = Draws::new(seed, &[0x62_6c6f_636b, u64::from(column), u64::from(row)]);
        match USES[(use_index % USES.len() as u64) as usize] {
            Use::Houses => town.houses(middle, &mut draws),
            Use::Flats => town.flats(middle, &mut draws),
            Use::Park => town.park(middle, &mut draws),
        }
    }
    town.furnish_streets(size, seed);
    town.plant_meadow(size, seed);
    let blocks = size * size;
    let edge = street_at(size, size) + HALF_STREET;
    let diagonal = 2.0 * (edge + MEADOW) * 2.0_f64.sqrt();
    let rig = Rig {
        kind: RigKind::Survey,
        train: 24 * blocks,
        test: 6 * blocks,
        width: 256,
        height: 192,
        fov: 65.0,
        clearance: CLEARANCE / diagonal,
        survey: Some(Survey {
            ground: [[-edge; 2], [edge; 2]],
            height: [0.0, FLIGHT],
            streets: streets(size)
                .map(|ends| ends.map(|end| (end + EYE * DVec3::Y).into()))
                .collect(),
            eye: EYE,
        }),
        ..Rig::default()
    };
    Staging { rig, ..Staging::outdoors(town.model) }
}

/// Position of the centre line of the `i`-th of `size + 1` parallel streets.
fn street_at(size: u32, i: u32) -> f64 {
    PITCH * (f64::from(i) - 0.5 * f64::from(size))
}

/// Both ends of each street's centre line, alternately along x and along z.
fn streets(size: u32) -> impl Iterator<Item = [DVec3; 2]> {
    let end = street_at(size, size);
    (0..=size).flat_map(move |i| {
        let at = street_at(size, i);
        let ends = |along: DVec3, across: DVec3| [-end, end].map(|way| way * along + at * across);
        [ends(DVec3::X, DVec3::Z), ends(DVec3::Z, DVec3::X)]
    })
}

/// The local coordinate frame of an object on the ground.
#[derive(Debug, Clone, Copy)]
struct LocalFrame {
    origin: DVec3,
    right: DVec3,
    front: DVec3,
}

impl LocalFrame {
    /// A frame whose front is towards `front`, a coordinate axis.
    fn facing(origin: DVec3, front: DVec3) -> Self {
        Self { origin, right: DVec3::Y.cross(front), front }
    }

    /// The frame after a quarter turn.
    fn turned(self) -> Self {
        Self::facing(self.origin, self.right)
    }

    /// A vector from its components to the right, up, and to the front.
    fn direction(&self, right: f64, up: f64, front: f64) -> DVec3 {
        right * self.right + up * DVec3::Y + front * self.front
    }

    fn at(&self, right: f64, up: f64, front: f64) -> DVec3 {
        self.origin + self.direction(right, up, front)
    }
}

impl Town {
    /// A horizontal rectangle around `middle`, its image repeated `times` in each direction.
    fn level(&mut self, middle: DVec3, half: [f64; 2], times: [f64; 2], material: u32) {
        let [x, z] = half;
        let (u, v) = (2.0 * x * DVec3::X, -2.0 * z * DVec3::Z);
        let times = times.map(|times| times as f32);
        self.model.tiled(middle + dvec3(-x, 0.0, z), u, v, [0.0, 1.0], times, material);
    }

    /// An upright box around `middle`, with half sides along the right, up and front of `place`.
    fn cuboid(&mut self, place: &LocalFrame, middle: DVec3, half: DVec3, material: u32) {
        let corner = middle - place.direction(half.x, half.y, half.z);
        let sides = [(half.x, 0.0, 0.0), (0.0, 0.0, half.z), (0.0, half.y, 0.0)]
            .map(|(right, up, front)| 2.0 * place.direction(right, up, front));
        self.slab(corner, sides, [1.0; 2], material);
    }

    /// A parallelepiped of three sides from a corner, its image repeated along the first two.
    fn slab(&mut self, corner: DVec3, sides: [DVec3; 3], times: [f64; 2], material: u32) {
        let [mut a, mut b, c] = sides;
        if a.cross(b).dot(c) < 0.0 {
            (a, b) = (b, a);
        }
        let [x, y] = times.map(|times| times as f32);
        let faces = [
            (corner + c, a, b, [x, y]),
            (corner, b, a, [y, x]),
            (corner, a, c, [x, 1.0]),
            (corner + b, c, a, [1.0, x]),
            (corner + a, b, c, [y, 1.0]),
            (corner, c, b, [1.0, y]),
        ];
        for (corner, u, v, times) in faces {
            self.model.tiled(corner, u, v, [0.0, 1.0], times, material);
        }
    }

    /// Streets, crossings, and the meadow around them. Each block adds its own ground.
    fn ground(&mut self, size: u32) {
        let Materials { street, street_across, crossing, grass, .. } = self.materials;
        for column in 0..=size {
            for row in 0..=size {
                let at = dvec3(street_at(size, column), 0.0, street_at(size, row));
                self.level(at, [HALF_STREET; 2], [1.0; 2], crossing);
                if row < size {
                    let middle = at + 0.5 * PITCH * DVec3::Z;
                    self.level(middle, [HALF_STREET, HALF_BLOCK], [1.0, 4.0], street);
                }
                if column < size {
                    let middle = at + 0.5 * PITCH * DVec3::X;
                    self.level(middle, [HALF_BLOCK, HALF_STREET], [4.0, 1.0], street_across);
                }
            }
        }
        let edge = street_at(size, size) + HALF_STREET;
        let (out, half) = (edge + 0.5 * MEADOW, 0.5 * MEADOW);
        for sign in [-1.0, 1.0] {
            let times = [(2.0 * edge + 2.0 * MEADOW) / 12.0, MEADOW / 12.0];
            self.level(sign * out * DVec3::Z, [edge + MEADOW, half], times, grass);
            let times = [MEADOW / 12.0, 2.0 * edge / 12.0];
            self.level(sign * out * DVec3::X, [half, edge], times, grass);
        }
    }
}

#[cfg(test)]
mod tests;
