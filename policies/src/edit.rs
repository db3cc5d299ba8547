//! The kinds of edits: children of a parent, rows rewritten in place, rows without a parent, decay, resets.
//!
//! The file is long because the types belong together; most lines are their documentation.

use serde::{Deserialize, Serialize};

use crate::signals::SignalSet;

/// The children of a clone or a split, and the fate of the parent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Offspring {
    /// Number of new rows, >= 1; the parent's own row is not counted.
    pub children: u32,
    /// Fate of the parent's row.
    pub parent: ParentFate,
    /// Positions of the children.
    pub placement: Placement,
    /// Scales of the children (and of a rewritten parent), relative to the parent's.
    pub scale: ScaleRule,
    /// Rotation of the children (and of a rewritten parent), applied after scaling, about the parent's own axes,
    /// new = old · turn: a quaternion (w, x, y, z) of any length but 0, or [`NO_ROTATION`].
    pub turn: [f32; 4],
    /// Opacities of the children (and of a rewritten parent), relative to the parent's.
    pub opacity: OpacityRule,
}

/// The identity quaternion.
pub const NO_ROTATION: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

/// The fate of a row that grows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ParentFate {
    /// Untouched: parameters, moments and age stay (a clone's parent).
    Stays,
    /// Rewritten as one more child: moments zero, age 0 (a split's parent).
    BecomesChild,
}

/// Positions of children. New rows are children 1, 2, …; a rewritten parent is child 0.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Placement {
    /// New rows at the parent's mean + this offset `[scene units]`; a rewritten parent stays in place.
    Offset([f32; 3]),
    /// Every child at mean + R·diag(s)·ξ, where ξ ~ N(0, I) and s are the parent's scales (the original adaptive
    /// density control, Kerbl et al. 2023, section 5.2).
    Sampled,
    /// Children on the parent's longest axis, `sigmas` from its mean: even children at +, odd children at −.
    LongAxis {
        /// Distance from the parent's mean in standard deviations of its longest axis.
        sigmas: f32,
    },
    /// Children at mean ± R·diag(s)·v, where v holds these numbers of standard deviations along the parent's three
    /// axes: even children +, odd children −.
    Axes([f32; 3]),
}

/// A change of scales.
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
    /// Each multiplied by its own factor, > 0.
    Axes([f32; 3]),
    /// All three set to this standard deviation `[scene units]`, > 0: the row becomes round.
    Set(f32),
}

/// A change of opacity.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum OpacityRule {
    /// No change.
    Same,
    /// This value, in (0, 1).
    Set(f32),
    /// Multiplied by this factor, in (0, 1].
    Scaled(f32),
    /// 1 − (1 − o)^(1/n), n = children (+ 1 if the parent becomes a child): together the n
    /// Gaussians are as opaque as the parent was.
    Conserved,
}

/// The changes to a row that is rewritten in place; see [`Update::NONE`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Update {
    /// New opacity.
    pub opacity: OpacityRule,
    /// New scales.
    pub scale: ScaleRule,
    /// New mean `[scene units]`; `None`: unchanged.
    pub position: Option<[f32; 3]>,
    /// New base colour, sRGB-encoded, between −[`COLOUR_MAX`] and `COLOUR_MAX` (colours of rows may lie
    /// outside `[0, 1]`). The view-dependent part is unchanged. `None`: unchanged.
    pub colour: Option<[f32; 3]>,
    /// Highest spherical-harmonic degree to keep; the coefficients of higher degrees and their moments become
    /// 0. `None`: all are kept.
    pub sh_degree: Option<u8>,
    /// If true, the row keeps its moments and its age; otherwise both become zero.
    pub keep_moments: bool,
}

/// A reduction of the opacities and scales of all rows, which keep their moments. See
/// [`EditPlan::decay`](crate::plan::EditPlan::decay).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Decay {
    /// Subtracted from opacities, >= 0; it does not reduce them below [`MIN_DECAYED_OPACITY`].
    pub opacity: f32,
    /// Share by which standard deviations are reduced, in `[0, 1)`.
    pub scale: f32,
    /// If true, only rows decay that were visible in a view since the last reset of
    /// [`Signal::VisibleCount`](crate::signals::Signal::VisibleCount), which must then be declared.
    pub seen_only: bool,
}

