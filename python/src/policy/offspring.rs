//! Children, scales and opacities as Python describes them: a `Rule` has a kind and numbers, for all rows or one each.

use densify_policies::plan::{
    NO_ROTATION, Offspring, OpacityRule, ParentFate, Placement, ScaleRule,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

use crate::arrays::{PerRow, floats};

/// How scales change.
pub(super) enum Scales {
    Uniform(PerRow<1>),
    Axes(PerRow<3>),
    Set(PerRow<1>),
    LongAxis(PerRow<1>, PerRow<1>),
}

/// How opacities change.
pub(super) enum Opacities {
    Same,
    Conserved,
    Set(PerRow<1>),
    Scaled(PerRow<1>),
}

enum Placements {
    Offset(PerRow<3>),
    Sampled,
    LongAxis(PerRow<1>),
    Axes(PerRow<3>),
}

/// The kind of a `densify.Rule`, or a word.
fn kind_of(given: &Bound<'_, PyAny>, name: &str) -> PyResult<String> {
    if let Ok(word) = given.extract::<String>() {
        return Ok(word);
    }
    let kind = given.getattr("kind").and_then(|kind| kind.extract::<String>());
    kind.map_err(|_| {
        PyTypeError::new_err(format!(
            "{name}: expected a rule, such as densify.by(0.5) or densify.to(0.1), not {}",
            given.get_type()
        ))
    })
}

fn unknown<T>(name: &str, kind: &str, known: &str) -> PyResult<T> {
    Err(PyValueError::new_err(format!("{name}: `{kind}` is not one of {known}")))
}

impl Scales {
    /// `by(factor)`, `by([[x, y, z]])`, `to(scale)`, `long_axis(long, other)`, or a factor.
    pub(super) fn new(given: &Bound<'_, PyAny>, count: usize) -> PyResult<Self> {
        let name = "scale";
        if !given.hasattr("kind")? && given.extract::<String>().is_err() {
            return Self::factors(given, count);
        }
        let kind = kind_of(given, name)?;
        let value = given.getattr("value").ok();
        match (&*kind, value) {
            ("by", Some(value)) => Self::factors(&value, count),
            ("to", Some(value)) => Ok(Self::Set(PerRow::new(&value, count, name)?)),
            ("long_axis", Some(value)) => {
                let other = given.getattr("other")?;
                Ok(Self::LongAxis(
                    PerRow::new(&value, count, name)?,
                    PerRow::new(&other, count, name)?,
                ))
            }
            _ => unknown(name, &kind, "by, to, long_axis"),
        }
    }

    fn factors(value: &Bound<'_, PyAny>, count: usize) -> PyResult<Self> {
        Ok(if is_per_axis(value, count)? {
            Self::Axes(PerRow::new(value, count, "scale")?)
        } else {
            Self::Uniform(PerRow::new(value, count, "scale")?)
        })
    }

    pub(super) fn at(&self, place: usize) -> ScaleRule {
        match self {
            Self::Uniform(factor) => ScaleRule::Uniform(factor.number(place)),
            Self::Axes(factors) => ScaleRule::Axes(factors.at(place)),
            Self::Set(scale) => ScaleRule::Set(scale.number(place)),
            Self::LongAxis(long, other) => {
                ScaleRule::LongAxis { long: long.number(place), other: other.number(place) }
            }
        }
    }
}

/// True for scales of the three axes: an array of two dimensions, however many rows there are.
///
/// # Errors
/// `ValueError` for three numbers for another number of rows: they may be meant for the axes.
pub(super) fn is_per_axis(value: &Bound<'_, PyAny>, count: usize) -> PyResult<bool> {
    let (_, shape) = floats(value, "scale")?;
    if shape == [3] && count != 3 {
        return Err(PyValueError::new_err(format!(
            "scale: three numbers are one for each of three rows, but there are {count} rows; numbers for the three \
             axes have the shape [1, 3] or [{count}, 3], such as [[x, y, z]]"
        )));
    }
    Ok(shape.len() == 2)
}

impl Opacities {
    /// `"same"`, `"conserved"`, `by(factor)`, `to(opacity)`.
    pub(super) fn new(given: &Bound<'_, PyAny>, count: usize) -> PyResult<Self> {
        let name = "opacity";
        let kind = kind_of(given, name)?;
        let value = given.getattr("value").ok();
        match (&*kind, value) {
            ("same", _) => Ok(Self::Same),
            ("conserved", _) => Ok(Self::Conserved),
            ("by", Some(value)) => Ok(Self::Scaled(PerRow::new(&value, count, name)?)),
            ("to", Some(value)) => Ok(Self::Set(PerRow::new(&value, count, name)?)),
            _ => unknown(name, &kind, "same, conserved, by, to"),
        }
    }

    pub(super) fn at(&self, place: usize) -> OpacityRule {
        match self {
            Self::Same => OpacityRule::Same,
            Self::Conserved => OpacityRule::Conserved,
            Self::Set(opacity) => OpacityRule::Set(opacity.number(place)),
            Self::Scaled(factor) => OpacityRule::Scaled(factor.number(place)),
        }
    }
}

/// The children of several rows.
pub(super) struct Offsprings {
    children: PerRow<1>,
    parent: ParentFate,
    placement: Placements,
    scale: Scales,
    turn: PerRow<4>,
    opacity: Opacities,
}

impl Offsprings {
    /// Takes a `densify.Offspring` for `count` rows.
    pub(super) fn new(given: &Bound<'_, PyAny>, count: usize) -> PyResult<Self> {
        if !given.hasattr("placement")? {
            return Err(PyTypeError::new_err(format!(
                "offspring: expected densify.clone(), densify.split(…) or densify.Offspring(…), not {}",
                given.get_type()
            )));
        }
        let parent: String = given.getattr("parent")?.extract()?;
        let placement = given.getattr("placement")?;
        let kind = kind_of(&placement, "placement")?;
        let value = || placement.getattr("value");
        let turn = given.getattr("turn")?;
        Ok(Self {
            children: PerRow::new(&given.getattr("children")?, count, "children")?,
            parent: match &*parent {
                "stays" => ParentFate::Stays,
                "becomes_child" => ParentFate::BecomesChild,
                other => return unknown("parent", other, "stays, becomes_child"),
            },
            placement: match &*kind {
                "sampled" => Placements::Sampled,
                "offset" => Placements::Offset(PerRow::new(&value()?, count, "placement")?),
                "long_axis" => Placements::LongAxis(PerRow::new(&value()?, count, "placement")?),
                "axes" => Placements::Axes(PerRow::new(&value()?, count, "placement")?),
                other => return unknown("placement", other, "sampled, offset, long_axis, axes"),
            },
            scale: Scales::new(&given.getattr("scale")?, count)?,
            turn: if turn.is_none() {
                PerRow::Same(NO_ROTATION)
            } else {
                PerRow::new(&turn, count, "turn")?
            },
            opacity: Opacities::new(&given.getattr("opacity")?, count)?,
        })
    }

    /// The children of the row at this place of the list of rows.
    pub(super) fn at(&self, place: usize) -> PyResult<Offspring> {
        let children = self.children.number(place);
        if !(children >= 1.0 && children <= u32::MAX as f32 && children.fract() == 0.0) {
            return Err(PyValueError::new_err(format!(
                "children: {children} is not a whole number of at least 1"
            )));
        }
        Ok(Offspring {
            children: children as u32,
            parent: self.parent,
            placement: match &self.placement {
                Placements::Sampled => Placement::Sampled,
                Placements::Offset(offset) => Placement::Offset(offset.at(place)),
                Placements::LongAxis(sigmas) => {
                    Placement::LongAxis { sigmas: sigmas.number(place) }
                }
                Placements::Axes(axes) => Placement::Axes(axes.at(place)),
            },
            scale: self.scale.at(place),
            turn: self.turn.at(place),
            opacity: self.opacity.at(place),
        })
    }
}
