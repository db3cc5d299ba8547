//! Distances to the nearest neighbours, by a k-d tree (Bentley 1975).

/// Points in a leaf of the tree; so few are searched faster one by one.
const LEAF: usize = 8;
/// Number of neighbours.
const NEIGHBOURS: usize = 3;

/// Points, arranged so that the nearest neighbours of each are found quickly. It takes 5 bytes per point
/// beside the points.
#[derive(Debug)]
pub struct Neighbours<'a> {
    points: &'a [[f64; 3]],
    /// Each range longer than a leaf is split at its middle, along the axis in `axes` there.
    order: Vec<u32>,
    axes: Vec<u8>,
}

struct Nearest {
    point: u32,
    /// Ascending.
    squares: [f64; NEIGHBOURS],
}

impl<'a> Neighbours<'a> {
    /// Arranges at most 2³² points, whose coordinates must not be NaN.
    #[must_use]
    pub fn new(points: &'a [[f64; 3]]) -> Self {
        let mut order: Vec<u32> = (0..points.len() as u32).collect();
        let mut axes = vec![0; points.len()];
        split(points, &mut order, &mut axes);
        Self { points, order, axes }
    }

    /// Mean squared distance of a point to its three nearest others, or to all others if there are fewer;
    /// 0 if there are none.
    ///
    /// # Panics
    /// When there is no such point.
    #[must_use]
    pub fn mean_square_distance(&self, index: usize) -> f64 {
        let mut nearest = Nearest { point: index as u32, squares: [f64::INFINITY; NEIGHBOURS] };
        self.visit(0, self.points.len(), &mut nearest);
        let found = nearest.squares.iter().filter(|square| square.is_finite());
        let (count, sum) = found.fold((0.0, 0.0), |(n, sum), square| (n + 1.0, sum + square));
        if count > 0.0 { sum / count } else { 0.0 }
    }

    fn visit(&self, from: usize, to: usize, nearest: &mut Nearest) {
        if to - from <= LEAF {
            for &other in &self.order[from..to] {
                nearest.take(self.points, other);
            }
            return;
        }
        let middle = from + (to - from) / 2;
        let axis = usize::from(self.axes[middle]);
        let here = |index: u32| self.points[index as usize][axis];
        let beyond = here(nearest.point) - here(self.order[middle]);
        let (near, far) = ((from, middle), (middle + 1, to));
        let (near, far) = if beyond < 0.0 { (near, far) } else { (far, near) };
        self.visit(near.0, near.1, nearest);
        nearest.take(self.points, self.order[middle]);
        if beyond * beyond <= nearest.squares[NEIGHBOURS - 1] {
            self.visit(far.0, far.1, nearest);
        }
    }
}

fn split(points: &[[f64; 3]], order: &mut [u32], axes: &mut [u8]) {
    if order.len() <= LEAF {
        return;
    }
    let middle = order.len() / 2;
    let width = |axis: usize| {
        let at = order.iter().map(|&index| points[index as usize][axis]);
        let (low, high) =
            at.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
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

impl Nearest {
    fn take(&mut self, points: &[[f64; 3]], other: u32) {
        if other == self.point {
            return;
        }
        let (a, b) = (points[self.point as usize], points[other as usize]);
        let mut square = (0..3).map(|axis: usize| (a[axis] - b[axis]).powi(2)).sum::<f64>();
        for known in &mut self.squares {
            if square < *known {
                std::mem::swap(&mut square, known);
            }
        }
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
    fn few_points_by_hand() {
        assert!(mean_square_distances(&[]).is_empty());
        assert_eq!(mean_square_distances(&[[1.0; 3]]), [0.0]);
        let line = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]];
        // (1 + 9)/2, (1 + 4)/2, (4 + 9)/2.
        assert_eq!(mean_square_distances(&line), [5.0, 2.5, 6.5]);
        let five = [[0.0; 3], [0.0; 3], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 9.0]];
        // The three nearest of the first: 0, 1, 4.
        assert!((mean_square_distances(&five)[0] - 5.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn the_tree_agrees_with_a_full_search() {
        let rng = PolicyRng::new(1, 1);
        // Clustered, with ties and points that coincide.
        let points: Vec<[f64; 3]> = (0..700)
            .map(|i| rng.normal3(i % 650, Purpose::Place, 0))
            .map(|[x, y, z]| [x, (y * 4.0).round() / 4.0, z * 0.01].map(f64::from))
            .collect();
        let found = mean_square_distances(&points);
        for (i, a) in points.iter().enumerate() {
            let square = |b: &[f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum();
            let others = points.iter().enumerate().filter(|(j, _)| *j != i);
            let mut all: Vec<f64> = others.map(|(_, b)| square(b)).collect();
            all.sort_by(f64::total_cmp);
            let expected = all[..3].iter().sum::<f64>() / 3.0;
            assert!(
                (found[i] - expected).abs() <= 1e-12 * expected,
                "{i}: {} {expected}",
                found[i]
            );
        }
    }
}
