//! The kinds of edits: children of a parent, rows rewritten in place, rows without a parent, resets.

use serde::{Deserialize, Serialize};

/// The children of a clone or a split, and what becomes of the parent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Offspring {
    /// New rows beside the parent's own slot, >= 1.
    pub children: u32,
    /// What happens to the parent's own slot.
    pub parent: ParentFate,
    /// Where the children are placed.
    pub placement: Placement,
    /// How the scales of children (and of a rewritten parent) follow from the parent's.
    pub scale: ScaleRule,
    /// How the opacities of children (and of a rewritten parent) follow from the parent's.
    pub opacity: OpacityRule,
}

/// What happens to the row that grows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ParentFate {
    /// Untouched: parameters, moments and age stay (a clone's parent).
    Stays,
    /// Rewritten as one more child: moments zero, age 0 (a split's parent).
    BecomesChild,
}

/// Where children are placed. New rows are children 1, 2, …; a rewritten parent is child 0.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Placement {
    /// New rows at the parent's mean + this offset `[scene units]`; a rewritten parent does not move.
    Offset([f32; 3]),
    /// Every child at mean + R·diag(s)·ξ, ξ ~ N(0, I), s the parent's scales
    /// (original adaptive density control, Kerbl et al. 2023, section 5.2).
    Sampled,
    /// Children at ±`sigmas`·s along the parent's longest axis: even children +, odd children −.
    LongAxis {
        /// Distance from the parent's mean in standard deviations of its longest axis.
        sigmas: f32,
    },
}

/// How scales follow from the parent's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum ScaleRule {
    /// All three multiplied by this factor, > 0.
    Uniform(f32),
    /// The longest axis multiplied by `long`, the others by `other`, both > 0.
    LongAxis {
        /// Factor of the longest axis.
        long: f32,
        /// Factor of the two others.
        other: f32,
    },
}

/// How opacities follow from the parent's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum OpacityRule {
    /// The same.
    Same,
    /// This value, in (0, 1).
    Set(f32),
    /// Multiplied by this factor, in (0, 1].
    Scaled(f32),
    /// 1 − (1 − o)^(1/n), n = children (+ 1 if the parent becomes a child): together the n are as
    /// opaque as the parent was.
    Conserved,
}

/// A row rewritten in place.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Update {
    /// New opacity.
    pub opacity: OpacityRule,
    /// New scales.
    pub scale: ScaleRule,
    /// Whether the row keeps its moments and its age; otherwise both become zero.
    pub keep_moments: bool,
}

/// A new row without a parent: isotropic, unrotated, view-independent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Seed {
    /// Mean `[scene units]`.
    pub position: [f32; 3],
    /// Colour, sRGB-encoded in `[0, 1]`.
    pub colour: [f32; 3],
    /// Standard deviation of all three axes `[scene units]`, > 0.
    pub scale: f32,
    /// Opacity, in (0, 1).
    pub opacity: f32,
}

/// An accumulator that a plan resets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reset {
    /// The sums of all [`Signal`](crate::signals::Signal)s; not `WeightMax` (kept per epoch) nor
    /// current values (`Opacity`, `ScaleMax`, `Age`).
    Signals,
    /// The list of candidates.
    Candidates,
}

/// Whether `value` is a number strictly between 0 and 1.
pub(crate) fn in_open_unit(value: f32) -> bool {
    value > 0.0 && value < 1.0
}

fn positive(value: f32) -> bool {
    value.is_finite() && value > 0.0
}

impl Offspring {
    /// Whether every number is finite and in its range, and there is at least one child.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        let placement = match self.placement {
            Placement::Offset(offset) => offset.iter().all(|v| v.is_finite()),
            Placement::Sampled => true,
            Placement::LongAxis { sigmas } => sigmas.is_finite() && sigmas >= 0.0,
        };
        self.children >= 1 && placement && self.scale.is_valid() && self.opacity.is_valid()
    }

    /// How many Gaussians share the parent's opacity: its children, and the parent if it becomes one.
    #[must_use]
    pub fn siblings(&self) -> u32 {
        self.children.saturating_add(u32::from(self.parent == ParentFate::BecomesChild))
    }
}

