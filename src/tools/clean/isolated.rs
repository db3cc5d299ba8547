//! Finds groups of Gaussians far from all others, by connected cells of a grid.
//!
//! Cells grow with the distance from the middle of the model, as the Gaussians of a background are far from each other:
//! space beyond the inner four fifths is contracted as in Mip-NeRF 360 (Barron et al. 2022, equation 10).

use std::collections::HashMap;

use densify_core::gaussians::Gaussians;
use densify_data::dataset::normalise::Normalisation;
use glam::{DQuat, DVec3};

use densify_train::in_front::RowWeights;

/// Side of a cell, in radii of the sphere around four fifths of the Gaussians.
const CELL: f64 = 1.0 / 32.0;
/// A Gaussian fills the cells up to this many standard deviations along its axes.
const REACH: f64 = 2.0;
/// The most cells filled each way along an axis.
const MOST_STEPS: f64 = 4.0;

type Cell = [i32; 3];

/// Cells that Gaussians fill, and the component of each.
#[derive(Default)]
struct Cells {
    numbers: HashMap<Cell, u32>,
    places: Vec<Cell>,
    parents: Vec<u32>,
}

/// The rows among `rows` whose connected group has less than `limit` of the weight. Cells are connected if they touch.
pub(super) fn find(
    model: &Gaussians,
    rows: &[usize],
    weights: &[RowWeights],
    limit: f64,
) -> Vec<usize> {
    let to_unit = Normalisation::fit_model(model);
    let mut cells = Cells::default();
    let own: Vec<u32> = rows
        .iter()
        .map(|&row| {
            let place = to_unit.scene_from_world(DVec3::from(model.position(row)));
            let own = cells.number(place);
            for step in extent(model, row, to_unit.scale) {
                // Cells that one Gaussian fills are connected.
                let other = cells.number(place + step);
                cells.join(own, other);
            }
            own
        })
        .collect();
    cells.join_touching();
    let mut sums = vec![0.0; cells.places.len()];
    for (&row, &cell) in rows.iter().zip(&own) {
        sums[cells.root(cell) as usize] += weights[row].whole;
    }
    let is_small = |(_, cell): &(&usize, &u32)| sums[cells.root_of(**cell) as usize] < limit;
    rows.iter().zip(&own).filter(is_small).map(|(&row, _)| row).collect()
}

/// Steps from the mean of a Gaussian to the cells that it fills, in radii.
fn extent(model: &Gaussians, row: usize, scale: f64) -> Vec<DVec3> {
    let [w, x, y, z] = model.quats[row].map(f64::from);
    let quat = DQuat::from_xyzw(x, y, z, w);
    let quat = if quat.length_squared() > 0.0 { quat.normalize() } else { DQuat::IDENTITY };
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().zip(model.log_scales[row]);
    let along = axes.flat_map(|(axis, log_scale)| {
        let reach = REACH * f64::from(log_scale).exp() * scale;
        let steps = (reach / CELL).round().min(MOST_STEPS);
        let step = move |number: u32| f64::from(number) / steps * reach * (quat * axis);
        (1..=steps as u32).flat_map(move |number| [step(number), -step(number)])
    });
    along.collect()
}

/// Contracts all space into a sphere of radius 2; the inside of the unit sphere stays as it is.
fn contract(place: DVec3) -> DVec3 {
    let length = place.length();
    if length <= 1.0 { place } else { place * ((2.0 - 1.0 / length) / length) }
}

impl Cells {
    /// The number of the cell at a place, in radii.
    fn number(&mut self, place: DVec3) -> u32 {
        let cell = (contract(place) / CELL).floor().to_array().map(|at| at as i32);
        let next = self.places.len() as u32;
        let number = *self.numbers.entry(cell).or_insert(next);
        if number == next {
            self.places.push(cell);
            self.parents.push(next);
        }
        number
    }

    fn join_touching(&mut self) {
        for number in 0..self.places.len() {
            let [x, y, z] = self.places[number];
            for i in 0..27 {
                let beside = [x + i % 3 - 1, y + i / 3 % 3 - 1, z + i / 9 - 1];
                if let Some(&other) = self.numbers.get(&beside) {
                    self.join(number as u32, other);
                }
            }
        }
    }

    fn root_of(&self, mut cell: u32) -> u32 {
        while self.parents[cell as usize] != cell {
            cell = self.parents[cell as usize];
        }
        cell
    }

    /// As [`root_of`](Self::root_of); shortens the path.
    fn root(&mut self, mut cell: u32) -> u32 {
        let root = self.root_of(cell);
        while self.parents[cell as usize] != root {
            cell = std::mem::replace(&mut self.parents[cell as usize], root);
        }
        root
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.parents[a.max(b) as usize] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(places: &[[f32; 3]], log_scale: f32) -> Gaussians {
        let mut model = Gaussians::zeros(places.len(), 0);
        model.means.copy_from_slice(places);
        model.log_scales.fill([log_scale; 3]);
        model.quats.fill([1.0, 0.0, 0.0, 0.0]);
        model
    }

    #[test]
    fn large_gaussians_bridge_gaps_and_background_is_connected() {
        let line: Vec<[f32; 3]> = (0..200).map(|i| [i as f32 * 0.01 - 1.0, 0.0, 0.0]).collect();
        let isolated = |others: &[[f32; 3]], log_scale: f32| {
            let places = [&line, others].concat();
            let model = at(&places, log_scale);
            let rows: Vec<usize> = (0..places.len()).collect();
            let weights = vec![RowWeights { in_front: 0.0, whole: 1.0 }; places.len()];
            find(&model, &rows, &weights, 5.0)
        };
        assert_eq!(isolated(&[[0.0, 0.2, 0.0]], -7.0), [200]);
        // With a standard deviation of 0.1, they overlap.
        assert_eq!(isolated(&[[0.0, 0.2, 0.0]], -2.3), [0; 0]);
        // Far from the middle, the same gaps are small.
        let far: Vec<[f32; 3]> = (0..20).map(|i| [0.0, 10.0 + 2.0 * i as f32, 0.0]).collect();
        assert_eq!(isolated(&far, -7.0), [0; 0]);
        let far: Vec<[f32; 3]> = (0..20).map(|i| [0.0, 1.1, 2.0 * i as f32]).collect();
        assert!(!isolated(&far[..4], -7.0).is_empty());
    }
}