/// Opacity below which [`Decay`] does not go: far below the smallest alpha that is rendered, 1/255.
pub const MIN_DECAYED_OPACITY: f32 = 2e-4;

/// Largest magnitude of a base colour: larger values would not fit the narrowest storage format.
pub const COLOUR_MAX: f32 = 1e4;

/// A new row without a parent, whose colour does not depend on the view; see [`Seed::round`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Seed {
    /// Mean `[scene units]`.
    pub position: [f32; 3],
    /// Colour, sRGB-encoded in `[0, 1]`.
    pub colour: [f32; 3],
    /// Standard deviations along its axes `[scene units]`, > 0.
    pub scales: [f32; 3],
    /// Orientation of its axes, as [`Signal::Orientation`](crate::policy::Signal::Orientation): a
    /// quaternion (w, x, y, z) of any length but 0, or [`NO_ROTATION`].
    pub orientation: [f32; 4],
    /// Opacity, in (0, 1).
    pub opacity: f32,
}

/// An accumulator that a plan resets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reset {
    /// All [`Signal`](crate::signals::Signal)s that accumulate. This excludes `WeightMax` (kept per epoch) and the
    /// current state of rows (`Opacity`, `ScaleMax`, `ScaleProduct`, `Age`, attributes).
    Signals,
    /// Those of the given signals that accumulate, for signals with a reset interval of their own.
    Only(SignalSet),
    /// The list of candidates.
    Candidates,
}

/// True if `value` is strictly between 0 and 1.
pub(crate) fn in_open_unit(value: f32) -> bool {
    value > 0.0 && value < 1.0
}

fn is_positive(value: f32) -> bool {
    value.is_finite() && value > 0.0
}

fn all_finite(values: &[f32]) -> bool {
    values.iter().all(|v| v.is_finite())
}

/// True if the quaternion can be normalised.
fn is_rotation(quaternion: [f32; 4]) -> bool {
    quaternion.iter().map(|v| v * v).sum::<f32>().is_normal()
}

/// The name of the first check that fails.
fn first_failed(checks: &[(bool, &'static str)]) -> Option<&'static str> {
    checks.iter().find(|(holds, _)| !holds).map(|(_, name)| *name)
}

impl Offspring {
    /// The field that is not finite or out of its range, if any.
    pub fn bad_field(&self) -> Option<&'static str> {
        let placement = match self.placement {
            Placement::Offset(v) | Placement::Axes(v) => all_finite(&v),
            Placement::Sampled => true,
            Placement::LongAxis { sigmas } => sigmas.is_finite() && sigmas >= 0.0,
        };
        first_failed(&[
            (self.children >= 1, "children"),
            (placement, "placement"),
            (self.scale.is_valid(), "scale"),
            (is_rotation(self.turn), "turn"),
            (self.opacity.is_valid(), "opacity"),
        ])
    }

    /// True if the children are rotated, or their scales are set or change separately for each axis. Such edits
    /// must be declared by [`Needs::detailed_edits`](crate::policy::Needs).
    pub fn is_detailed(&self) -> bool {
        matches!(self.scale, ScaleRule::Axes(_) | ScaleRule::Set(_))
            || self.turn.map(f32::to_bits) != NO_ROTATION.map(f32::to_bits)
    }

    /// Number of Gaussians that share the parent's opacity: its children, and the parent if it becomes one.
    pub fn siblings(&self) -> u32 {
        self.children.saturating_add(u32::from(self.parent == ParentFate::BecomesChild))
    }
}

impl ScaleRule {
    /// True if all values are finite and positive.
    pub fn is_valid(&self) -> bool {
        match *self {
            Self::Uniform(factor) => is_positive(factor),
            Self::LongAxis { long, other } => is_positive(long) && is_positive(other),
            Self::Set(scale) => is_positive(scale),
            Self::Axes(factors) => factors.into_iter().all(is_positive),
        }
    }
}

impl OpacityRule {
    /// True if the value is in its range.
    pub fn is_valid(&self) -> bool {
        match *self {
            Self::Same | Self::Conserved => true,
            Self::Set(opacity) => in_open_unit(opacity),
            Self::Scaled(factor) => factor > 0.0 && factor <= 1.0,
        }
    }
}

impl Update {
    /// Changes nothing; a base for other updates, such as `Update { colour: …, ..Update::NONE }`.
    pub const NONE: Self = Self {
        opacity: OpacityRule::Same,
        scale: ScaleRule::Uniform(1.0),
        position: None,
        colour: None,
        sh_degree: None,
        keep_moments: true,
    };

    /// Restarts the row in place: round, with this standard deviation `[scene units]` and opacity, the
    /// same base colour from all directions, and zero moments.
    pub const fn restart(scale: f32, opacity: f32) -> Self {
        Self {
            opacity: OpacityRule::Set(opacity),
            scale: ScaleRule::Set(scale),
            sh_degree: Some(0),
            keep_moments: false,
            ..Self::NONE
        }
    }

    /// The field that is not finite or out of its range, if any. [`OpacityRule::Conserved`] is out of
    /// range, as there are no children to share the opacity with.
    pub fn bad_field(&self) -> Option<&'static str> {
        let opacity = self.opacity.is_valid() && self.opacity != OpacityRule::Conserved;
        let colour = |colour: [f32; 3]| colour.iter().all(|c| c.abs() <= COLOUR_MAX);
        first_failed(&[
            (opacity, "opacity"),
            (self.scale.is_valid(), "scale"),
            (self.position.is_none_or(|position| all_finite(&position)), "position"),
            (self.colour.is_none_or(colour), "colour"),
        ])
    }
}

impl Decay {
    /// The field that is not finite or out of its range, if any.
    pub fn bad_field(&self) -> Option<&'static str> {
        let opacity = self.opacity.is_finite() && self.opacity >= 0.0;
        first_failed(&[(opacity, "opacity"), ((0.0..1.0).contains(&self.scale), "scale")])
    }
}

