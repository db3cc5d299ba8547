//! Weights of Gaussians in front of the surface that the views show: floaters have most of theirs there.

use densify_policies::policy::{AuxColumn, AuxRequest};

use densify_render::AuxOutput;

/// Default margin: a Gaussian is in front of the surface if it is nearer by more than this fraction of the surface's
/// depth.
pub const MARGIN: f32 = 0.05;
/// A Gaussian is a floater if more than this share of its weight is in front of the surface.
const MOSTLY: f64 = 0.5;

/// Blend weights α·T of a Gaussian, summed over the pixels of all measured views.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RowWeights {
    /// The part in front of the surface; see [`AuxColumn::WeightInFront`].
    pub in_front: f64,
    /// The whole weight.
    pub whole: f64,
}

impl RowWeights {
    /// The share of the weight in front of the surface, in `[0, 1]`; 0 without any weight.
    pub fn share(self) -> f64 {
        if self.whole > 0.0 { self.in_front / self.whole } else { 0.0 }
    }

    /// True if most of the weight is in front of the surface.
    pub fn is_floater(self) -> bool {
        self.share() > MOSTLY
    }
}

/// The measurements in each view; `margin`, in `0..1`: a Gaussian is in front of the surface if it is nearer by more
/// than this fraction of the surface's depth.
pub fn request(margin: f32) -> AuxRequest {
    let columns = vec![AuxColumn::WeightInFront, AuxColumn::WeightSum];
    AuxRequest { columns, margin, ..AuxRequest::default() }
}

/// Adds the weights of a view, measured by [`request`]. Shape of `sums`: `[rows]`.
pub fn add(sums: &mut [RowWeights], measured: &AuxOutput) {
    let [(_, in_front), (_, whole)] = &measured.columns[..] else { return };
    for (sum, (in_front, whole)) in sums.iter_mut().zip(in_front.iter().zip(whole)) {
        sum.in_front += f64::from(*in_front);
        sum.whole += f64::from(*whole);
    }
}
