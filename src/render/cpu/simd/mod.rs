//! A vector of `f32` lanes with operators, for every instruction set.
//!
//! `pulp` dispatches at run time (AVX-512, AVX2, NEON, baseline). Its methods take a token as their first argument
//! and make formulas hard to read; [`V`] carries the token and overloads the operators. Everything is
//! inlined into the dispatched kernel, so that the wrapper costs nothing. The vector and all its functions are in this
//! file.

use std::ops::{Add, Div, Mul, Neg, Sub};

use pulp::{Scalar, Simd};

/// Rows per block, and pixels per tile row: every lane count divides it.
pub(super) const WIDTH: usize = 16;

/// The sign bit of a lane.
pub(super) const SIGN: u32 = 1 << 31;

/// `[e(0), e(1), …]` without a closure: `each!(k in 3 => e(k))`.
///
/// Closures, including those given to `array::map`, are compiled without the kernel's instruction
/// set unless they happen to be inlined; every operator in them is then a call.
macro_rules! each {
    ($k:ident in 2 => $e:expr) => {
        [each!(@ $k 0 $e), each!(@ $k 1 $e)]
    };
    ($k:ident in 3 => $e:expr) => {
        [each!(@ $k 0 $e), each!(@ $k 1 $e), each!(@ $k 2 $e)]
    };
    ($k:ident in 4 => $e:expr) => {
        [each!(@ $k 0 $e), each!(@ $k 1 $e), each!(@ $k 2 $e), each!(@ $k 3 $e)]
    };
    ($k:ident in 5 => $e:expr) => {
        [each!(@ $k 0 $e), each!(@ $k 1 $e), each!(@ $k 2 $e), each!(@ $k 3 $e), each!(@ $k 4 $e)]
    };
    (@ $k:ident $value:literal $e:expr) => {{
        let $k: usize = $value;
        $e
    }};
}
pub(super) use each;

/// A vector of `S::F32_LANES` numbers.
#[derive(Clone, Copy)]
pub(super) struct V<S: Simd> {
    s: S,
    v: S::f32s,
}

/// One truth value per lane.
#[derive(Clone, Copy)]
pub(super) struct Mask<S: Simd> {
    s: S,
    m: S::m32s,
}

impl<S: Simd> V<S> {
    #[inline(always)]
    pub(super) fn splat(s: S, x: f32) -> Self {
        Self { s, v: s.splat_f32s(x) }
    }

    /// `x` in every lane, with the token of another vector.
    #[inline(always)]
    pub(super) fn splat_like(other: Self, x: f32) -> Self {
        Self::splat(other.s, x)
    }

    #[inline(always)]
    pub(super) fn zero(s: S) -> Self {
        Self::splat(s, 0.0)
    }

    /// The first numbers of `from`.
    #[inline(always)]
    pub(super) fn load(s: S, from: &[f32]) -> Self {
        Self { s, v: S::as_simd_f32s(from).0[0] }
    }

    #[inline(always)]
    pub(super) fn store(self, to: &mut [f32]) {
        S::as_mut_simd_f32s(to).0[0] = self.v;
    }

    /// self · b + c.
    #[inline(always)]
    pub(super) fn mul_add(self, b: Self, c: Self) -> Self {
        Self { s: self.s, v: self.s.mul_add_e_f32s(self.v, b.v, c.v) }
    }

