//! Rows with a non-finite number, as [`Backend::audit`](super::Backend::audit) reports them.
//!
//! A single NaN or infinity in a gradient makes the parameter NaN or its second moment infinite for good, so that
//! an audit at any later time finds it. Until then the row does no harm, as projection skips rows with a non-finite
//! parameter.

use std::fmt;

use densify_core::gaussians::ModelArray;

/// The kind of a non-finite number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NumberKind {
    /// A parameter.
    Parameter,
    /// A first or second moment of the optimiser: the gradient was NaN, or too large to be squared.
    Moment,
}

/// A row with a non-finite number, and the first such number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NonFinite {
    /// Index of the row.
    pub row: u32,
    /// The array of the parameter, which is non-finite or has a non-finite moment.
    pub array: ModelArray,
    /// The kind of number.
    pub kind: NumberKind,
}

impl fmt::Display for NonFinite {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { row, array, kind } = self;
        let parameter = match array {
            ModelArray::Means => "mean",
            ModelArray::LogScales => "log-scale",
            ModelArray::Quats => "quaternion",
            ModelArray::OpacityLogits => "opacity",
            ModelArray::Sh => "spherical-harmonic coefficients",
        };
        let moment = if *kind == NumberKind::Moment { "optimiser's moment of the " } else { "" };
        write!(f, "the {moment}{parameter} of row {row}")
    }
}