impl ScaleRule {
    /// Whether every factor is finite and positive.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        match *self {
            Self::Uniform(factor) => positive(factor),
            Self::LongAxis { long, other } => positive(long) && positive(other),
        }
    }
}

impl OpacityRule {
    /// Whether its value is in its range.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        match *self {
            Self::Same | Self::Conserved => true,
            Self::Set(opacity) => in_open_unit(opacity),
            Self::Scaled(factor) => factor > 0.0 && factor <= 1.0,
        }
    }
}

impl Update {
    /// Whether its values are in range. [`OpacityRule::Conserved`] is not: there are no children to
    /// share the opacity with.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        self.scale.is_valid() && self.opacity.is_valid() && self.opacity != OpacityRule::Conserved
    }
}

impl Seed {
    /// Whether every number is finite and in its range.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        self.position.iter().all(|v| v.is_finite())
            && self.colour.iter().all(|v| (0.0..=1.0).contains(v))
            && positive(self.scale)
            && in_open_unit(self.opacity)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BAD: [f32; 4] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0];

    #[test]
    fn numbers_out_of_range_are_invalid() {
        let clone = Offspring {
            children: 1,
            parent: ParentFate::Stays,
            placement: Placement::Offset([0.0; 3]),
            scale: ScaleRule::Uniform(1.0),
            opacity: OpacityRule::Same,
        };
        assert!(clone.is_valid());
        assert!(!Offspring { children: 0, ..clone }.is_valid());
        for bad in BAD.into_iter().chain([0.0]) {
            assert!(!ScaleRule::Uniform(bad).is_valid(), "{bad}");
            assert!(!ScaleRule::LongAxis { long: bad, other: 1.0 }.is_valid(), "{bad}");
            assert!(!ScaleRule::LongAxis { long: 1.0, other: bad }.is_valid(), "{bad}");
            assert!(!OpacityRule::Set(bad).is_valid(), "{bad}");
            assert!(!OpacityRule::Scaled(bad).is_valid(), "{bad}");
        }
        for bad in BAD {
            let placement = Placement::LongAxis { sigmas: bad };
            assert!(!Offspring { placement, ..clone }.is_valid(), "{bad}");
        }
        for bad in [f32::NAN, f32::INFINITY] {
            let placement = Placement::Offset([0.0, bad, 0.0]);
            assert!(!Offspring { placement, ..clone }.is_valid(), "{bad}");
        }
        assert!(OpacityRule::Scaled(1.0).is_valid() && !OpacityRule::Set(1.0).is_valid());
    }

    #[test]
    fn a_seed_must_be_a_gaussian() {
        let seed = Seed { position: [0.0; 3], colour: [0.0, 0.5, 1.0], scale: 0.1, opacity: 0.1 };
        assert!(seed.is_valid());
        for bad in BAD {
            assert!(!Seed { colour: [bad, 0.0, 0.0], ..seed }.is_valid(), "{bad}");
            assert!(!Seed { scale: bad, ..seed }.is_valid(), "{bad}");
            assert!(!Seed { opacity: bad, ..seed }.is_valid(), "{bad}");
        }
        assert!(!Seed { position: [0.0, f32::NAN, 0.0], ..seed }.is_valid());
        assert!(!Seed { colour: [1.1, 0.0, 0.0], ..seed }.is_valid());
        assert!(!Seed { scale: 0.0, ..seed }.is_valid());
        assert!(!Seed { opacity: 1.0, ..seed }.is_valid());
    }

    #[test]
    fn an_update_conserves_no_opacity() {
        let update = Update {
            opacity: OpacityRule::Same,
            scale: ScaleRule::Uniform(1.0),
            keep_moments: true,
        };
        assert!(update.is_valid());
        assert!(!Update { opacity: OpacityRule::Conserved, ..update }.is_valid());
        assert!(!Update { scale: ScaleRule::Uniform(0.0), ..update }.is_valid());
    }
}
