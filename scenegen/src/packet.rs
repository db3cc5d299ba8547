//! Traces packets of rays. A pixel's camera rays are nearly parallel, and so are the shadow rays from its points
//! to a light; each such packet shares one traversal of the tree.
//!
//! A node is entered if any of the rays could hit its box. This is tested with interval bounds of all rays
//! (Boulos, Wald and Shirley, "Geometric and Arithmetic Culling Methods for Entire Ray Packets", 2006).
//! Rounding is monotonic, so the bounds hold for rounded values, too, and every box that a single ray would
//! enter is entered. A leaf's triangles are tested against all rays in vectors, and only the rays that pass
//! are tested by [`ShearedRay::intersect`]. Each ray therefore finds exactly the same hit as it would alone.

use glam::{BVec3A, DVec3, Vec3, Vec3A};
use obvhs::aabb::Aabb;

use crate::intersect::{Intersection, ShearedRay};
use crate::surface::{LocalHit, LocalRay, Surface, padded};

/// Maximum number of rays of a packet: the default number of subsamples of a pixel.
pub(crate) const LANES: usize = 16;
/// Maximum depth of a tree that is traversed with packets.
const MAX_DEPTH: usize = 96;

/// Each lane's bit.
const BITS: [u32; LANES] = {
    let mut bits = [0; LANES];
    let mut lane = 0;
    while lane < LANES {
        bits[lane] = 1 << lane;
        lane += 1;
    }
    bits
};

/// True if bit `lane` is set.
pub(crate) fn has(lanes: u32, lane: usize) -> bool {
    lanes >> lane & 1 == 1
}

/// The lanes whose bits are set, ascending.
fn set_lanes(mut lanes: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let lane = lanes.trailing_zeros() as usize;
        lanes &= lanes.wrapping_sub(1);
        (lane < LANES).then_some(lane)
    })
}

/// Bounds of all rays of a packet. The bounds of an axis are infinite unless all rays run forward or all run
/// backward along it.
struct PacketBounds {
    /// Axes along which all rays go backward.
    backward: BVec3A,
    /// For each axis, the coordinate of the origin that reaches the near plane of a box first.
    first: Vec3A,
    /// For each axis, the coordinate of the origin that reaches the far plane of a box last.
    last: Vec3A,
    /// Bounds of the reciprocal directions.
    inverse: (Vec3A, Vec3A),
}

impl PacketBounds {
    /// The bounds of rays with these origins and directions.
    fn around(rays: impl Iterator<Item = (Vec3, Vec3)>) -> Self {
        let whole = (Vec3A::INFINITY, Vec3A::NEG_INFINITY);
        let (mut origin, mut direction) = (whole, whole);
        for (o, d) in rays {
            let (o, d) = (Vec3A::from(o), Vec3A::from(d));
            origin = (origin.0.min(o), origin.1.max(o));
            direction = (direction.0.min(d), direction.1.max(d));
        }
        // The reciprocal of a smaller number may overflow.
        let tiny = Vec3A::splat(f32::MIN_POSITIVE);
        let backward = direction.1.cmple(-tiny);
        let is_bounded = backward | direction.0.cmpge(tiny);
        // Reciprocals decrease with the direction, on either side of zero.
        let or_one = |v: Vec3A| Vec3A::select(is_bounded, v, Vec3A::ONE);
        let inverse = (or_one(1.0 / direction.1), or_one(1.0 / direction.0));
        let first = Vec3A::select(backward, origin.0, origin.1);
        let last = Vec3A::select(backward, origin.1, origin.0);
        Self {
            backward,
            first: Vec3A::select(is_bounded, first, Vec3A::INFINITY),
            last: Vec3A::select(is_bounded, last, Vec3A::NEG_INFINITY),
            inverse,
        }
    }

    /// A lower bound of the ray parameter at which a ray of the packet enters a box; infinite if none can hit it.
    #[inline(always)]
    fn entry(&self, aabb: &Aabb) -> f32 {
        let near = Vec3A::select(self.backward, aabb.max, aabb.min) - self.first;
        let far = Vec3A::select(self.backward, aabb.min, aabb.max) - self.last;
        let entry = (near * self.inverse.0).min(near * self.inverse.1).max_element();
        let exit = (far * self.inverse.0).max(far * self.inverse.1).min_element();
        if exit >= entry && exit >= 0.0 { entry } else { f32::INFINITY }
    }
}

/// A packet of rays, stored side by side, whose sheared spaces have the same axes.
struct RayPacket<'a> {
    rays: &'a [LocalRay],
    sheared: [ShearedRay; LANES],
    /// The coordinate axes that are x, y and z of the sheared spaces.
    axes: [usize; 3],
    /// Coordinates of the origins along these axes.
    origin: [[f32; LANES]; 3],
    /// Shears of x and y along z.
    shear: [[f32; LANES]; 2],
    bounds: PacketBounds,
}

