//! Everything in a town except houses: gardens, a park, trees, cars and lamps.

use glam::{DVec3, dvec3};

use super::houses::{between, one_of};
use super::{HALF_BLOCK, HALF_STREET, LocalFrame, MEADOW, PITCH, Town, street_at};
use crate::random::Draws;

/// Distance of parked cars from the street's centre line.
const PARKED: f64 = 2.5;
/// Distance of lamps from the street's centre line.
const LAMPS: f64 = 4.1;

impl Town {
    /// A tree behind a house, with a probability of 85 %; `aside` is the house's position along its side of the block.
    pub(super) fn garden(&mut self, side: &LocalFrame, aside: f64, draws: &mut Draws) {
        if draws.unit64() < 0.85 {
            let at = [between(draws, -2.0, 2.0), between(draws, 3.0, 4.6)];
            self.tree(side.at(aside + at[0], 0.0, at[1]), [1.3, 2.1], draws);
        }
    }

    /// Lawns, paths around a fountain, and trees.
    pub(super) fn park(&mut self, middle: DVec3, draws: &mut Draws) {
        let (lawn, stone) = (self.materials.park, self.materials.concrete);
        self.level(middle, [HALF_BLOCK; 2], [1.0; 2], lawn);
        self.model.cylinder(middle, middle + 0.5 * DVec3::Y, 2.2, 24, stone);
        self.model.cylinder(middle + 0.5 * DVec3::Y, middle + 2.0 * DVec3::Y, 0.3, 12, stone);
        self.model.sphere(middle + 2.3 * DVec3::Y, 0.55, 2, stone);
        for cell in 0..36_u32 {
            let place = [f64::from(cell % 6) - 2.5, f64::from(cell / 6) - 2.5]
                .map(|at| 6.0 * at + between(draws, -0.7, 0.7));
            // No tree stands near the fountain or on the path around it.
            let out = place[0].hypot(place[1]);
            if draws.unit64() < 0.7 && !(5.5..10.5).contains(&out) && out > 5.5 {
                self.tree(middle + dvec3(place[0], 0.0, place[1]), [1.5, 2.4], draws);
            }
        }
    }

    /// A tree on the ground, with a crown radius in the given range.
    pub(super) fn tree(&mut self, foot: DVec3, [low, high]: [f64; 2], draws: &mut Draws) {
        let radius = between(draws, low, high);
        let slender = draws.unit64() < 0.25;
        let (wide, tall) = if slender {
            (0.6 * radius, 1.7 * radius)
        } else {
            (radius, radius * between(draws, 0.85, 1.2))
        };
        let stem = between(draws, 1.7, 2.6);
        let (material, bark) = (one_of(draws, &self.materials.crowns), self.materials.bark);
        let middle = foot + (stem + 0.9 * tall) * DVec3::Y;
        self.model.cylinder(foot, middle, 0.16, 7, bark);
        let lumps = draws.bits();
        self.model.ball(2, material, |out| {
            // Equal corners of neighbouring triangles have identical directions, so they get the same lump.
            let lump = Draws::new(lumps, &out.to_array().map(f64::to_bits)).unit64();
            let stretch = dvec3(wide, tall, wide);
            (middle + (0.8 + 0.25 * lump) * out * stretch, (out / stretch).normalize())
        });
    }

    /// Parked cars and a lamp on each side of every street section.
    pub(super) fn furnish_streets(&mut self, size: u32, seed: u64) {
        for column in 0..=size {
            for row in 0..=size {
                let at = dvec3(street_at(size, column), 0.0, street_at(size, row));
                let sections = [(row < size, DVec3::Z), (column < size, DVec3::X)];
                for (_, ahead) in sections.into_iter().filter(|(exists, _)| *exists) {
                    let key = [u64::from(column), u64::from(row), u64::from(ahead.x > 0.0)];
                    let mut draws = Draws::new(seed ^ 0x0073_7472_6565_7473, &key);
                    let street = at + 0.5 * PITCH * ahead;
                    for ahead in [ahead, -ahead] {
                        self.furnish(&LocalFrame::facing(street, ahead), &mut draws);
                    }
                }
            }
        }
    }

    /// Cars and a lamp on the right side of a street section between two crossings.
    fn furnish(&mut self, street: &LocalFrame, draws: &mut Draws) {
        for slot in 0..5 {
            let ahead = 7.0 * (f64::from(slot) - 2.0) + between(draws, -0.6, 0.6);
            if draws.unit64() < 0.45 {
                self.car(&LocalFrame::facing(street.at(PARKED, 0.0, ahead), street.front), draws);
            }
        }
        let foot = street.at(LAMPS, 0.0, between(draws, -12.0, 12.0));
        let (pole, globe) = (self.materials.pole, self.materials.globe);
        self.model.cylinder(foot, foot + 4.2 * DVec3::Y, 0.06, 8, pole);
        self.model.sphere(foot + 4.4 * DVec3::Y, 0.25, 1, globe);
    }

    fn car(&mut self, place: &LocalFrame, draws: &mut Draws) {
        let (coat, glass) = (one_of(draws, &self.materials.car_paint), self.materials.glass);
        let rubber = self.materials.rubber;
        self.cuboid(place, place.at(0.0, 0.65, 0.0), dvec3(0.85, 0.35, 2.1), coat);
        self.cuboid(place, place.at(0.0, 1.2, -0.25), dvec3(0.72, 0.2, 1.15), glass);
        self.cuboid(place, place.at(0.0, 1.43, -0.25), dvec3(0.74, 0.03, 1.05), coat);
        for (aside, ahead) in [(-0.8, -1.3), (0.8, -1.3), (-0.8, 1.3), (0.8, 1.3)] {
            let [inner, outer] = [0.85, 1.1].map(|share| place.at(share * aside, 0.33, ahead));
            self.model.cylinder(inner, outer, 0.33, 10, rubber);
        }
    }

    /// Trees around the town.
    pub(super) fn plant_meadow(&mut self, size: u32, seed: u64) {
        let mut draws = Draws::new(seed, &[0x6d65_6164_6f77]);
        let edge = street_at(size, size) + HALF_STREET;
        for front in [DVec3::Z, DVec3::X, DVec3::NEG_Z, DVec3::NEG_X] {
            let side = LocalFrame::facing(DVec3::ZERO, front);
            for tree in 0..3 * size {
                let share = (f64::from(tree) + between(&mut draws, 0.2, 0.8)) / f64::from(3 * size);
                let away = edge + between(&mut draws, 0.15, 0.85) * MEADOW;
                self.tree(side.at((2.0 * share - 1.0) * edge, 0.0, away), [1.6, 2.6], &mut draws);
            }
        }
    }
}
