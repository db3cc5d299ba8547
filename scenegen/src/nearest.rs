//! Finds the surface's nearest point, by branch and bound in the tree that rays use.

use glam::{DVec3, Vec3};

use crate::surface::Surface;

/// The surface's point nearest to a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// Distance `[world units]`.
    pub distance: f64,
    /// The nearest point, world coordinates.
    pub point: DVec3,
    /// Number of its triangle in the model.
    pub triangle: u32,
}

impl Surface {
    /// The surface's nearest point.
    #[must_use]
    pub fn nearest(&self, place: DVec3) -> Nearest {
        let (slot, point, distance) = self.nearest_local(self.local_from_world(place));
        Nearest {
            distance: distance / self.scale(),
            point: self.world_from_local(point),
            triangle: self.triangle_of(slot),
        }
    }

    /// The triangle (by its place in leaf order), its nearest point and the distance, all local. Of
    /// several triangles at the same distance, the model's first.
    #[expect(clippy::float_cmp, reason = "ties are exact: the same triangle twice")]
    fn nearest_local(&self, place: DVec3) -> (u32, DVec3, f64) {
        let nodes = &self.bvh.nodes;
        let bound = |index: u32| {
            let bounds = nodes[index as usize].aabb();
            let (lo, hi) = (bounds.min.as_dvec3(), bounds.max.as_dvec3());
            (lo - place).max(place - hi).max(DVec3::ZERO).length_squared()
        };
        let mut best = (0_u32, DVec3::ZERO, f64::INFINITY);
        let mut open = vec![(0.0_f64, 0_u32)];
        while let Some((least, index)) = open.pop() {
            if least > best.2 {
                continue;
            }
            let node = &nodes[index as usize];
            if !node.is_leaf() {
                let [a, b] =
                    [node.first_index, node.first_index + 1].map(|child| (bound(child), child));
                // The nearer child is opened first.
                open.extend(if a.0 < b.0 { [b, a] } else { [a, b] });
                continue;
            }
            for slot in node.first_index..node.first_index + node.prim_count {
                let corners = self.triangles[slot as usize].map(Vec3::as_dvec3);
                let point = on_triangle(place, corners);
                let distance = point.distance_squared(place);
                let earlier = || self.triangle_of(slot) < self.triangle_of(best.0);
                if distance < best.2 || (distance == best.2 && earlier()) {
                    best = (slot, point, distance);
                }
            }
        }
        (best.0, best.1, best.2.sqrt())
    }
}

/// The triangle's point nearest to `p` (Ericson, "Real-Time Collision Detection", 5.1.5). Triangles
/// without area are their longest side.
pub(crate) fn on_triangle(p: DVec3, [a, b, c]: [DVec3; 3]) -> DVec3 {
    let (ab, ac) = (b - a, c - a);
    let normal = ab.cross(ac);
    let area = normal.length_squared();
    // Barycentric weights of the projection onto the plane; inside, it is the answer.
    if area > 0.0 {
        let ap = p - a;
        let w = ab.cross(ap).dot(normal) / area;
        let v = ap.cross(ac).dot(normal) / area;
        if v >= 0.0 && w >= 0.0 && v + w <= 1.0 {
            return a + v * ab + w * ac;
        }
    }
    let candidates = [on_segment(p, a, b), on_segment(p, b, c), on_segment(p, c, a)];
    let nearer = |x: &DVec3, y: &DVec3| x.distance_squared(p).total_cmp(&y.distance_squared(p));
    candidates.into_iter().min_by(nearer).unwrap_or(a)
}

fn on_segment(p: DVec3, a: DVec3, b: DVec3) -> DVec3 {
    let way = b - a;
    let length = way.length_squared();
    let share = if length > 0.0 { ((p - a).dot(way) / length).clamp(0.0, 1.0) } else { 0.0 };
    a + share * way
}
