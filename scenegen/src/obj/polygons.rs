//! Cuts polygons into triangles by ear clipping.

use earcut::Earcut;
use earcut::utils3d::project3d_to_2d;
use glam::DVec3;

/// Corners up to which a polygon is cut ear by ear, which in the worst case takes the cube of their
/// number; larger ones are taken as convex.
const MAX_EARS: usize = 256;

/// The triangles of a polygon, by its corners' places in the list, wound as it is.
pub(super) fn cut(corners: &[DVec3]) -> Vec<[usize; 3]> {
    let count = corners.len();
    if count == 3 {
        return vec![[0, 1, 2]];
    }
    // earcut begins with the last corner: this makes it the polygon's first.
    let ring: Vec<usize> = (1..count).chain([0]).collect();
    // Far from the origin, the plane would be lost in rounding.
    let places: Vec<[f64; 3]> =
        ring.iter().map(|&i| (corners[i] - corners[ring[0]]).to_array()).collect();
    let (mut projected, mut ears) = (Vec::new(), Vec::<usize>::new());
    if count <= MAX_EARS && project3d_to_2d(&places, count, &mut projected) {
        Earcut::new().earcut_slice(&projected, &[], &mut ears);
    }
    // Two triangles at least, even where the projection crosses itself.
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
        // An L of area 3, begun at any corner, wound either way, in an oblique plane, near and far.
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
            let triangles = cut(&corners);
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
    fn degenerate_polygons_are_cut_somehow() {
        let bow = [(0., 0.), (1., 1.), (1., 0.), (0., 1.)].map(|(x, y)| DVec3::new(x, y, 0.0));
        let huge = bow.map(|p| 1e308 * p * if p.x > 0.0 { 1.0 } else { -1.0 });
        for corners in [&[DVec3::ONE; 5][..], &bow, &huge, &[DVec3::X; 300]] {
            let triangles = cut(corners);
            assert!((1..=corners.len() - 2).contains(&triangles.len()), "{triangles:?}");
        }
    }
}
