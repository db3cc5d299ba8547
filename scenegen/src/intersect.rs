//! Intersects rays and triangles without cracks.
//!
//! Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection" (JCGT 2013): the triangle is
//! sheared into the ray's space, where two triangles that share an edge evaluate exactly the same
//! products for this edge with opposite signs, so that a ray cannot pass between them. If an edge function is
//! exactly zero, all three are evaluated again in f64, in which the products are exact.

use glam::Vec3;

/// A ray prepared for intersecting many triangles.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ShearedRay {
    pub(crate) origin: Vec3,
    /// `kx`, `ky` and `kz` are the coordinate axes that are x, y and z of the ray's space.
    kx: usize,
    ky: usize,
    kz: usize,
    /// Shears of x and y along z, and scale of z.
    pub(crate) shear: Vec3,
}

/// The intersection of a ray and a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Intersection {
    /// Ray parameter.
    pub(crate) t: f32,
    /// Barycentric weight of the second vertex.
    pub(crate) v: f32,
    /// Barycentric weight of the third vertex.
    pub(crate) w: f32,
    /// True if the vertices are counter-clockwise as seen along the ray.
    pub(crate) front: bool,
}

impl ShearedRay {
    /// Prepares a ray; `direction` must be finite and not zero.
    #[inline]
    pub(crate) fn new(origin: Vec3, direction: Vec3) -> Self {
        let size = direction.abs();
        let kz = if size.x > size.y {
            if size.x > size.z { 0 } else { 2 }
        } else if size.y > size.z {
            1
        } else {
            2
        };
        let (mut kx, mut ky) = ((kz + 1) % 3, (kz + 2) % 3);
        // Swapping two axes preserves the winding.
        if direction[kz] < 0.0 {
            std::mem::swap(&mut kx, &mut ky);
        }
        let inverse = 1.0 / direction[kz];
        let shear = Vec3::new(direction[kx] * inverse, direction[ky] * inverse, inverse);
        Self { origin, kx, ky, kz, shear }
    }

    /// The coordinate axes that are x, y and z of the ray's space.
    #[inline]
    pub(crate) fn axes(&self) -> [usize; 3] {
        [self.kx, self.ky, self.kz]
    }

    /// The intersection with a triangle, at any ray parameter.
    #[inline]
    pub(crate) fn intersect(&self, triangle: &[Vec3; 3]) -> Option<Intersection> {
        let corner = |p: Vec3| {
            let p = p - self.origin;
            let z = p[self.kz];
            (p[self.kx] - self.shear.x * z, p[self.ky] - self.shear.y * z, self.shear.z * z)
        };
        // Written out, because `map` would not be inlined here.
        let (a, b, c) = (corner(triangle[0]), corner(triangle[1]), corner(triangle[2]));
        let mut u = c.0 * b.1 - c.1 * b.0;
        let mut v = a.0 * c.1 - a.1 * c.0;
        let mut w = b.0 * a.1 - b.1 * a.0;
        if u == 0.0 || v == 0.0 || w == 0.0 {
            let exact = |p: (f32, f32, f32), q: (f32, f32, f32)| {
                (f64::from(p.0) * f64::from(q.1) - f64::from(p.1) * f64::from(q.0)) as f32
            };
            u = exact(c, b);
            v = exact(a, c);
            w = exact(b, a);
        }
        if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
            return None;
        }
        let determinant = u + v + w;
        if determinant == 0.0 {
            return None;
        }
        let inverse = 1.0 / determinant;
        let t = (u * a.2 + v * b.2 + w * c.2) * inverse;
        // If the inverse of a tiny determinant overflows, t is infinite or NaN.
        t.is_finite().then_some(Intersection {
            t,
            v: v * inverse,
            w: w * inverse,
            front: determinant > 0.0,
        })
    }
}
