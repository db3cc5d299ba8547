//! Nearest neighbours of points, by a k-d tree (Bentley 1975).

/// Maximum number of points in a leaf of the tree, which is searched linearly.
const LEAF_POINTS: usize = 8;
/// Number of neighbours that distances are averaged over.
const AVERAGED: usize = 3;

/// A search structure for the nearest neighbours of points. Takes 5 bytes per point in addition to the points.
#[derive(Debug)]
pub struct Neighbours<'a> {
    points: &'a [[f64; 3]],
    /// Indices of points. Each range longer than a leaf is split at its middle element.
    order: Vec<u32>,
    /// Axis of the split at each position of `order`.
    axes: Vec<u8>,
}

/// A neighbour of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    /// Squared distance, >= 0.
    pub square: f64,
    /// Index of the neighbour.
    pub index: u32,
}

/// A search for the nearest neighbours of one point.
struct Nearest<'a> {
    /// Position of the point.
    at: [f64; 3],
    /// Index of the point, which is not its own neighbour.
    point: u32,
    /// Neighbours found so far, nearest first, followed by [`NOT_FOUND`]. At least one element.
    found: &'a mut [Neighbour],
    /// Only neighbours below this squared distance are of interest.
    bound: f64,
}

/// A placeholder for a neighbour that has not been found.
const NOT_FOUND: Neighbour = Neighbour { square: f64::INFINITY, index: u32::MAX };

impl<'a> Neighbours<'a> {
    /// Builds the tree of at most 2³² points, whose coordinates must not be NaN.
    pub fn new(points: &'a [[f64; 3]]) -> Self {
        let mut order: Vec<u32> = (0..points.len() as u32).collect();
        let mut axes = vec![0; points.len()];
        split(points, &mut order, &mut axes);
        Self { points, order, axes }
    }

    /// Mean squared distance of a point to its three nearest neighbours, or to all others if there are fewer;
    /// 0 if there are none.
    ///
    /// # Panics
    /// When `index` is not the index of a point.
    pub fn mean_square_distance(&self, index: usize) -> f64 {
        let mut buffer = [NOT_FOUND; AVERAGED];
        let found = self.nearest(index, &mut buffer).iter();
        let (count, sum) = found.fold((0.0, 0.0), |(n, sum), near| (n + 1.0, sum + near.square));
        if count > 0.0 { sum / count } else { 0.0 }
    }

    /// The nearest neighbours of a point, nearest first: as many as `buffer` holds, or all others if there are
    /// fewer. Ties are broken deterministically.
    fn nearest<'b>(&self, index: usize, buffer: &'b mut [Neighbour]) -> &'b [Neighbour] {
        self.nearest_below(index, f64::INFINITY, buffer)
    }

    /// Calls `visit` with the index of each point and its `count` nearest neighbours, nearest first. Consecutive
    /// points are near each other.
    pub fn for_each_nearest(&self, count: usize, mut visit: impl FnMut(usize, &[Neighbour])) {
        let count = count.min(self.points.len().saturating_sub(1));
        let mut buffer = vec![NOT_FOUND; count];
        let mut previous: Option<(usize, f64)> = None;
        for &index in &self.order {
            let index = index as usize;
            // By the triangle inequality, the previous point's neighbours are within this bound, with a
            // margin for rounding.
            let bound = previous.map_or(f64::INFINITY, |(previous, farthest)| {
                let moved = squared_distance(self.points[previous], self.points[index]).sqrt();
                (farthest.sqrt() + moved).powi(2) * (1.0 + 1e-9) + f64::MIN_POSITIVE
            });
            let found = self.nearest_below(index, bound, &mut buffer);
            visit(index, found);
            previous = found.last().filter(|_| found.len() == count).map(|far| (index, far.square));
        }
    }

    fn nearest_below<'b>(
        &self,
        index: usize,
        bound: f64,
        buffer: &'b mut [Neighbour],
    ) -> &'b [Neighbour] {
        buffer.fill(NOT_FOUND);
        let (at, point) = (self.points[index], index as u32);
        if !buffer.is_empty() {
            let mut nearest = Nearest { at, point, found: &mut *buffer, bound };
            self.search(0, self.points.len(), [0.0; 3], &mut nearest);
        }
        let count = buffer.iter().take_while(|other| other.square.is_finite()).count();
        &buffer[..count]
    }

    /// Searches a range of points whose box is at distance `outside` from the point of `nearest` along each axis.
    fn search(&self, from: usize, to: usize, outside: [f64; 3], nearest: &mut Nearest<'_>) {
        if to - from <= LEAF_POINTS {
            for &other in &self.order[from..to] {
                nearest.consider(self.points, other);
            }
            return;
        }
        let middle = from + (to - from) / 2;
        let axis = usize::from(self.axes[middle]);
        let beyond = nearest.at[axis] - self.points[self.order[middle] as usize][axis];
        let (near, far) = ((from, middle), (middle + 1, to));
        let (near, far) = if beyond < 0.0 { (near, far) } else { (far, near) };
        self.search(near.0, near.1, outside, nearest);
        nearest.consider(self.points, self.order[middle]);
        let mut outside = outside;
        outside[axis] = beyond;
        // Equality must not count, or coinciding points would all be visited.
        if squared_distance(outside, [0.0; 3]) < nearest.bound {
            self.search(far.0, far.1, outside, nearest);
        }
    }
}

fn squared_distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    let [x, y, z] = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    x * x + y * y + z * z
}

