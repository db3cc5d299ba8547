//! Cuts the ground into cells of equal work: strips along the first axis, each cut along the second.

use serde::{Deserialize, Serialize};

/// A rectangle on the ground; the outermost cells have no outer border, so that cells cover all of it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cell {
    /// Least coordinates, inclusive.
    pub low: [f64; 2],
    /// Largest coordinates, exclusive.
    pub high: [f64; 2],
}

impl Cell {
    /// The whole ground.
    pub(super) const ALL: Self = Self { low: [f64::NEG_INFINITY; 2], high: [f64::INFINITY; 2] };

    /// Whether a point lies in it.
    #[must_use]
    pub fn has(&self, at: [f64; 2]) -> bool {
        (0..2).all(|axis| self.low[axis] <= at[axis] && at[axis] < self.high[axis])
    }

    /// The cell with a margin around it.
    #[must_use]
    pub fn widened(&self, margin: [f64; 2]) -> Self {
        let low = [0, 1].map(|axis| self.low[axis] - margin[axis]);
        Self { low, high: [0, 1].map(|axis| self.high[axis] + margin[axis]) }
    }
}

/// Strips along the first axis, cells in each; the cells strip by strip.
pub(super) fn cells(at: &[[f64; 2]], work: &[f64], [strips, across]: [usize; 2]) -> Vec<Cell> {
    let all: Vec<usize> = (0..at.len()).collect();
    let mut cells = Vec::with_capacity(strips * across);
    for strip in cut(Cell::ALL, 0, &all, at, work, strips) {
        let inside: Vec<usize> = all.iter().copied().filter(|&i| strip.has(at[i])).collect();
        cells.extend(cut(strip, 1, &inside, at, work, across));
    }
    cells
}

/// Cuts a cell along an axis so that its parts have the same work.
fn cut(
    cell: Cell,
    axis: usize,
    points: &[usize],
    at: &[[f64; 2]],
    work: &[f64],
    parts: usize,
) -> Vec<Cell> {
    let mut order = points.to_vec();
    order.sort_by(|&a, &b| at[a][axis].total_cmp(&at[b][axis]));
    let total: f64 = order.iter().map(|&i| work[i]).sum();
    let mut borders = Vec::with_capacity(parts.saturating_sub(1));
    let mut sum = 0.0;
    for pair in order.windows(2) {
        sum += work[pair[0]];
        // Several borders may fall between two points; then parts are empty, which is found later.
        while borders.len() + 1 < parts && sum * parts as f64 >= total * (borders.len() + 1) as f64
        {
            borders.push(0.5 * (at[pair[0]][axis] + at[pair[1]][axis]));
        }
    }
    borders.resize(parts - 1, borders.last().copied().unwrap_or(cell.high[axis]));
    let lows = std::iter::once(cell.low[axis]).chain(borders.iter().copied());
    let highs = borders.iter().copied().chain([cell.high[axis]]);
    lows.zip(highs)
        .map(|(low, high)| {
            let mut part = cell;
            part.low[axis] = low;
            part.high[axis] = high;
            part
        })
        .collect()
}
