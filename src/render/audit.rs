//! Rows with a non-finite number, as [`Backend::audit`](super::Backend::audit) reports them.
//!
//! A single NaN or infinity in a gradient makes the parameter NaN or its second moment infinite for good, so that
//! an audit at any later time finds it. Until then the row does no harm, as projection skips rows with a non-finite
//! parameter.

use std::fmt;

/// A class of parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Attribute {
    /// The mean.
    Mean,
    /// The log-scales.
    LogScale,
    /// The quaternion.
    Quat,
    /// The opacity logit.
    Opacity,
    /// The spherical-harmonic coefficients.
    Sh,
}

impl Attribute {
    /// The class of a row's parameter, by its index: mean, log-scales, quaternion, opacity logit, coefficients.
    pub(super) fn of_parameter(index: usize) -> Self {
        match index {
            0..3 => Self::Mean,
            3..6 => Self::LogScale,
            6..10 => Self::Quat,
            10 => Self::Opacity,
            _ => Self::Sh,
        }
    }
}

impl fmt::Display for Attribute {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Mean => "mean",
            Self::LogScale => "log-scale",
            Self::Quat => "quaternion",
            Self::Opacity => "opacity",
            Self::Sh => "spherical-harmonic coefficients",
        })
    }
}

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
    /// The row.
    pub row: u32,
    /// The class of the parameter.
    pub attribute: Attribute,
    /// The kind of number.
    pub kind: NumberKind,
}

impl fmt::Display for NonFinite {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { row, attribute, kind } = self;
        match kind {
            NumberKind::Parameter => write!(f, "the {attribute} of row {row}"),
            NumberKind::Moment => {
                write!(f, "the optimiser's moment of the {attribute} of row {row}")
            }
        }
    }
}