fn split(points: &[[f64; 3]], order: &mut [u32], axes: &mut [u8]) {
    if order.len() <= LEAF_POINTS {
        return;
    }
    let middle = order.len() / 2;
    let width = |axis: usize| {
        let xs = order.iter().map(|&index| points[index as usize][axis]);
        let (low, high) =
            xs.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        high - low
    };
    let widths = [width(0), width(1), width(2)];
    let axis = (1..3).fold(0, |best, axis| if widths[axis] > widths[best] { axis } else { best });
    order.select_nth_unstable_by(middle, |&a, &b| {
        points[a as usize][axis].total_cmp(&points[b as usize][axis]).then(a.cmp(&b))
    });
    axes[middle] = axis as u8;
    let (low, high) = order.split_at_mut(middle);
    let (low_axes, high_axes) = axes.split_at_mut(middle);
    split(points, low, low_axes);
    split(points, &mut high[1..], &mut high_axes[1..]);
}

impl Nearest<'_> {
    fn consider(&mut self, points: &[[f64; 3]], index: u32) {
        let square = squared_distance(points[index as usize], self.at);
        // False for NaN.
        let is_below = square < self.bound;
        if index == self.point || !is_below {
            return;
        }
        let last = self.found.len() - 1;
        let mut rank = last;
        while rank > 0 && square < self.found[rank - 1].square {
            self.found[rank] = self.found[rank - 1];
            rank -= 1;
        }
        self.found[rank] = Neighbour { square, index };
        self.bound = self.bound.min(self.found[last].square);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{PolicyRng, Purpose};

    fn mean_square_distances(points: &[[f64; 3]]) -> Vec<f64> {
        let tree = Neighbours::new(points);
        (0..points.len()).map(|point| tree.mean_square_distance(point)).collect()
    }

    #[test]
    fn distances_of_few_points_match_values_worked_out_by_hand() {
        assert!(mean_square_distances(&[]).is_empty());
        assert_eq!(mean_square_distances(&[[1.0; 3]]), [0.0]);
        let line = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]];
        // (1 + 9)/2, (1 + 4)/2, (4 + 9)/2.
        assert_eq!(mean_square_distances(&line), [5.0, 2.5, 6.5]);
        let five = [[0.0; 3], [0.0; 3], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 9.0]];
        // The three nearest of the first: 0, 1, 4.
        assert!((mean_square_distances(&five)[0] - 5.0 / 3.0).abs() < 1e-12);
    }

    /// Clustered points, with ties and coinciding points.
    fn clustered() -> Vec<[f64; 3]> {
        let rng = PolicyRng::new(1, 1);
        (0..700)
            .map(|i| rng.normal3(i % 650, Purpose::Place, 0))
            .map(|[x, y, z]| [x, (y * 4.0).round() / 4.0, z * 0.01].map(f64::from))
            .collect()
    }

    #[test]
    fn the_tree_agrees_with_a_full_search() {
        let points = clustered();
        let means = mean_square_distances(&points);
        for (i, a) in points.iter().enumerate() {
            let square = |b: &[f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum();
            let others = points.iter().enumerate().filter(|(j, _)| *j != i);
            let mut all: Vec<f64> = others.map(|(_, b)| square(b)).collect();
            all.sort_by(f64::total_cmp);
            let expected = all[..3].iter().sum::<f64>() / 3.0;
            let mean = means[i];
            assert!((mean - expected).abs() <= 1e-12 * expected, "{i}: {mean} {expected}");
        }
    }

    #[test]
    fn any_number_of_neighbours_is_found_nearest_first() {
        let points = clustered();
        let tree = Neighbours::new(&points);
        let square =
            |a: &[f64; 3], b: &[f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>();
        for k in [0, 1, 2, 30, 699, 900] {
            let mut buffer = vec![NOT_FOUND; k];
            let mut visits = vec![0; points.len()];
            let mut by_visit = vec![Vec::new(); points.len()];
            tree.for_each_nearest(k, |index, found| {
                visits[index] += 1;
                by_visit[index] = found.iter().map(|other| other.square).collect();
            });
            assert_eq!(visits, vec![1; points.len()]);
            for (i, a) in points.iter().enumerate().step_by(7) {
                let others = points.iter().enumerate().filter(|(j, _)| *j != i);
                let mut expected: Vec<f64> = others.map(|(_, b)| square(a, b)).collect();
                expected.sort_by(f64::total_cmp);
                expected.truncate(k);
                let found = tree.nearest(i, &mut buffer);
                let squares: Vec<f64> = found.iter().map(|other| other.square).collect();
                assert_eq!(squares, expected, "{k} neighbours of {i}");
                assert_eq!(by_visit[i], expected, "{k} neighbours of {i}, by for_each_nearest");
                for other in found {
                    let expected = square(a, &points[other.index as usize]);
                    assert_eq!(other.square.to_bits(), expected.to_bits());
                }
                let mut indices: Vec<u32> = found.iter().map(|other| other.index).collect();
                indices.sort_unstable();
                indices.dedup();
                assert!(indices.len() == found.len() && !indices.contains(&(i as u32)));
            }
        }
    }

    #[test]
    fn coinciding_points_are_not_all_visited() {
        // Visiting all pairs would take minutes.
        let points = vec![[1.0, 2.0, 3.0]; 200_000];
        let tree = Neighbours::new(&points);
        let mut buffer = [NOT_FOUND; 30];
        for index in 0..points.len() {
            let found = tree.nearest(index, &mut buffer);
            assert!(found.len() == 30 && found.iter().all(|other| other.square == 0.0));
        }
        tree.for_each_nearest(30, |_, found| assert_eq!(found.len(), 30));
    }
}
