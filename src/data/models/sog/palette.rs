//! Palettes of vectors: clusters are halved, the one with the largest error first, until there are enough (bisecting
//! k-means: Steinbach, Karypis and Kumar 2000).
//!
//! Halving takes time linear in the rows of the cluster, so the fit takes O(n log n) for n rows. Nothing is random.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// Maximum number of iterations per halving.
const ITERATIONS: usize = 4;

/// A palette, and the index of each row's entry.
pub(super) struct Palette {
    /// Shape: `[entries, width]`.
    pub(super) entries: Vec<f32>,
    /// Shape: `[rows]`.
    pub(super) labels: Vec<u32>,
}

/// The rows of one entry, as a range in the ordered list of all rows.
struct Cluster {
    error: f64,
    start: usize,
    end: usize,
}

/// Upper bound on the memory that a fit takes for each row of `width` numbers `[bytes]`: the ordered list, clusters,
/// entries, labels and sides.
pub(super) fn row_bytes(width: usize) -> usize {
    4 + size_of::<Cluster>() + 4 * width + 4 + 1
}

impl Palette {
    /// Fits at most `entries` entries to the rows of `values`; rows with more weight get closer entries.
    pub(super) fn fit(values: &[f32], width: usize, weights: &[f32], entries: usize) -> Self {
        let all = Rows { values, width, weights };
        let mut order: Vec<u32> = (0..weights.len() as u32).collect();
        let mut clusters = BinaryHeap::with_capacity(entries);
        clusters.push(all.cluster(&order, 0, order.len()));
        let mut sides = Vec::new();
        while clusters.len() < entries {
            let Some(Cluster { error, start, end }) = clusters.pop() else { break };
            let middle =
                if error > 0.0 { all.halve(&mut order[start..end], &mut sides) } else { 0 };
            if middle == 0 || middle == end - start {
                // The rows are equal, so they cannot be halved.
                clusters.push(Cluster { error: 0.0, start, end });
                if error > 0.0 {
                    continue;
                }
                break;
            }
            clusters.push(all.cluster(&order, start, start + middle));
            clusters.push(all.cluster(&order, start + middle, end));
        }
        let mut clusters = clusters.into_vec();
        clusters.sort_by_key(|cluster| cluster.start);
        let mut labels = vec![0; order.len()];
        let mut means = Vec::with_capacity(clusters.len() * width);
        for (label, cluster) in clusters.iter().enumerate() {
            let rows = &order[cluster.start..cluster.end];
            means.extend(all.mean(rows).into_iter().map(|value| value as f32));
            for &row in rows {
                labels[row as usize] = label as u32;
            }
        }
        Self { entries: means, labels }
    }
}

struct Rows<'a> {
    values: &'a [f32],
    width: usize,
    weights: &'a [f32],
}