    /// c − self · b.
    #[inline(always)]
    pub(super) fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Self { s: self.s, v: self.s.negate_mul_add_e_f32s(self.v, b.v, c.v) }
    }

    #[inline(always)]
    pub(super) fn min(self, b: Self) -> Self {
        Self { s: self.s, v: self.s.min_f32s(self.v, b.v) }
    }

    #[inline(always)]
    pub(super) fn max(self, b: Self) -> Self {
        Self { s: self.s, v: self.s.max_f32s(self.v, b.v) }
    }

    /// The absolute value. Avoids `abs_f32s`, which some builds compile to a call that takes a third of a step's time.
    #[inline(always)]
    pub(super) fn abs(self) -> Self {
        let s = self.s;
        let bits = s.transmute_u32s_f32s(self.v);
        Self::of_bits(s, s.and_u32s(bits, s.splat_u32s(!SIGN)))
    }

    /// The number, negated where the bits `mask` of `other` are set; `mask` is [`SIGN`] or 0.
    #[inline(always)]
    pub(super) fn with_sign_of(self, other: Self, mask: u32) -> Self {
        let s = self.s;
        let sign = s.and_u32s(s.transmute_u32s_f32s(other.v), s.splat_u32s(mask));
        Self::of_bits(s, s.xor_u32s(s.transmute_u32s_f32s(self.v), sign))
    }

    #[inline(always)]
    pub(super) fn sqrt(self) -> Self {
        Self { s: self.s, v: self.s.sqrt_f32s(self.v) }
    }

    #[inline(always)]
    pub(super) fn lt(self, b: Self) -> Mask<S> {
        Mask { s: self.s, m: self.s.less_than_f32s(self.v, b.v) }
    }

    #[inline(always)]
    pub(super) fn le(self, b: Self) -> Mask<S> {
        Mask { s: self.s, m: self.s.less_than_or_equal_f32s(self.v, b.v) }
    }

    /// The numbers with these bits.
    #[inline(always)]
    pub(super) fn of_bits(s: S, bits: S::u32s) -> Self {
        Self { s, v: s.transmute_f32s_u32s(bits) }
    }

    /// Converts whole numbers in `[0, 2²³)` to integers: adding 2²³ puts them in the last bits.
    #[inline(always)]
    pub(super) fn whole(self) -> S::u32s {
        let bits = self.s.transmute_u32s_f32s((self + 8_388_608.0).v);
        self.s.sub_u32s(bits, self.s.splat_u32s(8_388_608.0_f32.to_bits()))
    }

    #[inline(always)]
    pub(super) fn sum(self) -> f32 {
        self.s.reduce_sum_f32s(self.v)
    }

    #[inline(always)]
    pub(super) fn max_lane(self) -> f32 {
        self.s.reduce_max_f32s(self.v)
    }

    /// 2^self for self in `[−126, 126]`, with a relative error below 2e-7; undefined outside.
    #[inline(always)]
    pub(super) fn exp2(self) -> Self {
        let [power] = exp2_of([self]);
        power
    }

    /// e^self with self clamped to `[−87, 88]`; relative error below 2e-7.
    #[inline(always)]
    pub(super) fn exp(self) -> Self {
        let s = self.s;
        let c = |x: f32| Self::splat(s, x);
        let x = self.max(c(-87.0)).min(c(88.0));
        let magic = c(12_582_912.0);
        let shifted = x.mul_add(c(std::f32::consts::LOG2_E), magic);
        let n = shifted - magic;
        // ln 2 in two parts (Cody and Waite): the first has few bits, so that n · first is exact.
        let f = n.neg_mul_add(c(0.693_145_75), x);
        let f = n.neg_mul_add(c(1.428_606_8e-6), f);
        let p = c(1.984_127e-4)
            .mul_add(f, c(1.388_888_9e-3))
            .mul_add(f, c(8.333_334e-3))
            .mul_add(f, c(4.166_666_6e-2))
            .mul_add(f, c(1.666_666_7e-1))
            .mul_add(f, c(0.5))
            .mul_add(f, c(1.0))
            .mul_add(f, c(1.0));
        let exponent = s.wrapping_dyn_shl_u32s(s.transmute_u32s_f32s(shifted.v), s.splat_u32s(23));
        let bits = s.add_u32s(s.transmute_u32s_f32s(p.v), exponent);
        Self { s, v: s.transmute_f32s_u32s(bits) }
    }

    /// log₂ of self in `[1, 2]`; absolute error below 3e-7.
    ///
    /// atanh series: ln w = 2·artanh((w − 1)/(w + 1)), argument at most 1/3.
    #[inline(always)]
    pub(super) fn log2_of_1_to_2(self) -> Self {
        let s = self.s;
        let c = |x: f32| Self::splat(s, x);
        let t = (self - c(1.0)) / (self + c(1.0));
        let t2 = t * t;
        let p = c(1.0 / 13.0)
            .mul_add(t2, c(1.0 / 11.0))
            .mul_add(t2, c(1.0 / 9.0))
            .mul_add(t2, c(1.0 / 7.0))
            .mul_add(t2, c(1.0 / 5.0))
            .mul_add(t2, c(1.0 / 3.0))
            .mul_add(t2, c(1.0));
        t * p * c(2.0 * std::f32::consts::LOG2_E)
    }

    /// log₂ of self in `[0, ∞)`; absolute error below 3e-7 plus the rounding of the result. 0 and subnormal numbers count
    /// as 2⁻¹²⁶.
    #[inline(always)]
    pub(super) fn log2(self) -> Self {
        let s = self.s;
        let x = self.max(Self::splat(s, f32::MIN_POSITIVE));
        let bits = s.transmute_u32s_f32s(x.v);
        let mantissa = s.and_u32s(bits, s.splat_u32s((1 << 23) - 1));
        let between_1_and_2 = s.or_u32s(mantissa, s.splat_u32s(1.0_f32.to_bits()));
        // The exponent as the last bits of 2²³ + exponent.
        let exponent = s.wrapping_dyn_shr_u32s(bits, s.splat_u32s(23));
        let exponent = s.or_u32s(exponent, s.splat_u32s(8_388_608.0_f32.to_bits()));
        let exponent = Self::of_bits(s, exponent) - (8_388_608.0 + 127.0);
        exponent + Self::of_bits(s, between_1_and_2).log2_of_1_to_2()
    }
}