impl Seed {
    /// A seed with standard deviation `scale` along all axes.
    pub const fn round(position: [f32; 3], colour: [f32; 3], scale: f32, opacity: f32) -> Self {
        Self { position, colour, scales: [scale; 3], orientation: NO_ROTATION, opacity }
    }

    /// The field that is not finite or out of its range, if any.
    pub fn bad_field(&self) -> Option<&'static str> {
        first_failed(&[
            (all_finite(&self.position), "position"),
            (self.colour.iter().all(|v| (0.0..=1.0).contains(v)), "colour"),
            (self.scales.into_iter().all(is_positive), "scales"),
            (is_rotation(self.orientation), "orientation"),
            (in_open_unit(self.opacity), "opacity"),
        ])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOT_FINITE: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    const SEED: Seed = Seed::round([0.0; 3], [0.0, 0.5, 1.0], 0.1, 0.1);

    fn not_positive() -> impl Iterator<Item = f32> {
        NOT_FINITE.into_iter().chain([-1.0, 0.0])
    }

    #[test]
    fn a_bad_field_of_offspring_is_named() {
        let clone = crate::adc::clone_at([0.0; 3]);
        assert_eq!(clone.bad_field(), None);
        assert_eq!(Offspring { children: 0, ..clone }.bad_field(), Some("children"));
        let placed = |placement| Offspring { placement, ..clone }.bad_field();
        let scaled = |scale| Offspring { scale, ..clone }.bad_field();
        let opaque = |opacity| Offspring { opacity, ..clone }.bad_field();
        for bad in not_positive() {
            assert_eq!(scaled(ScaleRule::Uniform(bad)), Some("scale"), "{bad}");
            assert_eq!(scaled(ScaleRule::LongAxis { long: bad, other: 1.0 }), Some("scale"));
            assert_eq!(scaled(ScaleRule::LongAxis { long: 1.0, other: bad }), Some("scale"));
            assert_eq!(scaled(ScaleRule::Axes([1.0, bad, 1.0])), Some("scale"), "{bad}");
            assert_eq!(scaled(ScaleRule::Set(bad)), Some("scale"), "{bad}");
            assert_eq!(opaque(OpacityRule::Set(bad)), Some("opacity"), "{bad}");
            assert_eq!(opaque(OpacityRule::Scaled(bad)), Some("opacity"), "{bad}");
        }
        for bad in NOT_FINITE {
            assert_eq!(placed(Placement::LongAxis { sigmas: bad }), Some("placement"), "{bad}");
            assert_eq!(placed(Placement::Offset([0.0, bad, 0.0])), Some("placement"), "{bad}");
            assert_eq!(placed(Placement::Axes([0.0, 0.0, bad])), Some("placement"), "{bad}");
            let turned = Offspring { turn: [1.0, bad, 0.0, 0.0], ..clone };
            assert_eq!(turned.bad_field(), Some("turn"), "{bad}");
        }
        assert_eq!(Offspring { turn: [0.0; 4], ..clone }.bad_field(), Some("turn"));
        assert_eq!(placed(Placement::LongAxis { sigmas: -1.0 }), Some("placement"));
        assert_eq!(opaque(OpacityRule::Set(1.0)), Some("opacity"));
        assert_eq!(opaque(OpacityRule::Scaled(1.0)), None);
    }

