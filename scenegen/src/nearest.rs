//! Nearest points of a surface, by branch and bound in the tree that is also used for rays.

use glam::{DVec3, Vec3};

use crate::surface::Surface;

/// The point of a surface nearest to a given point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// Distance `[world units]`.
    pub distance: f64,
    /// The nearest point, world coordinates.
    pub point: DVec3,
    /// Index of the triangle that contains the nearest point, in the model.
    pub triangle: u32,
}

impl Surface {
    /// The surface's point nearest to `p`.
    pub fn nearest(&self, p: DVec3) -> Nearest {
        let (slot, point, distance) = self.nearest_local(self.local_from_world(p));
        Nearest {
            distance: distance / self.scale(),
            point: self.world_from_local(point),
            triangle: self.triangle_of(slot),
        }
    }

    /// Slot of the triangle (its place in the tree's leaves), nearest point and distance, in local coordinates. Of
    /// several triangles at the same distance, the first in the model is used.
    #[expect(clippy::float_cmp, reason = "ties are exact: the same triangle twice")]
    fn nearest_local(&self, p: DVec3) -> (u32, DVec3, f64) {
        let nodes = &self.bvh.nodes;
        let bound = |index: u32| {
            let bounds = nodes[index as usize].aabb();
            let (lo, hi) = (bounds.min.as_dvec3(), bounds.max.as_dvec3());
            (lo - p).max(p - hi).max(DVec3::ZERO).length_squared()
        };
        let mut best = (0_u32, DVec3::ZERO, f64::INFINITY);
        let mut open = vec![(0.0_f64, 0_u32)];
        while let Some((squared_bound, index)) = open.pop() {
            if squared_bound > best.2 {
                continue;
            }
            let node = &nodes[index as usize];
            if !node.is_leaf() {
                let [a, b] =
                    [node.first_index, node.first_index + 1].map(|child| (bound(child), child));
                // The nearer child is visited first.
                open.extend(if a.0 < b.0 { [b, a] } else { [a, b] });
                continue;
            }
            for slot in node.first_index..node.first_index + node.prim_count {
                let corners = self.triangles[slot as usize].map(Vec3::as_dvec3);
                let point = nearest_on_triangle(p, corners);
                let squared = point.distance_squared(p);
                let earlier = || self.triangle_of(slot) < self.triangle_of(best.0);
                if squared < best.2 || (squared == best.2 && earlier()) {
                    best = (slot, point, squared);
                }
            }
        }
        (best.0, best.1, best.2.sqrt())
    }
}

/// The triangle's point nearest to `p` (Ericson, "Real-Time Collision Detection", 5.1.5). A triangle without
/// area is treated as its sides.
pub(crate) fn nearest_on_triangle(p: DVec3, [a, b, c]: [DVec3; 3]) -> DVec3 {
    let (ab, ac) = (b - a, c - a);
    let normal = ab.cross(ac);
    let area = normal.length_squared();
    // Barycentric weights of the projection onto the plane, which is the nearest point if it is inside.
    if area > 0.0 {
        let ap = p - a;
        let w = ab.cross(ap).dot(normal) / area;
        let v = ap.cross(ac).dot(normal) / area;
        if v >= 0.0 && w >= 0.0 && v + w <= 1.0 {
            return a + v * ab + w * ac;
        }
    }
    let candidates =
        [nearest_on_segment(p, a, b), nearest_on_segment(p, b, c), nearest_on_segment(p, c, a)];
    let nearer = |x: &DVec3, y: &DVec3| x.distance_squared(p).total_cmp(&y.distance_squared(p));
    candidates.into_iter().min_by(nearer).unwrap_or(a)
}

fn nearest_on_segment(p: DVec3, a: DVec3, b: DVec3) -> DVec3 {
    let side = b - a;
    let length = side.length_squared();
    let share = if length > 0.0 { ((p - a).dot(side) / length).clamp(0.0, 1.0) } else { 0.0 };
    a + share * side
}
