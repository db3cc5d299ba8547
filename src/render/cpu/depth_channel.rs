//! The channel of depth between the kernel that writes it, [`depth_gradient`](super::depth_gradient), and the backward
//! pass that differentiates it.

use super::rasterize::DEPTH;
use super::simd::SIGN;
use crate::depth::{DepthLoss, DepthTerm};

/// The planes of the canvas that hold c, n and a; m is in the plane
/// [`BY_DEPTH`](super::rasterize_bwd::BY_DEPTH) of the gradient.
pub(super) const CENTRE: usize = DEPTH;
pub(super) const SQUARE: usize = 0;
pub(super) const BY_ALPHA: usize = 1;

/// How the depth channel depends on a splat's depth z.
#[derive(Debug, Clone, Copy)]
pub(super) struct DepthChannel {
    /// True if x is 1/z, false if it is z.
    is_inverse: bool,
    /// True if the channel has squares.
    pub(super) has_squares: bool,
    /// The sign bit if ρ is the absolute value, 0 if it is the identity.
    pub(super) sign_bit: u32,
}

impl DepthChannel {
    /// Depth itself.
    pub(super) const DEPTH: Self = Self { is_inverse: false, has_squares: false, sign_bit: 0 };

    pub(super) fn of_loss(loss: &DepthLoss<'_>) -> Self {
        let sign_bit = match loss.term {
            DepthTerm::Expected => 0,
            DepthTerm::Samples => SIGN,
        };
        Self { is_inverse: true, has_squares: loss.distortion > 0.0, sign_bit }
    }

    /// x of a splat.
    #[inline(always)]
    pub(super) fn value(self, depth: f32) -> f32 {
        if self.is_inverse { 1.0 / depth } else { depth }
    }

    /// dx/dz.
    #[inline(always)]
    pub(super) fn derivative(self, depth: f32) -> f32 {
        if self.is_inverse { -(1.0 / depth) * (1.0 / depth) } else { 1.0 }
    }
}
