//! Small systems of linear equations.

/// Solves a·x = b for a symmetric positive definite matrix by Cholesky's method; `None` if it is not.
pub fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> Option<[f64; N]> {
    for i in 0..N {
        for j in 0..=i {
            let dot: f64 = (0..j).map(|k| a[i][k] * a[j][k]).sum();
            let rest = a[i][j] - dot;
            // Rounding can make a singular matrix look definite.
            let is_definite = rest > 1e-14 * a[i][i].abs();
            if i == j && !is_definite {
                return None;
            }
            a[i][j] = if i == j { rest.sqrt() } else { rest / a[j][j] };
        }
    }
    for i in 0..N {
        let dot: f64 = (0..i).map(|k| a[i][k] * b[k]).sum();
        b[i] = (b[i] - dot) / a[i][i];
    }
    for i in (0..N).rev() {
        let dot: f64 = (i + 1..N).map(|k| a[k][i] * b[k]).sum();
        b[i] = (b[i] - dot) / a[i][i];
    }
    Some(b)
}

/// Normal equations of a least-squares problem with N unknowns.
#[derive(Debug, Clone)]
pub struct NormalEquations<const N: usize> {
    matrix: [[f64; N]; N],
    right: [f64; N],
}

impl<const N: usize> Default for NormalEquations<N> {
    fn default() -> Self {
        Self { matrix: [[0.0; N]; N], right: [0.0; N] }
    }
}

impl<const N: usize> NormalEquations<N> {
    /// Adds the equation row·x = value with a weight.
    pub fn add(&mut self, row: [f64; N], value: f64, weight: f64) {
        for ((to, right), x) in self.matrix.iter_mut().zip(&mut self.right).zip(row) {
            for (to, other) in to.iter_mut().zip(row) {
                *to += weight * x * other;
            }
            *right += weight * x * value;
        }
    }

    /// The matrix and the right-hand side.
    pub fn parts(&self) -> (&[[f64; N]; N], &[f64; N]) {
        (&self.matrix, &self.right)
    }

    /// The solution, with `damping` of the diagonal added to it; `None` if the unknowns are not determined.
    pub fn solution(&self, damping: f64) -> Option<[f64; N]> {
        let mut matrix = self.matrix;
        for (i, row) in matrix.iter_mut().enumerate() {
            row[i] *= 1.0 + damping;
        }
        solve(matrix, self.right)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn least_squares_are_solved_and_singular_systems_recognised() {
        let mut equations = NormalEquations::<3>::default();
        let truth = [2.0, -1.0, 0.5];
        let rows = [[1.0, 2.0, 0.0], [0.0, 1.0, 3.0], [2.0, 0.0, 1.0], [1.0, 1.0, 1.0]];
        for row in rows {
            let value = row.iter().zip(truth).map(|(a, x)| a * x).sum();
            equations.add(row, value, 0.7);
        }
        let found = equations.solution(0.0).unwrap();
        assert!(found.iter().zip(truth).all(|(a, b)| (a - b).abs() < 1e-12), "{found:?}");
        let mut flat = NormalEquations::<2>::default();
        flat.add([1.0, 2.0], 1.0, 1.0);
        flat.add([2.0, 4.0], 2.0, 1.0);
        assert_eq!(flat.solution(0.0), None);
        assert_eq!(solve([[f64::NAN]], [1.0]), None);
    }
}
