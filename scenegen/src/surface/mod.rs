//! The traced geometry: one BVH over all triangles, for rays and nearest points.
//!
//! The tree is obvhs's binary one: on a CPU its traversal is a quarter faster than that of the eight-way
//! compressed tree (`benches/scenegen.rs` measures both). A triangle's index in the order of the tree's leaves
//! is called its slot.
//!
//! Vertices are converted to local coordinates in which the geometry's largest half side is 1024. Single
//! precision is then equally accurate for meshes of any size and position, and the absolute tolerances of the tree's
//! builder (1e-4) are below an ulp of the geometry.
//!
//! Boxes passed to the builder exceed their triangles by [`PADDING`], so that a box test, despite rounding, never
//! misses a triangle that the watertight intersection would hit: there are no cracks.

use glam::{DVec3, Vec3, Vec3A};
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::node::Bvh2Node;
use obvhs::faststack::{FastStack, HeapStack, StackStack};
use obvhs::ray::{Ray, RayHit};

use crate::error::Error;
use crate::intersect::{Intersection, ShearedRay};
use crate::mesh::Model;
use crate::tree;

/// Largest half side of the geometry in local coordinates.
const HALF_SIDE: f64 = 1024.0;
/// Added to all sides of a triangle's box. The rounding error of a box test is at most 3 ulps of the largest
/// coordinate difference (Ize, "Robust BVH Ray Traversal", JCGT 2013); as rays start within twice the half
/// side, this is 3 · 2⁻²⁴ · 4096 = 7e-4.
const PADDING: f32 = 1e-3;
/// Maximum depth of a tree whose traversal stack is not allocated on the heap.
const SHALLOW: usize = 96;

/// A triangle mesh for ray casts and nearest-point queries. World coordinates are the source's own.
pub struct Surface {
    pub(crate) bvh: Bvh2,
    /// Triangles by slot, in local coordinates.
    pub(crate) triangles: Vec<[Vec3; 3]>,
    centre: DVec3,
    /// Local units per world unit.
    scale: f64,
    depth: usize,
    bounds: (DVec3, DVec3),
}

/// The hit of a ray on the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceHit {
    /// Ray parameter: distance in units of the direction's length.
    pub t: f64,
    /// Hit point, in world coordinates.
    pub point: DVec3,
    /// Unit geometric normal by the triangle's winding; zero for a triangle without area.
    pub normal: DVec3,
    /// Index of the triangle in the model.
    pub triangle: u32,
    /// True if the ray comes from the side that the normal points to.
    pub front: bool,
}

/// A ray in local coordinates. The direction need not have unit length.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LocalRay {
    pub(crate) origin: Vec3,
    pub(crate) direction: Vec3,
    /// Smallest ray parameter (exclusive).
    pub(crate) tmin: f32,
    /// Largest ray parameter (inclusive).
    pub(crate) tmax: f32,
}

impl LocalRay {
    /// A placeholder that hits nothing.
    pub(crate) const NONE: Self =
        Self { origin: Vec3::ZERO, direction: Vec3::Z, tmin: 0.0, tmax: 0.0 };
}

/// An intersection with the triangle in `slot`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LocalHit {
    pub(crate) slot: u32,
    pub(crate) at: Intersection,
}

impl Surface {
    /// Builds the tree.
    ///
    /// # Errors
    /// When the model has no triangles.
    pub fn new(model: &Model) -> Result<Self, Error> {
        if model.triangles.is_empty() {
            return Err(Error::empty(&model.name));
        }
        let bounds = model.bounds();
        let centre = 0.5 * (bounds.0 + bounds.1);
        let half = (0.5 * (bounds.1 - bounds.0)).max_element();
        // A mesh of a single point has no size; any scale will do.
        let scale =
            if half > 0.0 && (HALF_SIDE / half).is_finite() { HALF_SIDE / half } else { 1.0 };
        let local = |i: u32| ((model.positions[i as usize] - centre) * scale).as_vec3();
        let triangle = |corners: &[u32; 3]| corners.map(local);
        let box_of = |id: u32| padded(&triangle(&model.triangles[id as usize]));
        let bvh = tree::build(model.triangles.len(), box_of);
        let in_leaves = bvh.primitive_indices.iter().map(|&id| &model.triangles[id as usize]);
        let triangles = in_leaves.map(triangle).collect();
        let depth = tree::depth(&bvh);
        Ok(Self { bvh, triangles, centre, scale, depth, bounds })
    }

