//! `--sh-degree`: the degree to which colours may depend on the viewing direction.

use std::ops::RangeInclusive;

use super::inputs::Evidence;
use super::sources::DegreeSource;
use crate::spec::{Budget, InitChoice, RunSpec, ShDegree};
use densify_core::gaussians::MAX_SH_DEGREE;
use densify_core::numbers::grouped;
use densify_data::track_colours::{self, MIN_TRACKS};

/// The degree of a run, before its memory is known.
#[derive(Debug, Clone)]
pub(crate) struct Degree {
    /// From the lowest degree that the memory limit may enforce, to the degree that is wanted.
    pub(crate) range: RangeInclusive<u8>,
    pub(crate) source: DegreeSource,
}

impl Degree {
    pub(crate) fn highest(&self) -> u8 {
        *self.range.end()
    }

    /// True if trial runs decide the degree: a memory limit decides the number of rows, which depends on the degree, and
    /// no given model has colours already.
    fn is_tried(spec: &RunSpec) -> bool {
        let has_model = matches!(spec.start.init, Some(InitChoice::Model(_)));
        let is_auto_budget = spec.size.budget.is_some_and(Budget::is_auto);
        spec.size.memory.is_some() && !is_auto_budget && !has_model && spec.start.freeze.is_none()
    }

    /// True if the colours of the tracks decide the degree.
    pub(super) fn is_by_colours(spec: &RunSpec) -> bool {
        spec.size.sh_degree == Some(ShDegree::Auto(None)) && !Self::is_tried(spec)
    }

    /// Decides the degree by the options, or with `auto` by the colours of the dataset's tracks, if there are enough. If
    /// [trial runs](super::DegreeTrial) are to decide, it is the highest for now.
    /// In a resumed run the degree is a number, and `source` the original reason for it.
    pub(super) fn decide(
        spec: &RunSpec,
        source: Option<DegreeSource>,
        evidence: &Evidence,
    ) -> Self {
        let given = |range| Self { range, source: DegreeSource::Given };
        match spec.size.sh_degree {
            Some(ShDegree::Fixed(degree) | ShDegree::Auto(Some(degree))) => {
                Self { range: degree..=degree, source: source.unwrap_or_default() }
            }
            None if spec.size.full => given(MAX_SH_DEGREE..=MAX_SH_DEGREE),
            None => given(0..=MAX_SH_DEGREE),
            Some(ShDegree::Auto(None)) if Self::is_tried(spec) => {
                Self { range: 0..=MAX_SH_DEGREE, source: DegreeSource::Untried }
            }
            Some(ShDegree::Auto(None)) => {
                let colours = evidence.colours.as_ref();
                let spread = colours.map(|all| track_colours::measure(&evidence.tracks, all));
                let decided = spread.and_then(|spread| Some((spread.degree()?, spread)));
                let (degree, source) = match decided {
                    Some((degree, spread)) => (degree, DegreeSource::Spread(spread)),
                    None => (MAX_SH_DEGREE, DegreeSource::Undecided),
                };
                Self { range: 0..=degree, source }
            }
        }
    }

    /// A line for the user with the evidence for an automatic choice.
    pub(super) fn line(&self) -> Option<String> {
        match self.source {
            // About trial runs that are to be made, see `trial.rs`.
            DegreeSource::Given | DegreeSource::Untried => None,
            DegreeSource::Trial(trial) => {
                Some(format!("colour   degree {} (auto): {}", trial.degree(), trial.describe()))
            }
            DegreeSource::Spread(spread) => Some(format!(
                "colour   degree {} (auto): the colour of a twentieth of {} points varies by {:.1}/255 or more \
                 between the views that see them",
                self.highest(),
                grouped(spread.tracks),
                spread.twentieth,
            )),
            DegreeSource::Undecided => Some(format!(
                "colour   degree {} (auto): undecided, because fewer than {MIN_TRACKS} \
                 reconstructed points are known in enough views, or fewer than half of them lie on surfaces",
                self.highest()
            )),
        }
    }
}
