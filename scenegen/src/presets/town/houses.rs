//! Houses: walls of bays and floors under a gabled or a flat roof.

use glam::{DVec3, Vec2, dvec3};

use super::materials::{BAYS, Walls};
use super::{HALF_BLOCK, LocalFrame, Town};
use crate::random::Draws;

/// Height of a floor.
const FLOOR: f64 = 2.9;
/// Approximate width of a bay.
const BAY: f64 = 2.6;
/// Overhang of a gabled roof.
const EAVES: f64 = 0.45;
/// Thickness of a gabled roof.
const ROOF: f64 = 0.2;
/// Height and thickness of the wall around a flat roof.
const PARAPET: [f64; 2] = [0.6, 0.25];

/// The walls of a house.
#[derive(Debug, Clone, Copy)]
struct Shell {
    place: LocalFrame,
    /// Half its width and depth.
    half: [f64; 2],
    floors: u32,
    walls: Walls,
}

impl Shell {
    fn top(&self) -> f64 {
        FLOOR * f64::from(self.floors)
    }
}

/// A random number from `low` to `high`.
pub(super) fn between(draws: &mut Draws, low: f64, high: f64) -> f64 {
    low + (high - low) * draws.unit64()
}

/// A random element of a list.
pub(super) fn one_of<T: Copy>(draws: &mut Draws, list: &[T]) -> T {
    list[(draws.unit64() * list.len() as f64) as usize]
}

impl Town {
    /// Four houses on each of two sides of a block, with gardens, hedges and trees between them.
    pub(super) fn houses(&mut self, middle: DVec3, draws: &mut Draws) {
        let grass = self.materials.grass;
        self.level(middle, [HALF_BLOCK; 2], [3.25; 2], grass);
        for front in [DVec3::Z, DVec3::NEG_Z] {
            let side = LocalFrame::facing(middle, front);
            for plot in 0..4 {
                let aside = 9.4 * (f64::from(plot) - 1.5);
                let half = [between(draws, 3.3, 4.2), between(draws, 3.9, 4.6)];
                let set_back = between(draws, 1.2, 2.4);
                let place =
                    LocalFrame::facing(side.at(aside, 0.0, HALF_BLOCK - set_back - half[1]), front);
                let floors = 2 + (draws.unit64() * 2.4) as u32;
                let walls = one_of(draws, &self.materials.houses);
                let shell = Shell { place, half, floors, walls };
                if draws.unit64() < 0.72 {
                    self.gabled(shell, draws);
                } else {
                    self.flat(shell, draws);
                }
                self.garden(&side, aside, draws);
            }
        }
        let hedge = LocalFrame::facing(middle, DVec3::Z);
        for plot in 1..4 {
            let at = hedge.at(9.4 * (f64::from(plot) - 2.0), 0.6, 0.0);
            let material = self.materials.crowns[2];
            self.cuboid(&hedge, at, dvec3(0.25, 0.6, 7.5), material);
        }
    }

    /// Two slabs of flats, one on each side of a paved yard with a row of trees.
    pub(super) fn flats(&mut self, middle: DVec3, draws: &mut Draws) {
        let paving = self.materials.paving;
        self.level(middle, [HALF_BLOCK; 2], [6.5; 2], paving);
        let way = if draws.unit64() < 0.5 { DVec3::Z } else { DVec3::X };
        for front in [way, -way] {
            let half = [between(draws, 15.0, 17.5), 5.2];
            let place = LocalFrame::facing(middle + (HALF_BLOCK - 1.8 - half[1]) * front, front);
            let floors = 4 + (draws.unit64() * 3.0) as u32;
            let shell = Shell { place, half, floors, walls: one_of(draws, &self.materials.flats) };
            self.flat(shell, draws);
            self.balconies(&shell);
        }
        let yard = LocalFrame::facing(middle, way);
        for tree in 0..5 {
            let aside = 6.5 * (f64::from(tree) - 2.0) + between(draws, -0.8, 0.8);
            let front = between(draws, -2.0, 2.0);
            self.tree(yard.at(aside, 0.0, front), [1.6, 2.2], draws);
        }
    }

    /// The four walls of a house, with different images for the ground floor and the floors above.
    fn walls(&mut self, shell: &Shell, draws: &mut Draws) {
        let ([w, d], place) = (shell.half, shell.place);
        let sides = [
            (place.at(-w, 0.0, d), place.direction(2.0 * w, 0.0, 0.0)),
            (place.at(w, 0.0, d), place.direction(0.0, 0.0, -2.0 * d)),
            (place.at(w, 0.0, -d), place.direction(-2.0 * w, 0.0, 0.0)),
            (place.at(-w, 0.0, -d), place.direction(0.0, 0.0, 2.0 * d)),
        ];
        for (corner, along) in sides {
            let bays = (along.length() / BAY).round().max(1.0) as f32 / BAYS as f32;
            let first = (draws.unit64() * f64::from(BAYS)).floor() as f32 / BAYS as f32;
            let up = FLOOR * DVec3::Y;
            let Walls { ground, upper, .. } = shell.walls;
            self.model.tiled(corner, along, up, [first, 1.0], [bays, 1.0], ground);
            let above = f64::from(shell.floors - 1);
            let times = [bays, above as f32 / BAYS as f32];
            self.model.tiled(corner + up, along, above * up, [first, 1.0], times, upper);
        }
    }

