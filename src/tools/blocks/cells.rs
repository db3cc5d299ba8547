//! Divides the ground into cells of equal work: strips along the first axis, each cut along the second axis.

use serde::{Deserialize, Serialize};

/// A rectangle on the ground. The outermost cells are unbounded, so that the cells cover the whole plane.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cell {
    /// Lower bounds along both axes of the ground, inclusive `[world units]`.
    pub low: [f64; 2],
    /// Upper bounds along both axes of the ground, exclusive `[world units]`.
    pub high: [f64; 2],
}

impl Cell {
    /// The whole ground.
    pub(super) const ALL: Self = Self { low: [f64::NEG_INFINITY; 2], high: [f64::INFINITY; 2] };

    /// True if a point lies in the cell.
    pub fn contains(&self, point: [f64; 2]) -> bool {
        (0..2).all(|axis| self.low[axis] <= point[axis] && point[axis] < self.high[axis])
    }

    /// The cell with a margin on all sides.
    pub fn widened(&self, margin: [f64; 2]) -> Self {
        let low = [0, 1].map(|axis| self.low[axis] - margin[axis]);
        Self { low, high: [0, 1].map(|axis| self.high[axis] + margin[axis]) }
    }
}

/// Divides the ground into `strips` × `across` cells that share the points' work evenly, strip by strip.
pub(super) fn divide(points: &[[f64; 2]], work: &[f64], [strips, across]: [usize; 2]) -> Vec<Cell> {
    let strips = cut(Cell::ALL, 0, points, work, strips).into_iter();
    strips.flat_map(|strip| cut(strip, 1, points, work, across)).collect()
}

/// Cuts a cell along an axis into a number of parts of equal work.
fn cut(cell: Cell, axis: usize, points: &[[f64; 2]], work: &[f64], parts: usize) -> Vec<Cell> {
    let mut order: Vec<usize> = (0..points.len()).filter(|&i| cell.contains(points[i])).collect();
    order.sort_by(|&a, &b| points[a][axis].total_cmp(&points[b][axis]));
    let total: f64 = order.iter().map(|&i| work[i]).sum();
    let mut borders = Vec::with_capacity(parts + 1);
    borders.push(cell.low[axis]);
    let mut sum = 0.0;
    for pair in order.windows(2) {
        sum += work[pair[0]];
        // Several borders may fall between two points. The planner rejects the empty parts between them.
        while borders.len() < parts && sum * parts as f64 >= total * borders.len() as f64 {
            borders.push(0.5 * (points[pair[0]][axis] + points[pair[1]][axis]));
        }
    }
    let last = if borders.len() > 1 { borders[borders.len() - 1] } else { cell.high[axis] };
    borders.resize(parts, last);
    borders.push(cell.high[axis]);
    let part = |border: &[f64]| {
        let mut part = cell;
        [part.low[axis], part.high[axis]] = [border[0], border[1]];
        part
    };
    borders.windows(2).map(part).collect()
}
