//! Rows with a number that is not finite.
//!
//! One NaN or infinity in a gradient makes the parameter that it steps NaN, or its second moment
//! infinite, and neither ever leaves it again: [`Backend::audit`](super::Backend::audit) finds them
//! whenever it looks. Until then such a row does no harm, as projection skips every row that has a
//! parameter that is not finite.

use std::fmt;

/// A class of a row's numbers.
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
    /// Of a number of a row, in the order in which backends keep them: mean, log-scales, quaternion,
    /// opacity logit, coefficients.
    pub(super) fn of(number: usize) -> Self {
        match number {
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

/// Where a number that is not finite was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kept {
    /// Among the parameters.
    Parameter,
    /// Among the optimiser's first or second moments: its gradient was no number, or too large to be
    /// squared.
    Moment,
}

/// A row that holds a number that is NaN or infinite; the first such number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unsound {
    /// The row.
    pub row: u32,
    /// The class of the number.
    pub attribute: Attribute,
    /// Whose number it is.
    pub kept: Kept,
}

impl fmt::Display for Unsound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { row, attribute, kept } = self;
        match kept {
            Kept::Parameter => write!(f, "the {attribute} of row {row}"),
            Kept::Moment => write!(f, "the optimiser's moment of the {attribute} of row {row}"),
        }
    }
}
