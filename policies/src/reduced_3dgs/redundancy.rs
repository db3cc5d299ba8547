//! Redundancy: the number of Gaussians that share the space of a pixel, by intersecting spheres around their
//! means with ellipsoids.

use crate::neighbours::Neighbours;

/// Half the diagonal of a cube with edge 1.
const HALF_DIAGONAL: f64 = 0.866_025_403_784_438_6;
/// Maximum number of steps of Newton's method. In a million random cases with axes that differ by up to 10¹²,
/// none took more than 16.
const MAX_STEPS: u32 = 50;
/// Relative change at which Newton's method stops: some multiples of the rounding error of an f64.
const TOLERANCE: f64 = 1e-14;
/// Shortest half-axis `[scene units]`: its square is well within the range of f64, and no scene is so small.
const SHORTEST: f64 = 1e-38;
/// Longest half-axis and largest distance `[scene units]`, for the same reason.
const LONGEST: f64 = 1e38;

/// Ellipsoids and pixel sizes of all rows.
pub(super) struct Ellipsoids<'a> {
    /// Means `[scene units]`.
    pub(super) means: &'a [[f32; 3]],
    /// Natural logarithms of the standard deviations `[ln scene units]`.
    pub(super) log_scales: &'a [[f32; 3]],
    /// Quaternions (w, x, y, z) of any length but 0.
    pub(super) orientations: &'a [[f32; 4]],
    /// Smallest width of a pixel at the depth of the row `[scene units]`; not finite or not positive if no view
    /// showed the row.
    pub(super) pixel_sizes: &'a [f32],
    /// Half-axes of ellipsoids `[standard deviations]`, > 0.
    pub(super) sigmas: f64,
}

impl Ellipsoids<'_> {
    /// The redundancy of each row. A row with a pixel size has a sphere, whose count is 1 plus the number of those
    /// of its `neighbours` nearest neighbours whose ellipsoids intersect the sphere. The redundancy of a row is the
    /// smallest count among its own sphere and the spheres that its ellipsoid intersects; 1 if there is no such
    /// sphere, or if the row is not finite. Shape: `[rows]`.
    pub(super) fn redundancy(&self, neighbours: usize) -> Vec<f32> {
        let half_axes: Vec<[f64; 3]> = self.log_scales.iter().map(|s| self.half_axes(*s)).collect();
        let is_valid = |&row: &u32| {
            let row = row as usize;
            let is_rotation = self.orientations[row].iter().map(|q| q * q).sum::<f32>().is_normal();
            let fits = |value: f64| value.abs() <= LONGEST;
            is_rotation
                && half_axes[row].iter().all(|&axis| fits(axis))
                && self.means[row].iter().all(|&x| fits(x.into()))
        };
        let rows: Vec<u32> = (0..self.means.len() as u32).filter(is_valid).collect();
        let points: Vec<[f64; 3]> =
            rows.iter().map(|&row| self.means[row as usize].map(f64::from)).collect();
        let tree = Neighbours::new(&points);
        let mut redundancy = vec![f32::INFINITY; self.means.len()];
        let mut intersected = Vec::new();
        tree.for_each_nearest(neighbours, |index, nearest| {
            let (row, mean) = (rows[index], points[index]);
            let radius = HALF_DIAGONAL * f64::from(self.pixel_sizes[row as usize]);
            let has_sphere = radius > 0.0 && radius <= LONGEST;
            if !has_sphere {
                return;
            }
            intersected.clear();
            intersected.push(row);
            for other in nearest {
                let (other_row, at) = (rows[other.index as usize], points[other.index as usize]);
                let axes = half_axes[other_row as usize];
                let (short, long) =
                    (axes[0].min(axes[1]).min(axes[2]), axes[0].max(axes[1]).max(axes[2]));
                let is_farther = |reach: f64| other.square > reach * reach;
                let meets = || {
                    let from = [0, 1, 2].map(|k: usize| mean[k] - at[k]);
                    let from = rotate_back(self.orientations[other_row as usize], from);
                    sphere_meets(from, radius, axes)
                };
                // Fast tests with the inscribed and the circumscribed ball of the ellipsoid.
                if !is_farther(short + radius) || (!is_farther(long + radius) && meets()) {
                    intersected.push(other_row);
                }
            }
            for &row in &intersected {
                let known = &mut redundancy[row as usize];
                *known = known.min(intersected.len() as f32);
            }
        });
        redundancy.into_iter().map(|count| if count.is_finite() { count } else { 1.0 }).collect()
    }

    fn half_axes(&self, log_scales: [f32; 3]) -> [f64; 3] {
        log_scales.map(|log| {
            let axis = self.sigmas * f64::from(log).exp();
            // `max` would replace NaN by the limit.
            if axis < SHORTEST { SHORTEST } else { axis }
        })
    }
}

