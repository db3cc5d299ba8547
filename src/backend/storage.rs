//! The formats in which parameters and moments are stored between steps; arithmetic is always f32.
//!
//! Numbers stored in fewer bits are rounded stochastically, without bias: a step of Adam is often
//! smaller than half the distance between two neighbours and would always be lost if it were rounded
//! to the nearest.

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