/// The first `N` vectors of `from`.
#[inline(always)]
pub(super) fn load_of<S: Simd, const N: usize>(s: S, from: &[f32]) -> [V<S>; N] {
    let mut vectors = [V::zero(s); N];
    for (n, vector) in vectors.iter_mut().enumerate() {
        *vector = V::load(s, &from[n * S::F32_LANES..]);
    }
    vectors
}

/// Stores `N` vectors.
#[inline(always)]
pub(super) fn store_of<S: Simd, const N: usize>(vectors: [V<S>; N], to: &mut [f32]) {
    for (n, vector) in vectors.into_iter().enumerate() {
        vector.store(&mut to[n * S::F32_LANES..]);
    }
}

/// [`V::exp2`] of `N` vectors in lockstep: with only sixteen registers, constants are reloaded for each use, and one
/// load then serves all vectors.
///
/// Adding 1.5·2²³ leaves the nearest integer in the last bits; 2^f of the remainder f in
/// `[−½, ½]` is a minimax polynomial of degree 6 (relative error 2e-9 before rounding).
#[inline(always)]
pub(super) fn exp2_of<S: Simd, const N: usize>(x: [V<S>; N]) -> [V<S>; N] {
    let s = x[0].s;
    let magic = V::splat(s, 12_582_912.0);
    let (mut shifted, mut f) = (x, x);
    for n in 0..N {
        shifted[n] = x[n] + magic;
        f[n] = x[n] - (shifted[n] - magic);
    }
    let mut p = [V::splat(s, 1.534_581_2e-4); N];
    for coefficient in
        [1.339_993_1e-3, 9.618_489e-3, 5.550_328_8e-2, 2.402_264_7e-1, 6.931_472e-1, 1.0]
    {
        let coefficient = V::splat(s, coefficient);
        for n in 0..N {
            p[n] = p[n].mul_add(f[n], coefficient);
        }
    }
    for n in 0..N {
        let shifted = s.transmute_u32s_f32s(shifted[n].v);
        let exponent = s.wrapping_dyn_shl_u32s(shifted, s.splat_u32s(23));
        p[n] = V::of_bits(s, s.add_u32s(s.transmute_u32s_f32s(p[n].v), exponent));
    }
    p
}

impl V<Scalar> {
    /// The only lane.
    #[inline(always)]
    pub(super) fn lane(self) -> f32 {
        self.v
    }
}

/// The sum over the lanes of each of four vectors. With eight lanes or more they are reduced together, which takes half
/// the operations. With four, `pulp` puts lanes in another order, and each vector is summed in two instructions.
#[inline(always)]
pub(super) fn sums_of_four<S: Simd>([a, b, c, d]: [V<S>; 4]) -> [f32; 4] {
    if S::F32_LANES < 8 {
        return [a.sum(), b.sum(), c.sum(), d.sum()];
    }
    let s = a.s;
    let [even, odd]: [S::f32s; 2] = s.deinterleave_shfl_f32s([halves(a, c).v, halves(b, d).v]);
    // Each group of four lanes: a part of the sum of a, of b, of c and of d.
    let mut lanes = [0.0; WIDTH];
    V { s, v: s.add_f32s(even, odd) }.store(&mut lanes);
    let mut sums = [0.0; 4];
    for (k, sum) in sums.iter_mut().enumerate() {
        *sum = match S::F32_LANES {
            16 => (lanes[k] + lanes[4 + k]) + (lanes[8 + k] + lanes[12 + k]),
            _ => lanes[k] + lanes[4 + k],
        };
    }
    sums
}

/// In each group of four lanes: a₀ + a₂, a₁ + a₃, c₀ + c₂, c₁ + c₃.
#[inline(always)]
fn halves<S: Simd>(a: V<S>, c: V<S>) -> V<S> {
    let s = a.s;
    // Not pulp's own cast: it does not compile for a single lane, although this function is never called then.
    let pairs = [pulp::bytemuck::cast(a.v), pulp::bytemuck::cast(c.v)];
    let [even, odd]: [S::f64s; 2] = s.deinterleave_shfl_f64s(pairs);
    V { s, v: s.add_f32s(pulp::bytemuck::cast(even), pulp::bytemuck::cast(odd)) }
}