/// Rotates a vector into the frame of the quaternion (w, x, y, z) of any length but 0: R(q)ᵀ · v.
fn rotate_back(q: [f32; 4], v: [f64; 3]) -> [f64; 3] {
    let [w, x, y, z] = q.map(f64::from);
    let norm = w * w + x * x + y * y + z * z;
    // v + 2 u × (u × v − w v), u = (x, y, z): the rotation by the conjugate.
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let u = [x, y, z];
    let inner = cross(u, v);
    let outer = cross(u, [0, 1, 2].map(|k: usize| inner[k] - w * v[k]));
    [0, 1, 2].map(|k: usize| v[k] + 2.0 * outer[k] / norm)
}

/// True if the sphere around `centre` intersects the ellipsoid with these `half_axes` at the origin.
///
/// With half-axes e and the centre p outside, the ellipsoid's nearest point is eᵢ² pᵢ / (eᵢ² + t) with the
/// t >= 0 at which F(t) = Σ (eᵢ pᵢ / (eᵢ² + t))² − 1 is 0; its squared distance D(t) = t² Σ (pᵢ / (eᵢ² + t))²
/// grows with t. F is decreasing and convex, so Newton's method from below never passes the root. If D exceeds
/// the squared radius at any iterate, the sphere does not intersect the ellipsoid.
fn sphere_meets(centre: [f64; 3], radius: f64, half_axes: [f64; 3]) -> bool {
    let axes = [0, 1, 2].map(|k: usize| (half_axes[k], centre[k].abs()));
    if axes.iter().any(|(e, p)| *p > e + radius) {
        return false;
    }
    // The Minkowski sum of the ellipsoid and a ball of radius r contains the ellipsoid with half-axes e + r, as
    // √(Σ (e + r)² u²) <= √(Σ e² u²) + r for every direction u.
    if axes.iter().map(|(e, p)| (p / (e + radius)).powi(2)).sum::<f64>() <= 1.0 {
        return true;
    }
    let is_within = |t: f64| {
        axes.iter().map(|(e, p)| (t * p / (e * e + t)).powi(2)).sum::<f64>() <= radius * radius
    };
    // Bounds of the root: each term of F + 1 is at most 1 there, and no denominator is smaller than that of the
    // shortest axis.
    let mut t = axes.iter().map(|(e, p)| e * (p - e)).fold(0.0, f64::max);
    let shortest = half_axes[0].min(half_axes[1]).min(half_axes[2]);
    let upper = axes.iter().map(|(e, p)| (e * p).powi(2)).sum::<f64>().sqrt() - shortest * shortest;
    if is_within(upper.max(t)) {
        return true;
    }
    for _ in 0..MAX_STEPS {
        if !is_within(t) {
            return false;
        }
        let (mut value, mut slope) = (-1.0, 0.0);
        for (e, p) in axes {
            let term = (e * p / (e * e + t)).powi(2);
            value += term;
            slope -= 2.0 * term / (e * e + t);
        }
        let step = -value / slope;
        t += step;
        if step <= TOLERANCE * t {
            break;
        }
    }
    is_within(t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{PolicyRng, Purpose};

    const UPRIGHT: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

    /// Asserts that the distance of `centre` from the ellipsoid is `distance`.
    fn assert_distance(centre: [f64; 3], half_axes: [f64; 3], distance: f64) {
        let meets = |radius| sphere_meets(centre, radius, half_axes);
        assert!(!meets(distance * (1.0 - 1e-9)), "{centre:?} {half_axes:?} {distance}");
        assert!(meets(distance * (1.0 + 1e-9)), "{centre:?} {half_axes:?} {distance}");
    }

    #[test]
    fn distances_to_an_ellipsoid_match_values_worked_out_by_hand() {
        // Points outside a ball, beyond the ends of axes, and inside an ellipsoid.
        assert_distance([0.0, -2.0, 0.0], [1.0; 3], 1.0);
        assert_distance([2.0, 2.0, 1.0], [1.0; 3], 2.0);
        assert_distance([5.0, 0.0, 0.0], [3.0, 2.0, 1.0], 2.0);
        assert_distance([0.0, 0.0, 1.5], [3.0, 2.0, 1.0], 0.5);
        assert!(sphere_meets([1.0, 1.0, 0.5], 1e-30, [3.0, 2.0, 1.0]));
        assert!(sphere_meets([0.0; 3], 1e-30, [1e-38; 3]));
        // At (1.8, 1.6, 0) the normal of the ellipse with axes 3 and 2 is along (1.8/9, 1.6/4) = (0.2, 0.4);
        // twice this vector is √0.8 long.
        assert_distance([2.2, 2.4, 0.0], [3.0, 2.0, 1.0], 0.8_f64.sqrt());
        // A needle and a very thin disk.
        assert_distance([5.0, 1.0, 0.0], [10.0, 1e-12, 1e-12], 1.0);
        assert_distance([3.0, 0.0, 4.0], [3.0, 3.0, 1e-9], 4.0);
    }

    #[test]
    fn distances_agree_with_points_along_normals() {
        // A point on the normal at a surface point is at a known distance from the ellipsoid.
        let rng = PolicyRng::new(3, 1);
        for case in 0..2000 {
            let unit = rng.normal3(case, Purpose::Place, 0).map(f64::from);
            let length = unit.iter().map(|x| x * x).sum::<f64>().sqrt();
            let logs = rng.normal3(case, Purpose::Noise, 0).map(f64::from);
            let half_axes = logs.map(|log| (2.0 * log).exp());
            let surface = [0, 1, 2].map(|k: usize| half_axes[k] * unit[k] / length);
            let normal = [0, 1, 2].map(|k: usize| surface[k] / half_axes[k].powi(2));
            let normal_length = normal.iter().map(|x| x * x).sum::<f64>().sqrt();
            let distance = (3.0 * logs[0]).exp();
            let centre =
                [0, 1, 2].map(|k: usize| surface[k] + distance * normal[k] / normal_length);
            let meets = |radius| sphere_meets(centre, radius, half_axes);
            // Rounding matters if the surface is far from the origin and the distance small.
            let error = 1e-6 * distance + 1e-12 * half_axes.iter().fold(0.0, |a: f64, b| a.max(*b));
            assert!(!meets(distance - error) && meets(distance + error), "{case}: {centre:?}");
        }
    }

    #[test]
    fn vectors_are_rotated_back_onto_the_axes() {
        // A quarter turn about z takes the row's x axis to the scene's y axis. The quaternion has length 2.
        let half = 2.0_f32.sqrt();
        let turned = rotate_back([half, 0.0, 0.0, half], [0.0, 3.0, 5.0]);
        let expected = [3.0, 0.0, 5.0];
        assert!((0..3).all(|k| (turned[k] - expected[k]).abs() < 1e-6), "{turned:?}");
        let same = rotate_back(UPRIGHT, [1.0, 2.0, 3.0]);
        assert!(same.iter().zip(1..).all(|(x, k)| (x - f64::from(k)).abs() < 1e-12));
    }

    fn redundancy(xs: &[f32], half_axes: &[[f32; 3]], pixels: &[f32], count: usize) -> Vec<f32> {
        let means: Vec<_> = xs.iter().map(|&x| [x, 0.0, 0.0]).collect();
        let log_scales: Vec<_> =
            half_axes.iter().map(|axes| axes.map(|a| (a / 3.0).ln())).collect();
        let ellipsoids = Ellipsoids {
            means: &means,
            log_scales: &log_scales,
            orientations: &vec![UPRIGHT; xs.len()],
            pixel_sizes: pixels,
            sigmas: 3.0,
        };
        ellipsoids.redundancy(count)
    }

    #[test]
    fn redundancy_is_the_smallest_count_of_the_intersected_spheres() {
        // Balls of radius 1 at 0, 2, 4 and 20, with spheres of radius 1.1: the surface of the next ball is 1 away
        // from each mean. Counts: 2, 3, 2, 1. The second row also intersects the first row's sphere, so its redundancy
        // is 2.
        let pixel = 1.1 / 0.866_025_4;
        let xs = [0.0, 2.0, 4.0, 20.0];
        assert_eq!(redundancy(&xs, &[[1.0; 3]; 4], &[pixel; 4], 30), [2.0, 2.0, 2.0, 1.0]);
        // A radius of √3/2 is too small.
        assert_eq!(redundancy(&xs, &[[1.0; 3]; 4], &[1.0; 4], 30), [1.0; 4]);
        // Only the second row has a sphere, which counts three rows.
        let second = [0.0, pixel, f32::INFINITY, 0.0];
        assert_eq!(redundancy(&xs, &[[1.0; 3]; 4], &second, 30), [3.0, 3.0, 3.0, 1.0]);
        // One needle along the line and one across. Counts: 2, 3, 3, 2.
        let along = [[30.0, 0.01, 0.01], [1.0; 3], [1.0; 3], [0.01, 0.01, 30.0]];
        assert_eq!(redundancy(&xs, &along, &[pixel; 4], 30), [2.0, 2.0, 3.0, 2.0]);
    }

    #[test]
    fn only_the_nearest_neighbours_are_tested() {
        // Five rows at one place: with two neighbours each sphere counts three, with thirty it counts five.
        let with = |count| redundancy(&[1.0; 5], &[[1.0; 3]; 5], &[1.0; 5], count);
        assert_eq!((with(2), with(30)), (vec![3.0; 5], vec![5.0; 5]));
        assert!(redundancy(&[], &[], &[], 30).is_empty());
    }

    #[test]
    fn non_finite_rows_intersect_nothing() {
        let axes = [[1.0; 3], [1.0; 3], [f32::INFINITY; 3], [f32::NAN; 3]];
        let xs = [0.0, f32::NAN, 0.0, 0.0];
        assert_eq!(redundancy(&xs, &axes, &[1.0; 4], 30), [1.0; 4]);
        assert_eq!(redundancy(&[0.0; 2], &[[1.0; 3]; 2], &[f32::NAN, 1.0], 30), [2.0; 2]);
    }
}
