//! Triangulates polygons by ear clipping.

use earcut::Earcut;
use earcut::utils3d::project3d_to_2d;
use glam::DVec3;

/// Maximum number of corners for ear clipping, whose worst case is cubic; larger polygons are assumed to be
/// convex.
const MAX_EARS: usize = 256;

/// The triangles of a polygon as indices of its corners, with the polygon's winding.
pub(super) fn triangulate(corners: &[DVec3]) -> Vec<[usize; 3]> {
    let count = corners.len();
    if count == 3 {
        return vec![[0, 1, 2]];
    }
    // earcut starts at the last corner, so the polygon's first corner is put last.
    let ring: Vec<usize> = (1..count).chain([0]).collect();
    // Relative positions, as rounding far from the origin would distort the plane.
    let places: Vec<[f64; 3]> =
        ring.iter().map(|&i| (corners[i] - corners[ring[0]]).to_array()).collect();
    let (mut projected, mut ears) = (Vec::new(), Vec::<usize>::new());
    if count <= MAX_EARS && project3d_to_2d(&places, count, &mut projected) {
        Earcut::new().earcut_slice(&projected, &[], &mut ears);
    }
    // If the projection crosses itself, there may be too few ears.
    if ears.len() >= 6 {
        ears.chunks_exact(3).map(|t| [t[0], t[1], t[2]].map(|i| ring[i])).collect()
    } else {
        ring[1..].windows(2).map(|edge| [ring[0], edge[0], edge[1]]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn concave_polygons_keep_their_area() {
        // An L of area 3, starting at any corner, with either winding, in an oblique plane, near and far.
        let l = [(0., 0.), (2., 0.), (2., 1.), (1., 1.), (1., 2.), (0., 2.)];
        for case in 0..24 {
            let (is_reversed, is_far) = (case / 6 % 2 == 1, case / 12 == 1);
            let shift = if is_far { DVec3::new(1e6, -1e6, 1e6) } else { DVec3::ZERO };
            let corner = |(x, y)| shift + DVec3::new(x, y, 0.5 * x + y);
            let mut corners: Vec<DVec3> = (0..6).map(|i| corner(l[(i + case) % 6])).collect();
            if is_reversed {
                corners.reverse();
            }
            let normal = DVec3::new(-0.5, -1.0, 1.0) * if is_reversed { -1.0 } else { 1.0 };
            let triangles = triangulate(&corners);
            let areas = triangles.iter().map(|t| {
                let [a, b, c] = t.map(|i| corners[i]);
                0.5 * (b - a).cross(c - a).dot(normal.normalize())
            });
            assert_eq!(triangles.len(), 4);
            assert!(areas.clone().all(|area| area > 0.0), "{triangles:?}");
            assert!((areas.sum::<f64>() - 3.0 * normal.length()).abs() < 1e-9);
        }
    }

    #[test]
    fn degenerate_polygons_give_triangles() {
        let bow = [(0., 0.), (1., 1.), (1., 0.), (0., 1.)].map(|(x, y)| DVec3::new(x, y, 0.0));
        let huge = bow.map(|p| 1e308 * p * if p.x > 0.0 { 1.0 } else { -1.0 });
        for corners in [&[DVec3::ONE; 5][..], &bow, &huge, &[DVec3::X; 300]] {
            let triangles = triangulate(corners);
            assert!((1..=corners.len() - 2).contains(&triangles.len()), "{triangles:?}");
        }
    }
}