    #[test]
    fn a_bad_field_of_a_seed_is_named() {
        assert_eq!(SEED.bad_field(), None);
        for bad in not_positive() {
            let scales = [0.1, bad, 0.1];
            assert_eq!(Seed { scales, ..SEED }.bad_field(), Some("scales"), "{bad}");
            assert_eq!(Seed { opacity: bad, ..SEED }.bad_field(), Some("opacity"), "{bad}");
        }
        for bad in NOT_FINITE {
            assert_eq!(Seed { position: [0.0, bad, 0.0], ..SEED }.bad_field(), Some("position"));
            let orientation = [1.0, 0.0, bad, 0.0];
            assert_eq!(Seed { orientation, ..SEED }.bad_field(), Some("orientation"), "{bad}");
        }
        for bad in NOT_FINITE.into_iter().chain([-0.1, 1.1]) {
            assert_eq!(Seed { colour: [bad, 0.0, 0.0], ..SEED }.bad_field(), Some("colour"));
        }
        assert_eq!(Seed { orientation: [0.0; 4], ..SEED }.bad_field(), Some("orientation"));
        assert_eq!(Seed { opacity: 1.0, ..SEED }.bad_field(), Some("opacity"));
    }

    #[test]
    fn a_bad_field_of_a_decay_is_named() {
        let valid = Decay { opacity: 0.0, scale: 0.0, seen_only: false };
        assert_eq!(valid.bad_field(), None);
        for bad in NOT_FINITE.into_iter().chain([-0.1]) {
            assert_eq!(Decay { opacity: bad, ..valid }.bad_field(), Some("opacity"), "{bad}");
            assert_eq!(Decay { scale: bad, ..valid }.bad_field(), Some("scale"), "{bad}");
        }
        assert_eq!(Decay { scale: 1.0, ..valid }.bad_field(), Some("scale"));
        assert_eq!(Decay { opacity: 2.0, scale: 0.999, ..valid }.bad_field(), None);
    }

    #[test]
    fn a_bad_field_of_an_update_is_named() {
        assert_eq!(Update::restart(0.1, 0.1).bad_field(), None);
        assert_eq!(Update::restart(0.0, 0.1).bad_field(), Some("scale"));
        assert_eq!(Update::restart(0.1, 1.0).bad_field(), Some("opacity"));
        assert_eq!(Update::NONE.bad_field(), None);
        let field = |update: Update| update.bad_field();
        let opacity = OpacityRule::Conserved;
        assert_eq!(field(Update { opacity, ..Update::NONE }), Some("opacity"));
        assert_eq!(field(Update { scale: ScaleRule::Uniform(0.0), ..Update::NONE }), Some("scale"));
        for bad in NOT_FINITE {
            let vector = Some([0.0, 0.0, bad]);
            let position = Update { position: vector, ..Update::NONE };
            assert_eq!(field(position), Some("position"), "{bad}");
            assert_eq!(field(Update { colour: vector, ..Update::NONE }), Some("colour"), "{bad}");
        }
        assert_eq!(field(Update { colour: Some([-1.5, 0.0, 2.0]), ..Update::NONE }), None);
        let beyond = Some([0.0, 2.0 * COLOUR_MAX, 0.0]);
        assert_eq!(field(Update { colour: beyond, ..Update::NONE }), Some("colour"));
    }
}