impl Rows<'_> {
    fn row(&self, row: u32) -> &[f32] {
        &self.values[row as usize * self.width..][..self.width]
    }

    fn weight(&self, row: u32) -> f64 {
        f64::from(self.weights[row as usize])
    }

    fn mean(&self, rows: &[u32]) -> Vec<f64> {
        let (mut mean, mut total) = (vec![0.0; self.width], 0.0);
        for &row in rows {
            let weight = self.weight(row);
            total += weight;
            for (sum, &value) in mean.iter_mut().zip(self.row(row)) {
                *sum += weight * f64::from(value);
            }
        }
        mean.iter_mut().for_each(|sum| *sum /= total.max(f64::MIN_POSITIVE));
        mean
    }

    fn cluster(&self, order: &[u32], start: usize, end: usize) -> Cluster {
        let rows = &order[start..end];
        let mean = self.mean(rows);
        let square = |row: &u32| {
            let apart = self.row(*row).iter().zip(&mean).map(|(&v, m)| (f64::from(v) - m).powi(2));
            self.weight(*row) * apart.sum::<f64>()
        };
        Cluster { error: rows.iter().map(square).sum(), start, end }
    }

    /// Moves the rows of the lower half before those of the upper half; returns the number of rows in the lower half.
    fn halve(&self, rows: &mut [u32], sides: &mut Vec<bool>) -> usize {
        // The first division is at the mean of the coordinate with the largest spread.
        let mean = self.mean(rows);
        let mut spread = vec![0.0; self.width];
        for &row in rows.iter() {
            for ((sum, &value), m) in spread.iter_mut().zip(self.row(row)).zip(&mean) {
                *sum += self.weight(row) * (f64::from(value) - m).powi(2);
            }
        }
        let axis = (0..self.width).max_by(|&a, &b| spread[a].total_cmp(&spread[b])).unwrap_or(0);
        sides.clear();
        sides.extend(rows.iter().map(|&row| f64::from(self.row(row)[axis]) > mean[axis]));
        for _ in 0..ITERATIONS {
            let mean_of = |side: bool| {
                let members = rows.iter().zip(&*sides).filter(|(_, high)| **high == side);
                self.mean(&members.map(|(&row, _)| row).collect::<Vec<_>>())
            };
            let (low, high) = (mean_of(false), mean_of(true));
            // A plane separates the points nearer to one mean from those nearer to the other.
            let normal: Vec<f32> = low.iter().zip(&high).map(|(l, h)| (h - l) as f32).collect();
            let middle =
                low.iter().zip(&high).map(|(l, h)| 0.5 * (h + l) * (h - l)).sum::<f64>() as f32;
            let mut moved = false;
            for (&row, side) in rows.iter().zip(sides.iter_mut()) {
                let along: f32 = self.row(row).iter().zip(&normal).map(|(v, n)| v * n).sum();
                moved |= *side != (along > middle);
                *side = along > middle;
            }
            if !moved {
                break;
            }
        }
        // The order within each half does not change.
        let mut high = Vec::new();
        let mut count = 0;
        for index in 0..rows.len() {
            if sides[index] {
                high.push(rows[index]);
            } else {
                rows[count] = rows[index];
                count += 1;
            }
        }
        rows[count..].copy_from_slice(&high);
        count
    }
}

impl Ord for Cluster {
    fn cmp(&self, other: &Self) -> Ordering {
        // Ties go to the first cluster in the list, so that the result is reproducible.
        self.error.total_cmp(&other.error).then(other.start.cmp(&self.start))
    }
}

impl PartialOrd for Cluster {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Cluster {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Cluster {}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows around four corners of a square, in turn.
    fn corners() -> Vec<f32> {
        let offset = |i: usize| 0.01 * ((i * 7919 % 101) as f32 / 101.0 - 0.5);
        (0..400)
            .flat_map(|i| [(i & 1) as f32 + offset(i), (i >> 1 & 1) as f32 + offset(i + 400)])
            .collect()
    }

    #[test]
    fn every_cluster_gets_an_entry() {
        let values = corners();
        let Palette { entries, labels } = Palette::fit(&values, 2, &[1.0; 400], 4);
        assert_eq!(entries.len(), 8);
        for (row, &label) in labels.iter().enumerate() {
            for axis in 0..2 {
                let gap = values[2 * row + axis] - entries[2 * label as usize + axis];
                assert!(gap.abs() < 0.011, "row {row}: {gap}");
            }
        }
    }

    #[test]
    fn a_palette_with_an_entry_per_row_is_exact_and_equal_rows_share_one() {
        let values = corners();
        let all = Palette::fit(&values, 2, &[1.0; 400], 1000);
        for (row, &label) in all.labels.iter().enumerate() {
            let entry = &all.entries[2 * label as usize..][..2];
            assert!((entry[0] - values[2 * row]).abs() < 1e-6, "row {row}");
        }
        let same = Palette::fit(&[0.25; 90], 3, &[1.0; 30], 8);
        assert_eq!((same.entries, same.labels), (vec![0.25; 3], vec![0; 30]));
    }

    #[test]
    fn rows_with_more_weight_get_closer_entries() {
        // Two entries for three values: the two with more weight get one each.
        let values = [0.0f32, 1.0, 1.4];
        let found = |weights: [f32; 3]| {
            let palette = Palette::fit(&values, 1, &weights, 2);
            (palette.entries[palette.labels[0] as usize] - values[0]).abs()
        };
        assert!(found([1.0, 1.0, 1.0]) < 1e-6);
        assert!(found([1e-4, 1.0, 1.0]) > 0.5, "{}", found([1e-4, 1.0, 1.0]));
    }
}