impl<S: Simd> Mask<S> {
    #[inline(always)]
    pub(super) fn and(self, b: Self) -> Self {
        Self { s: self.s, m: self.s.and_m32s(self.m, b.m) }
    }

    #[inline(always)]
    pub(super) fn or(self, b: Self) -> Self {
        Self { s: self.s, m: self.s.or_m32s(self.m, b.m) }
    }

    /// `yes` where true, `no` elsewhere. Avoids `select_f32s`, for the reason given at [`V::abs`].
    #[inline(always)]
    pub(super) fn select(self, yes: V<S>, no: V<S>) -> V<S> {
        let s = self.s;
        let [yes, no] = [s.transmute_u32s_f32s(yes.v), s.transmute_u32s_f32s(no.v)];
        V::of_bits(s, s.select_u32s(self.m, yes, no))
    }

    /// `yes` where true, 0 elsewhere.
    #[inline(always)]
    pub(super) fn keep(self, yes: V<S>) -> V<S> {
        let s = self.s;
        if size_of::<S::m32s>() != size_of::<S::u32s>() {
            return self.select(yes, V::zero(s));
        }
        // The bits of a lane are all set or all clear. The compiler does not know this and would test the signs.
        let mask: S::u32s = pulp::bytemuck::cast(self.m);
        V::of_bits(s, s.and_u32s(mask, s.transmute_u32s_f32s(yes.v)))
    }

    /// The mask as an integer, bit i for lane i. AVX-512 masks are bits already; other masks have all bits of a lane
    /// set or clear, and without vectors a lane is one byte.
    #[inline(always)]
    pub(super) fn bits(self) -> u32 {
        // AVX2 has an instruction for this, which must be called explicitly; the generic code takes two dozen
        // instructions.
        #[cfg(target_arch = "x86_64")]
        if let Some(v3) = (&self.s as &dyn std::any::Any).downcast_ref::<pulp::x86::V3>() {
            return v3.avx._mm256_movemask_ps(pulp::bytemuck::cast(self.m)) as u32;
        }
        let bytes = pulp::bytemuck::bytes_of(&self.m);
        if let [low, high] = *bytes {
            return u32::from(u16::from_le_bytes([low, high]));
        }
        let mut bits = 0;
        for (lane, bytes) in bytes.chunks_exact(bytes.len() / S::F32_LANES).enumerate() {
            bits |= u32::from(bytes[0] & 1) << lane;
        }
        bits
    }

    /// `yes` where true, `no` elsewhere.
    #[inline(always)]
    pub(super) fn select_u32s(self, yes: S::u32s, no: S::u32s) -> S::u32s {
        self.s.select_u32s(self.m, yes, no)
    }

    /// Sets `bits` in `to` where true.
    #[inline(always)]
    pub(super) fn or_bits(self, to: S::u32s, bits: u32) -> S::u32s {
        self.s.or_u32s(to, self.select_u32s(self.s.splat_u32s(bits), self.s.splat_u32s(0)))
    }

    #[inline(always)]
    pub(super) fn any(self) -> bool {
        self.bits() != 0
    }
}

/// Returns whether `a < b`, lane by lane, as unsigned integers.
#[inline(always)]
pub(super) fn before<S: Simd>(s: S, a: S::u32s, b: S::u32s) -> Mask<S> {
    Mask { s, m: s.less_than_u32s(a, b) }
}

macro_rules! operator {
    ($trait:ident, $method:ident, $simd:ident) => {
        impl<S: Simd> $trait for V<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, b: Self) -> Self {
                Self { s: self.s, v: self.s.$simd(self.v, b.v) }
            }
        }
        impl<S: Simd> $trait<f32> for V<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, b: f32) -> Self {
                Self { s: self.s, v: self.s.$simd(self.v, self.s.splat_f32s(b)) }
            }
        }
    };
}
operator!(Add, add, add_f32s);
operator!(Sub, sub, sub_f32s);
operator!(Mul, mul, mul_f32s);
operator!(Div, div, div_f32s);

impl<S: Simd> Neg for V<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        let s = self.s;
        let bits = s.transmute_u32s_f32s(self.v);
        Self::of_bits(s, s.xor_u32s(bits, s.splat_u32s(SIGN)))
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "small whole numbers are exact")]
mod tests;
