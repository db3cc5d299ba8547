//! `--exposure`: whether each photograph has an exposure of its own, and who decides it.

use crate::dataset::Dataset;
use crate::exposure::evidence::ExposureSpread;
use crate::exposure::{ExposureChoice, Exposures};
use crate::number::grouped;
use crate::run::config::{ExposureSource, RunConfig};
use crate::run::spec::RunSpec;
use crate::spread::{MIN_TRACKS, TrackColours};

/// The exposures of a run.
#[derive(Debug, Clone)]
pub(in crate::run) struct Exposure {
    /// Whether they are learned.
    pub(in crate::run) is_on: bool,
    /// Who decided it.
    pub(in crate::run) source: ExposureSource,
    /// Gains of the training views to begin with, by the colours of tracks; none where these are not known.
    gains: Vec<[f32; 3]>,
}

impl Exposure {
    /// Decides it: from the configuration of a run that goes on, else as the option says, else from the
    /// colours of tracks.
    pub(in crate::run) fn decide(
        spec: &RunSpec,
        saved: Option<&RunConfig>,
        colours: Option<&TrackColours>,
    ) -> Self {
        if let Some(saved) = saved {
            let resolved = &saved.resolved;
            let source = resolved.exposure_from;
            return Self { is_on: resolved.has_exposures, source, gains: Vec::new() };
        }
        let measured = colours.map(ExposureSpread::measure);
        let source = |found: Option<ExposureSpread>| match found {
            Some(found) => ExposureSource::Tracks(found),
            None => ExposureSource::Undecided,
        };
        let decided = measured
            .as_ref()
            .and_then(|(found, gains)| Some((found.decides(gains.len())?, *found)));
        let (is_on, source) = match spec.schedule.exposure {
            ExposureChoice::Off => (false, ExposureSource::Given),
            ExposureChoice::On => (true, ExposureSource::Given),
            ExposureChoice::Auto => {
                (decided.is_some_and(|(differ, _)| differ), source(decided.map(|(_, found)| found)))
            }
        };
        let gains = measured.filter(|_| is_on && decided.is_some()).map(|(_, gains)| gains);
        Self { is_on, source, gains: gains.unwrap_or_default() }
    }

    /// What the run begins with, if exposures are learned.
    pub(in crate::run) fn first(&self, spec: &RunSpec, dataset: &Dataset) -> Option<Exposures> {
        let alike = vec![[1.0; 3]; dataset.train.len()];
        let gains = if self.gains.is_empty() { &alike } else { &self.gains };
        self.is_on.then(|| Exposures::new(spec.schedule.exposure_model, gains))
    }

    /// What there is to say about it, if anything.
    pub(in crate::run) fn line(&self) -> Option<String> {
        let word = if self.is_on { "on" } else { "off" };
        match self.source {
            ExposureSource::Given if self.is_on && self.gains.is_empty() => {
                Some("exposure on, from one for all views".to_owned())
            }
            ExposureSource::Given if self.is_on => {
                Some("exposure on, from the gains of points in several views".to_owned())
            }
            ExposureSource::Given => None,
            ExposureSource::Tracks(found) => Some(format!(
                "exposure {word} (auto): by the colours of {} points, {} views differ by {:.2} stops (rms); \
                 with gains, colours differ by {:.1}/255 instead of {:.1}/255",
                grouped(found.tracks),
                found.views,
                found.stops,
                found.with_gains,
                found.alike,
            )),
            ExposureSource::Undecided => Some(format!(
                "exposure {word} (auto): fewer than {MIN_TRACKS} points of a reconstruction are known in enough \
                 views to say; --exposure on learns exposures all the same"
            )),
        }
    }
}