    /// The first triangle that a ray hits from either side, up to the ray parameter `range`. `None` for a
    /// direction of length 0.
    pub fn cast(&self, origin: DVec3, direction: DVec3, range: f64) -> Option<SurfaceHit> {
        let ray = self.enter(origin, direction, range)?;
        let hit = self.closest(&ray, None, None, |_, _| true)?;
        let hit = self.describe(origin, direction, hit);
        (hit.t <= range).then_some(hit)
    }

    /// True if the surface separates two points. The segment is shortened at both ends by a millionth of the
    /// diagonal, so that its ends may lie on the surface.
    pub fn blocked(&self, from: DVec3, to: DVec3) -> bool {
        let segment = to - from;
        let length = segment.length();
        let margin = 1e-6 * self.diagonal();
        if length <= 2.0 * margin {
            return false;
        }
        let step = segment * (margin / length);
        let (origin, direction) = (from + step, segment - 2.0 * step);
        let ray = self.enter(origin, direction, 1.0);
        ray.is_some_and(|ray| self.occluder(&ray, |_, _| true).is_some())
    }

    /// Smallest and largest coordinates.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        self.bounds
    }

    /// Length of the bounding box's diagonal `[world units]`.
    pub fn diagonal(&self) -> f64 {
        (self.bounds.1 - self.bounds.0).length()
    }

    /// Memory of the tree and the triangles `[bytes]`.
    pub fn bytes(&self) -> usize {
        self.bvh.nodes.len() * size_of::<Bvh2Node>()
            + self.triangles.len() * (size_of::<[Vec3; 3]>() + size_of::<u32>())
    }

    /// All triangles as traced, in the order of the model.
    pub fn triangles(&self) -> Vec<[DVec3; 3]> {
        let mut all = vec![[DVec3::ZERO; 3]; self.triangles.len()];
        for (slot, triangle) in self.triangles.iter().enumerate() {
            all[self.triangle_of(slot as u32) as usize] =
                triangle.map(|p| self.world_from_local(p.as_dvec3()));
        }
        all
    }

    /// The position of a vertex as it is traced, that is, rounded in local coordinates.
    pub(crate) fn traced(&self, corner: DVec3) -> DVec3 {
        self.world_from_local(self.local_from_world(corner).as_vec3().as_dvec3())
    }

    pub(crate) fn local_from_world(&self, world: DVec3) -> DVec3 {
        (world - self.centre) * self.scale
    }

    pub(crate) fn world_from_local(&self, local: DVec3) -> DVec3 {
        local / self.scale + self.centre
    }

    /// Local units per world unit.
    pub(crate) fn scale(&self) -> f64 {
        self.scale
    }

    /// Number of levels of the tree, an upper bound for the size of a traversal stack.
    pub(crate) fn depth(&self) -> usize {
        self.depth
    }

    /// The model's index of the triangle in a slot.
    pub(crate) fn triangle_of(&self, slot: u32) -> u32 {
        self.bvh.primitive_indices[slot as usize]
    }

    /// The local ray for a world ray. Its origin is moved to the point where it enters the bounding box: single
    /// precision then does not have to cover the distance to the box. `None` if the ray misses the box.
    pub(crate) fn enter(&self, origin: DVec3, direction: DVec3, range: f64) -> Option<LocalRay> {
        self.enter_with_distance(origin, direction, range).map(|(ray, _)| ray)
    }

    /// Like [`Surface::enter`], but also returns the distance to the box `[local units]`.
    pub(crate) fn enter_with_distance(
        &self,
        origin: DVec3,
        direction: DVec3,
        range: f64,
    ) -> Option<(LocalRay, f32)> {
        let (o, d) = (self.local_from_world(origin), direction * self.scale);
        let half = 0.5 * (self.bounds.1 - self.bounds.0) * self.scale + DVec3::splat(1.0);
        // The reciprocal is infinite along axes perpendicular to the ray. A ray that lies exactly in a side of the box
        // then gives NaN and may miss the box. It cannot hit the geometry, which is one unit farther in.
        let inverse = d.recip();
        let (a, b) = ((-half - o) * inverse, (half - o) * inverse);
        let near = a.min(b).max_element().max(0.0);
        let far = a.max(b).min_element().min(range);
        let length = d.length();
        if !(near <= far && length > 0.0 && length.is_finite()) {
            return None;
        }
        let distance = near * length;
        let direction = (d * length.recip()).as_vec3();
        // This is slightly more than the exact range; callers compare again in f64.
        let tmax = ((far * length - distance) * (1.0 + 1e-6)) as f32;
        let origin = (o + near * d).as_vec3();
        Some((LocalRay { origin, direction, tmin: 0.0, tmax }, distance as f32))
    }

    /// The hit in world coordinates; the parameter of the world ray is computed from the triangle's plane in
    /// f64.
    pub(crate) fn describe(&self, origin: DVec3, direction: DVec3, hit: LocalHit) -> SurfaceHit {
        let [a, b, c] = self.triangles[hit.slot as usize].map(Vec3::as_dvec3);
        let (o, d) = (self.local_from_world(origin), direction * self.scale);
        let normal = (b - a).cross(c - a);
        let along = normal.dot(d);
        let by_weights = a + f64::from(hit.at.v) * (b - a) + f64::from(hit.at.w) * (c - a);
        let by_plane = normal.dot(a - o) / along;
        let by_point = (by_weights - o).dot(d) / d.length_squared();
        // The plane of a triangle seen edge-on is useless, but the barycentric weights are not.
        let edge_on = along.abs() <= 1e-6 * normal.length() * d.length();
        let t = if edge_on || !by_plane.is_finite() { by_point } else { by_plane };
        SurfaceHit {
            t,
            point: origin + t * direction,
            normal: normal.normalize_or_zero(),
            triangle: self.triangle_of(hit.slot),
            front: hit.at.front,
        }
    }

    /// The first accepted hit along a ray; of several at the same ray parameter, that of the triangle with the lowest
    /// index in the model. With `after` (ray parameter and triangle), the first hit after that one in this order. The
    /// triangle in slot `hint` is tested first.
    #[inline]
    pub(crate) fn closest(
        &self,
        ray: &LocalRay,
        after: Option<(f32, u32)>,
        hint: Option<u32>,
        accept: impl Fn(u32, &Intersection) -> bool,
    ) -> Option<LocalHit> {
        if self.depth <= SHALLOW {
            let stack = StackStack::<u32, SHALLOW>::default();
            self.closest_with(stack, ray, (after, hint), accept)
        } else {
            let stack = HeapStack::new_with_capacity(self.depth);
            self.closest_with(stack, ray, (after, hint), accept)
        }
    }

    #[inline]
    #[expect(clippy::float_cmp, reason = "ties are exact: they order triangles at one place")]
    fn closest_with(
        &self,
        mut stack: impl FastStack<u32>,
        ray: &LocalRay,
        (after, hint): (Option<(f32, u32)>, Option<u32>),
        accept: impl Fn(u32, &Intersection) -> bool,
    ) -> Option<LocalHit> {
        let sheared = ShearedRay::new(ray.origin, ray.direction);
        let mut boxes = box_ray(ray);
        let mut best: Option<LocalHit> = None;
        // The intersection if it is accepted and precedes the best one so far.
        let nearer = |slot: u32, tmax: f32, best: &Option<LocalHit>| -> Option<Intersection> {
            let at = self.intersect(slot, &sheared, ray.tmin, tmax)?;
            let first = best.is_none_or(|best| {
                at.t < best.at.t || self.triangle_of(slot) < self.triangle_of(best.slot)
            });
            let behind = after.is_none_or(|(t, triangle)| {
                at.t > t || (at.t == t && self.triangle_of(slot) > triangle)
            });
            (first && behind && accept(slot, &at)).then_some(at)
        };
        if let Some(slot) = hint
            && let Some(at) = nearer(slot, boxes.tmax, &best)
        {
            boxes.tmax = at.t;
            best = Some(LocalHit { slot, at });
        }
        let visit = |node: &Bvh2Node, boxes: &mut Ray, _: &mut RayHit| {
            for slot in node.first_index..node.first_index + node.prim_count {
                if let Some(at) = nearer(slot, boxes.tmax, &best) {
                    boxes.tmax = at.t;
                    best = Some(LocalHit { slot, at });
                }
            }
            true
        };
        self.bvh.ray_traverse_dynamic(&mut stack, boxes, &mut RayHit::none(), visit);
        best
    }

    /// True if the ray has an accepted intersection with the triangle in `slot`.
    #[inline]
    pub(crate) fn occludes(
        &self,
        slot: u32,
        ray: &LocalRay,
        accept: impl Fn(u32, &Intersection) -> bool,
    ) -> bool {
        let sheared = ShearedRay::new(ray.origin, ray.direction);
        self.intersect(slot, &sheared, ray.tmin, ray.tmax).is_some_and(|at| accept(slot, &at))
    }

    /// The intersection of a ray with the triangle in `slot`, after `tmin` and up to `tmax`.
    #[inline]
    pub(crate) fn intersect(
        &self,
        slot: u32,
        ray: &ShearedRay,
        tmin: f32,
        tmax: f32,
    ) -> Option<Intersection> {
        ray.intersect(&self.triangles[slot as usize]).filter(|at| at.t > tmin && at.t <= tmax)
    }

    /// The slot of any triangle with which the ray has an accepted intersection.
    #[inline]
    pub(crate) fn occluder(
        &self,
        ray: &LocalRay,
        accept: impl Fn(u32, &Intersection) -> bool,
    ) -> Option<u32> {
        if self.depth <= SHALLOW {
            self.occluder_with(StackStack::<u32, SHALLOW>::default(), ray, accept)
        } else {
            self.occluder_with(HeapStack::new_with_capacity(self.depth), ray, accept)
        }
    }

    #[inline]
    fn occluder_with(
        &self,
        mut stack: impl FastStack<u32>,
        ray: &LocalRay,
        accept: impl Fn(u32, &Intersection) -> bool,
    ) -> Option<u32> {
        let sheared = ShearedRay::new(ray.origin, ray.direction);
        let is_hit = |slot: &u32| {
            self.intersect(*slot, &sheared, ray.tmin, ray.tmax).is_some_and(|at| accept(*slot, &at))
        };
        let mut occluder = None;
        let visit = |node: &Bvh2Node, _: &mut Ray, _: &mut RayHit| {
            occluder = (node.first_index..node.first_index + node.prim_count).find(is_hit);
            occluder.is_none()
        };
        self.bvh.ray_traverse_dynamic(&mut stack, box_ray(ray), &mut RayHit::none(), visit);
        occluder
    }
}

/// The ray in obvhs's type, for box tests.
#[inline]
fn box_ray(ray: &LocalRay) -> Ray {
    Ray::new(Vec3A::from(ray.origin), Vec3A::from(ray.direction), 0.0, ray.tmax)
}

/// The padded bounding box of a triangle.
#[inline]
pub(crate) fn padded([a, b, c]: &[Vec3; 3]) -> Aabb {
    let [a, b, c] = [Vec3A::from(*a), Vec3A::from(*b), Vec3A::from(*c)];
    Aabb::new(a.min(b).min(c) - PADDING, a.max(b).max(c) + PADDING)
}

impl std::fmt::Debug for Surface {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut shown = f.debug_struct("Surface");
        shown.field("triangles", &self.triangles.len()).field("bounds", &self.bounds);
        shown.finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests;