impl<'a> RayPacket<'a> {
    /// Prepares a packet; `None` for a single ray, or if the directions' largest components differ in axis or sign.
    fn new(rays: &'a [LocalRay]) -> Option<Self> {
        if !(2..=LANES).contains(&rays.len()) {
            return None;
        }
        let mut sheared = [ShearedRay::new(rays[0].origin, rays[0].direction); LANES];
        for (to, ray) in sheared.iter_mut().zip(rays).skip(1) {
            *to = ShearedRay::new(ray.origin, ray.direction);
        }
        let axes = sheared[0].axes();
        if sheared.iter().any(|ray| ray.axes() != axes) {
            return None;
        }
        let (mut origin, mut shear) = ([[0.0; LANES]; 3], [[0.0; LANES]; 2]);
        for (lane, ray) in sheared.iter().enumerate() {
            for (to, axis) in origin.iter_mut().zip(axes) {
                to[lane] = ray.origin[axis];
            }
            (shear[0][lane], shear[1][lane]) = (ray.shear.x, ray.shear.y);
        }
        let bounds = PacketBounds::around(rays.iter().map(|ray| (ray.origin, ray.direction)));
        Some(Self { rays, sheared, axes, origin, shear, bounds })
    }

    /// The rays that may hit a triangle, as bits: all except those whose edge functions have both signs. The
    /// operations are exactly those of [`ShearedRay::intersect`].
    #[expect(clippy::needless_range_loop, reason = "lanes side by side become vectors")]
    #[inline(always)]
    fn may_hit(&self, triangle: &[Vec3; 3]) -> u32 {
        let [x, y, z] = self.axes;
        let corner = |p: Vec3| {
            let p = [p[x], p[y], p[z]];
            let mut flat = [[0.0_f32; LANES]; 2];
            for lane in 0..LANES {
                let z = p[2] - self.origin[2][lane];
                flat[0][lane] = (p[0] - self.origin[0][lane]) - self.shear[0][lane] * z;
                flat[1][lane] = (p[1] - self.origin[1][lane]) - self.shear[1][lane] * z;
            }
            flat
        };
        // Written out, because `map` would not be inlined here.
        let (a, b, c) = (corner(triangle[0]), corner(triangle[1]), corner(triangle[2]));
        let mut may = 0;
        for lane in 0..LANES {
            let u = c[0][lane] * b[1][lane] - c[1][lane] * b[0][lane];
            let v = a[0][lane] * c[1][lane] - a[1][lane] * c[0][lane];
            let w = b[0][lane] * a[1][lane] - b[1][lane] * a[0][lane];
            let below = (u < 0.0) | (v < 0.0) | (w < 0.0);
            let above = (u > 0.0) | (v > 0.0) | (w > 0.0);
            // If one edge function is zero, `intersect` evaluates all three again in f64.
            let exact = (u == 0.0) | (v == 0.0) | (w == 0.0);
            may |= if (below & above) & !exact { 0 } else { BITS[lane] };
        }
        may & u32::MAX >> (32 - self.rays.len())
    }

    /// Visits the triangles that rays may hit, nearer boxes first. `visit` gets the triangle's slot and the rays
    /// as bits, and returns the largest ray parameter that is still of interest, or negative infinity to stop.
    #[inline]
    fn traverse(&self, surface: &Surface, mut visit: impl FnMut(u32, u32) -> f32) {
        let nodes = &surface.bvh.nodes;
        let mut reach = self.rays.iter().map(|ray| ray.tmax).fold(0.0, f32::max);
        let mut open = [(0_u32, 0.0_f32); MAX_DEPTH];
        let mut count = 1;
        open[0] = (0, self.bounds.entry(nodes[0].aabb()));
        while count > 0 {
            count -= 1;
            let (mut index, entry) = open[count];
            if entry >= reach {
                continue;
            }
            loop {
                let node = &nodes[index as usize];
                if node.is_leaf() {
                    for slot in node.first_index..node.first_index + node.prim_count {
                        let triangle = &surface.triangles[slot as usize];
                        if self.bounds.entry(&padded(triangle)) >= reach {
                            continue;
                        }
                        let lanes = self.may_hit(triangle);
                        if lanes != 0 {
                            reach = visit(slot, lanes);
                        }
                    }
                    break;
                }
                let (mut near, mut far) = (node.first_index, node.first_index + 1);
                let mut first = self.bounds.entry(nodes[near as usize].aabb());
                let mut second = self.bounds.entry(nodes[far as usize].aabb());
                if second < first {
                    (near, far) = (far, near);
                    (first, second) = (second, first);
                }
                if second < reach {
                    open[count] = (far, second);
                    count += 1;
                }
                if first >= reach {
                    break;
                }
                index = near;
            }
        }
    }
}

