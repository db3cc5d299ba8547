//! `--sh-degree`: how colours may depend on the direction of view, and who decides it.

use std::ops::RangeInclusive;

use crate::config::{DegreeSource, RunConfig};
use crate::spec::RunSpec;
use crate::values::ShDegree;
use densify_core::gaussians::MAX_SH_DEGREE;
use densify_core::numbers::grouped;
use densify_data::dataset::Dataset;
use densify_data::track_colours;
use densify_data::track_colours::{MIN_TRACKS, TrackColours};

/// The degree of a run, before its memory is known.
#[derive(Debug, Clone)]
pub(crate) struct Degree {
    /// The highest wanted, and how far memory may lower it.
    pub(crate) range: RangeInclusive<u8>,
    /// Who decided it.
    pub(crate) source: DegreeSource,
}

impl Degree {
    pub(crate) fn highest(&self) -> u8 {
        *self.range.end()
    }

    /// Decides it: from the configuration of a run that goes on, else as the options say, else from
    /// the colours of the dataset's tracks, where it has enough.
    pub(crate) fn decide(
        spec: &RunSpec,
        saved: Option<&RunConfig>,
        dataset: &Dataset,
        colours: Option<&TrackColours>,
    ) -> Self {
        let given = |range| Self { range, source: DegreeSource::Given };
        match spec.size.sh_degree {
            // As a resumed run had it, or decided before.
            Some(ShDegree::Fixed(degree) | ShDegree::Auto(Some(degree))) => {
                let source = saved.map_or(DegreeSource::Given, |run| run.resolved.sh_degree_from);
                Self { range: degree..=degree, source }
            }
            None if spec.size.full => given(MAX_SH_DEGREE..=MAX_SH_DEGREE),
            None => given(0..=MAX_SH_DEGREE),
            Some(ShDegree::Auto(None)) => {
                let found = colours.map(|colours| track_colours::measure(&dataset.tracks, colours));
                let decided = found.and_then(|found| Some((found.degree()?, found)));
                let (degree, source) = match decided {
                    Some((degree, spread)) => (degree, DegreeSource::Spread(spread)),
                    None => (MAX_SH_DEGREE, DegreeSource::Undecided),
                };
                Self { range: 0..=degree, source }
            }
        }
    }

    /// What there is to say about it, if anything.
    pub(crate) fn line(&self) -> Option<String> {
        match self.source {
            DegreeSource::Given => None,
            DegreeSource::Spread(found) => Some(format!(
                "colour   degree {} (auto): between their views a twentieth of {} points differ by {:.1}/255 or \
                 more",
                self.highest(),
                grouped(found.tracks),
                found.twentieth,
            )),
            DegreeSource::Undecided => Some(format!(
                "colour   degree {} (auto): points of a reconstruction decide nothing, as fewer than \
                 {MIN_TRACKS} are known in enough views, or fewer than half of them lie on surfaces",
                self.highest()
            )),
        }
    }
}