    /// A house with a gabled roof, whose ridge runs along the house's width or depth.
    fn gabled(&mut self, shell: Shell, draws: &mut Draws) {
        self.walls(&shell, draws);
        let across = draws.unit64() < 0.4;
        let [w, d] = if across { [shell.half[1], shell.half[0]] } else { shell.half };
        let place = if across { shell.place.turned() } else { shell.place };
        let slope = between(draws, 33.0, 47.0).to_radians();
        let (eaves, rise) = (shell.top(), d * slope.tan());
        let tiles = one_of(draws, &self.materials.tiles);
        for side in [place, place.turned().turned()] {
            // The gable wall.
            let corners =
                [side.at(w, eaves, d), side.at(w, eaves, -d), side.at(w, eaves + rise, 0.0)];
            let (wide, high) = (2.0 * d as f32 / 3.0, rise as f32 / 3.0);
            let uvs = [Vec2::ZERO, Vec2::new(wide, 0.0), Vec2::new(0.5 * wide, -high)];
            self.model.add(&corners, &[], &uvs, &[[0, 1, 2]], shell.walls.plain);
            // The roof's slope on this side. Both slopes meet at the ridge.
            let (down, out) = (EAVES * slope.sin(), EAVES * slope.cos());
            let corner = side.at(-w - EAVES, eaves - down, d + out);
            let along = side.direction(2.0 * (w + EAVES), 0.0, 0.0);
            let up = side.direction(0.0, rise + down, -d - out);
            let times = [along.length() / 3.0, up.length() / 3.0];
            self.slab(corner, [along, up, ROOF / slope.cos() * DVec3::Y], times, tiles);
        }
        // The chimney.
        let (aside, front) = (between(draws, -0.6, 0.6) * w, 0.35 * d);
        let (bottom, top) = (eaves + 0.5 * rise, eaves + rise + between(draws, 0.5, 1.1));
        let middle = place.at(aside, 0.5 * (bottom + top), front);
        self.cuboid(&place, middle, dvec3(0.35, 0.5 * (top - bottom), 0.3), shell.walls.plain);
    }

    /// A house with a flat roof behind a parapet, and a stairwell hut on the roof.
    fn flat(&mut self, shell: Shell, draws: &mut Draws) {
        self.walls(&shell, draws);
        let ([w, d], place, top) = (shell.half, shell.place, shell.top());
        let roof = place.at(-w, top, d);
        let (along, back) =
            (place.direction(2.0 * w, 0.0, 0.0), place.direction(0.0, 0.0, -2.0 * d));
        let times = [w as f32 / 2.0, d as f32 / 2.0];
        let (gravel, concrete) = (self.materials.gravel, self.materials.concrete);
        self.model.tiled(roof, along, back, [0.0, 1.0], times, gravel);
        let [high, thick] = PARAPET.map(|side| 0.5 * side);
        for sign in [-1.0, 1.0] {
            let middle = place.at(0.0, top + high, sign * (d - thick));
            self.cuboid(&place, middle, dvec3(w, high, thick), concrete);
            let middle = place.at(sign * (w - thick), top + high, 0.0);
            self.cuboid(&place, middle, dvec3(thick, high, d - 2.0 * thick), concrete);
        }
        let hut = dvec3(1.2, 1.0, 1.0);
        let middle =
            place.at(between(draws, -0.5, 0.5) * w, top + hut.y, between(draws, -0.4, 0.4) * d);
        self.cuboid(&place, middle, hut, shell.walls.plain);
    }

    /// A balcony in every other bay of the front, on all upper floors.
    fn balconies(&mut self, shell: &Shell) {
        let ([w, d], place) = (shell.half, shell.place);
        let count = (2.0 * w / BAY).round();
        let concrete = self.materials.concrete;
        for floor in 1..shell.floors {
            for bay in (0..count as u32).skip(1).step_by(2) {
                let aside = 2.0 * w * ((f64::from(bay) + 0.5) / count - 0.5);
                let up = FLOOR * f64::from(floor) + 0.45;
                let middle = place.at(aside, up, d + 0.6);
                self.cuboid(&place, middle, dvec3(1.1, 0.5, 0.6), concrete);
            }
        }
    }
}
