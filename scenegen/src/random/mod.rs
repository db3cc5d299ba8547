//! Random numbers as hashes of their purpose, so that images do not depend on the threads that trace their
//! pixels.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

/// The mixing function of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014).
fn mix(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// A stream of random numbers for one purpose; streams with different keys are independent.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Draws {
    key: u64,
    count: u64,
}

impl Draws {
    /// The stream of a seed and a key that identifies the purpose, such as view, pixel and sample.
    pub(crate) fn new(seed: u64, parts: &[u64]) -> Self {
        parts.iter().fold(Self { key: mix(seed), count: 0 }, |draws, &part| draws.with(part))
    }

    /// The stream whose key has one more part. Nothing must have been drawn from `self`.
    pub(crate) fn with(self, part: u64) -> Self {
        Self { key: mix(self.key ^ mix(part)), count: 0 }
    }

    /// 64 random bits.
    pub(crate) fn bits(&mut self) -> u64 {
        self.count += 1;
        mix(self.key.wrapping_add(self.count.wrapping_mul(0xd134_2543_de82_ef95)))
    }

    /// Uniform in `[0, 1)`, 24 bits.
    pub(crate) fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 * (1.0 / 16_777_216.0)
    }

    /// Uniform in `[0, 1)`, 53 bits.
    pub(crate) fn unit64(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// Uniform in the unit square.
    pub(crate) fn square(&mut self) -> Vec2 {
        Vec2::new(self.unit(), self.unit())
    }

    /// Standard normal (Box and Muller).
    pub(crate) fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit64()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit64()).cos()
    }
}

/// A point in the `i`-th of `n` x `n` strata of the unit square; `jitter` is its position in the stratum.
pub(crate) fn stratum(i: u32, n: u32, jitter: Vec2) -> Vec2 {
    let cell = Vec2::new((i % n) as f32, (i / n) as f32);
    (cell + jitter) / n as f32
}

/// A direction around +z with density cos / pi, if `u` is uniform in the unit square.
pub(crate) fn cosine_hemisphere(u: Vec2) -> Vec3 {
    let (radius, angle) = (u.x.sqrt(), TAU * u.y);
    Vec3::new(radius * angle.cos(), radius * angle.sin(), (1.0 - u.x).max(0.0).sqrt())
}

/// A visible normal of the GGX distribution around +z, for a view direction with z >= 0
/// (Heitz, "Sampling the GGX Distribution of Visible Normals", JCGT 2018).
pub(crate) fn ggx_visible_normal(view: Vec3, alpha: f32, u: Vec2) -> Vec3 {
    let stretched = Vec3::new(alpha * view.x, alpha * view.y, view.z).normalize();
    let flat = stretched.x * stretched.x + stretched.y * stretched.y;
    let t1 =
        if flat > 0.0 { Vec3::new(-stretched.y, stretched.x, 0.0) / flat.sqrt() } else { Vec3::X };
    let t2 = stretched.cross(t1);
    let (radius, angle) = (u.x.sqrt(), TAU * u.y);
    let p1 = radius * angle.cos();
    let s = 0.5 * (1.0 + stretched.z);
    let p2 = (1.0 - s) * (1.0 - p1 * p1).max(0.0).sqrt() + s * radius * angle.sin();
    let up = (1.0 - p1 * p1 - p2 * p2).max(0.0).sqrt();
    let normal = p1 * t1 + p2 * t2 + up * stretched;
    Vec3::new(alpha * normal.x, alpha * normal.y, normal.z.max(0.0)).normalize()
}

/// GGX's distribution of normals at `cos` from the macroscopic normal.
pub(crate) fn ggx_distribution(cos: f32, alpha: f32) -> f32 {
    let a2 = alpha * alpha;
    let d = cos * cos * (a2 - 1.0) + 1.0;
    a2 / (PI * d * d)
}

/// x and y of an orthonormal frame whose z is `normal` (Duff et al., "Building an Orthonormal Basis,
/// Revisited", JCGT 2017).
pub(crate) fn frame(normal: Vec3) -> (Vec3, Vec3) {
    let sign = 1.0_f32.copysign(normal.z);
    let a = -1.0 / (sign + normal.z);
    let b = normal.x * normal.y * a;
    (
        Vec3::new(1.0 + sign * normal.x * normal.x * a, sign * b, -sign * normal.x),
        Vec3::new(b, sign + normal.y * normal.y * a, -normal.y),
    )
}

#[cfg(test)]
mod tests;
