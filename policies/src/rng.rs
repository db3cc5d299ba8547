//! Randomness without hidden state: every draw is a hash of (seed, step, row, purpose).
//!
//! The same four numbers give the same bits on every backend, in any order and at any thread
//! count. The mixer is pcg4d (Jarzynski and Olano, *Hash Functions for GPU Rendering*, JCGT 9(3),
//! 2020): 32-bit operations only, so that a shader can repeat it.

/// What a draw is for. Draws for different purposes are independent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Purpose {
    /// Choosing rows.
    Select = 1,
    /// Placing children.
    Place = 2,
    /// Noise on parameters.
    Noise = 3,
}

/// Draws of one policy event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PolicyRng {
    seed: u32,
    step: u32,
}

impl PolicyRng {
    /// Draws of iteration `step` of a run with this seed.
    #[must_use]
    pub fn new(seed: u64, step: u32) -> Self {
        // Folding keeps both halves of a 64-bit seed significant.
        Self {
            seed: (seed ^ (seed >> 32).wrapping_mul(0x9e37_79b9)) as u32,
            step,
        }
    }

    /// Four independent 32-bit words for (row, purpose, counter).
    #[must_use]
    pub fn bits(&self, row: u32, purpose: Purpose, counter: u32) -> [u32; 4] {
        pcg4d([row, self.step, self.seed, (purpose as u32) << 16 ^ counter])
    }

    /// A number in (0, 1), never 0 or 1: (k + ½) / 2²⁴.
    #[must_use]
    pub fn uniform(&self, row: u32, purpose: Purpose) -> f32 {
        unit_open(self.bits(row, purpose, 0)[0])
    }

    /// Three independent standard normals, by Box–Muller.
    #[must_use]
    pub fn normal3(&self, row: u32, purpose: Purpose, counter: u32) -> [f32; 3] {
        let u = self.bits(row, purpose, counter).map(unit_open);
        let polar = |radius: f32, angle: f32| {
            let r = (-2.0 * radius.ln()).sqrt();
            let (sin, cos) = (std::f32::consts::TAU * angle).sin_cos();
            [r * cos, r * sin]
        };
        let [a, b] = polar(u[0], u[1]);
        let [c, _] = polar(u[2], u[3]);
        [a, b, c]
    }
}

/// The top 24 bits as a number strictly between 0 and 1.
fn unit_open(bits: u32) -> f32 {
    ((bits >> 8) as f32 + 0.5) * (1.0 / 16_777_216.0)
}

fn pcg4d(v: [u32; 4]) -> [u32; 4] {
    let [mut x, mut y, mut z, mut w] =
        v.map(|k| k.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    for shift_after in [true, false] {
        x = x.wrapping_add(y.wrapping_mul(w));
        y = y.wrapping_add(z.wrapping_mul(x));
        z = z.wrapping_add(x.wrapping_mul(y));
        w = w.wrapping_add(y.wrapping_mul(z));
        if shift_after {
            [x, y, z, w] = [x, y, z, w].map(|k| k ^ (k >> 16));
        }
    }
    [x, y, z, w]
}
