//! In how many bits numbers that last from step to step are stored. Arithmetic is f32 throughout.
//!
//! A number that is stored in fewer bits is rounded to one of its two neighbours at random, so that
//! on average it is what it was: a step of Adam is often smaller than half the distance of two
//! neighbours, and would be lost for good if it were always rounded to the nearer.

/// How the numbers of a model and of its optimiser are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Storage {
    /// The model.
    pub parameters: ParameterStorage,
    /// Adam's two moments.
    pub moments: MomentStorage,
}

/// How parameters are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ParameterStorage {
    /// 4 bytes each.
    #[default]
    F32,
    /// Means 4 bytes each, all others 2. Coefficients of colour are IEEE 754 binary16: 11 significant
    /// bits, up to 65,504. Log-scales and opacity logits (within ±16) and quaternions (±2), which are
    /// bounded, are in fixed point, steps of 2⁻¹¹ and 2⁻¹⁴.
    F16,
}

/// How the optimiser's moments are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum MomentStorage {
    /// 4 bytes each.
    #[default]
    F32,
    /// 1 byte each: the second, a squared gradient, as a float of one significant digit after the first,
    /// from 2⁻⁹⁶ (whose root is near Adam's ε) to 1.5·2³⁰; the first as a multiple of the root of the
    /// second, which bounds it.
    Both8,
}