impl Surface {
    /// True if the pyramid of these directions from `origin` hits no leaf's box, so that no ray within it can hit the
    /// surface. The pyramid must contain the rays with a margin for rounding in single precision.
    pub(crate) fn is_missed_by(&self, origin: DVec3, directions: [DVec3; 4]) -> bool {
        let origin = self.local_from_world(origin).as_vec3();
        let bounds = PacketBounds::around(directions.into_iter().map(|d| (origin, d.as_vec3())));
        let nodes = &self.bvh.nodes;
        let mut open = vec![0_u32];
        while let Some(index) = open.pop() {
            let node = &nodes[index as usize];
            if bounds.entry(node.aabb()) < f32::INFINITY {
                if node.is_leaf() {
                    return false;
                }
                open.extend([node.first_index, node.first_index + 1]);
            }
        }
        true
    }

    /// [`Surface::closest`] for each of at most [`LANES`] rays.
    pub(crate) fn closest_each(
        &self,
        rays: &[LocalRay],
        accept: impl Fn(u32, &Intersection) -> bool,
    ) -> [Option<LocalHit>; LANES] {
        let mut best = [None::<LocalHit>; LANES];
        let packet = if self.depth() <= MAX_DEPTH { RayPacket::new(rays) } else { None };
        let Some(packet) = packet else {
            let mut hint = None;
            for (best, ray) in best.iter_mut().zip(rays) {
                *best = self.closest(ray, None, hint, &accept);
                hint = best.map(|hit| hit.slot).or(hint);
            }
            return best;
        };
        let mut tmax = [0.0; LANES];
        for (tmax, ray) in tmax.iter_mut().zip(rays) {
            *tmax = ray.tmax;
        }
        let mut reach = tmax.iter().copied().fold(0.0, f32::max);
        packet.traverse(self, |slot, lanes| {
            let mut changed = false;
            for lane in set_lanes(lanes) {
                let (sheared, ray) = (&packet.sheared[lane], &rays[lane]);
                let Some(at) = self.intersect(slot, sheared, ray.tmin, tmax[lane]) else {
                    continue;
                };
                let first = best[lane].is_none_or(|best| {
                    at.t < best.at.t || self.triangle_of(slot) < self.triangle_of(best.slot)
                });
                if first && accept(slot, &at) {
                    tmax[lane] = at.t;
                    best[lane] = Some(LocalHit { slot, at });
                    changed = true;
                }
            }
            if changed {
                reach = tmax.iter().copied().fold(0.0, f32::max);
            }
            reach
        });
        best
    }

    /// The rays that have an occluder (see [`Surface::occluder`]), of at most [`LANES`] rays, as bits. The triangle in
    /// slot `hint` is tested first; `hint` is set to the slot of the last occluder found.
    pub(crate) fn occluded_each(
        &self,
        rays: &[LocalRay],
        hint: &mut Option<u32>,
        accept: impl Fn(u32, &Intersection) -> bool,
    ) -> u32 {
        let mut hidden = 0;
        // The packet consists of the rays that the hint does not occlude.
        let mut remaining = [0_usize; LANES];
        let mut count = 0;
        for (lane, ray) in rays.iter().enumerate() {
            if hint.is_some_and(|slot| self.occludes(slot, ray, &accept)) {
                hidden |= 1 << lane;
            } else {
                remaining[count] = lane;
                count += 1;
            }
        }
        let Some(&first) = remaining[..count].first() else {
            return hidden;
        };
        let mut others = [rays[first]; LANES];
        for (other, &lane) in others.iter_mut().zip(&remaining[..count]) {
            *other = rays[lane];
        }
        let others = &others[..count];
        let packet = if self.depth() <= MAX_DEPTH { RayPacket::new(others) } else { None };
        let Some(packet) = packet else {
            for (ray, lane) in others.iter().zip(remaining) {
                if let Some(slot) = self.occluder(ray, &accept) {
                    hidden |= 1 << lane;
                    *hint = Some(slot);
                }
            }
            return hidden;
        };
        let mut unoccluded = u32::MAX >> (32 - count);
        let reach = others.iter().map(|ray| ray.tmax).fold(0.0, f32::max);
        packet.traverse(self, |slot, lanes| {
            for lane in set_lanes(lanes & unoccluded) {
                let ray = &others[lane];
                let hit = self.intersect(slot, &packet.sheared[lane], ray.tmin, ray.tmax);
                if hit.is_some_and(|at| accept(slot, &at)) {
                    unoccluded &= !(1 << lane);
                    hidden |= 1 << remaining[lane];
                    *hint = Some(slot);
                }
            }
            if unoccluded == 0 { f32::NEG_INFINITY } else { reach }
        });
        hidden
    }
}
