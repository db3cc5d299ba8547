//! `--exposure`: whether to learn an exposure for each photograph, and the exposures to start with.

use super::inputs::Evidence;
use super::sources::ExposureSource;
use crate::failure::notes;
use crate::spec::RunSpec;
use densify_core::numbers::{counted, grouped};
use densify_core::spelling::Spelling;
use densify_data::dataset::Dataset;
use densify_data::track_colours::MIN_TRACKS;
use densify_data::track_colours::exposures::{ExposureSpread, MIN_STOPS};
use densify_train::exposure::reported::{ExifUse, complete_gains, spread};
use densify_train::exposure::{ExposureChoice, Exposures};

/// The exposures of a run.
#[derive(Debug, Clone)]
pub(crate) struct Exposure {
    /// True if exposures are learned.
    pub(crate) is_on: bool,
    pub(crate) source: ExposureSource,
    /// Initial gains of the training views; empty if all views start alike.
    gains: Vec<[f32; 3]>,
    /// True if the gains come from the colours of tracks.
    from_tracks: bool,
    /// How the exposures in EXIF are used.
    exif_use: ExifUse,
    /// Standard deviation of the exposures in EXIF `[stops]`.
    reported: f64,
    /// Problems with EXIF, for the user.
    pub(super) notes: Vec<String>,
}

impl Exposure {
    /// An earlier decision; the exposures to start with are in the checkpoint.
    pub(super) fn known(is_on: bool, source: ExposureSource) -> Self {
        Self {
            is_on,
            source,
            gains: Vec::new(),
            from_tracks: false,
            exif_use: ExifUse::Unused,
            reported: 0.0,
            notes: Vec::new(),
        }
    }

    /// Decides by the option, or with `auto` by the colours of tracks. Initial gains come from these colours, and from
    /// EXIF for views without known colours.
    pub(super) fn decide(spec: &RunSpec, evidence: &Evidence) -> Self {
        let Evidence { colours, reported, .. } = evidence;
        let colours = colours.as_ref();
        let measured = colours.map(ExposureSpread::measure);
        let decided = measured
            .as_ref()
            .and_then(|(spread, gains)| Some((spread.decision(gains.len())?, *spread)));
        let (is_on, source) = match spec.schedule.exposure {
            ExposureChoice::Off => (false, ExposureSource::Given),
            ExposureChoice::On => (true, ExposureSource::Given),
            ExposureChoice::Auto => {
                let source = decided.map(|(_, spread)| ExposureSource::Tracks(spread));
                let is_on = decided.is_some_and(|(differ, _)| differ);
                (is_on, source.unwrap_or(ExposureSource::Undecided))
            }
        };
        let stops = spread(reported.stops.iter().copied().flatten());
        let mut exposure = Self { reported: stops, ..Self::known(is_on, source) };
        if !is_on {
            return exposure;
        }
        let views = reported.stops.len();
        let known = match (measured, colours) {
            (Some((_, gains)), Some(colours)) if decided.is_some() => {
                (exposure.gains, exposure.from_tracks) = (gains, true);
                (0..views).map(|view| colours.knows(view)).collect()
            }
            _ => vec![false; views],
        };
        exposure.gains.resize(views, [1.0; 3]);
        exposure.exif_use = complete_gains(&mut exposure.gains, &known, &reported.stops);
        if !exposure.from_tracks && exposure.exif_use == ExifUse::Unused {
            exposure.gains.clear();
        }
        if let ExifUse::Contradicted { by } = exposure.exif_use {
            exposure.notes.push(format!(
                "the exposures in EXIF differ by {by:.1} stops (rms) from what the colours of points show, and are \
                 not used"
            ));
        }
        if let Some(example) = &reported.example {
            exposure.notes.push(format!(
                "implausible EXIF of {} is not used ({example})",
                counted(reported.implausible, "photograph")
            ));
        }
        exposure
    }

    /// Drops the initial exposures of all views but those that `keeps` names by their numbers.
    pub(super) fn keep(&mut self, keeps: impl Fn(usize) -> bool) {
        let mut numbers = 0..;
        self.gains.retain(|_| numbers.next().is_some_and(&keeps));
    }

    /// The exposures that the run starts with, if exposures are learned.
    pub(crate) fn initial(&self, spec: &RunSpec, dataset: &Dataset) -> Option<Exposures> {
        let alike = vec![[1.0; 3]; dataset.train.len()];
        let gains = if self.gains.is_empty() { &alike } else { &self.gains };
        self.is_on.then(|| Exposures::new(spec.schedule.exposure_model, gains))
    }

    /// A line for the user with the choice and the evidence for it.
    pub(super) fn line(&self, spelling: Spelling) -> Option<String> {
        let word = if self.is_on { "on" } else { "off" };
        match self.source {
            ExposureSource::Given if self.is_on => Some(match (self.from_tracks, self.exif_use) {
                (true, _) => {
                    format!(
                        "exposure on, from the colours of points in several views{}",
                        self.exif_views()
                    )
                }
                (false, ExifUse::Views(views)) => {
                    format!("exposure on, from the EXIF of {} views", grouped(views))
                }
                (false, _) => "exposure on, initially the same for all views".to_owned(),
            }),
            ExposureSource::Given => None,
            ExposureSource::Tracks(spread) => Some(format!(
                "exposure {word} (auto): judged by the colours of {} points, the exposures of {} views differ by \
                 {:.2} stops (rms); with gains, colours differ by {:.1}/255 instead of {:.1}/255{}",
                grouped(spread.tracks),
                spread.views,
                spread.stops,
                spread.with_gains,
                spread.alike,
                self.exif_views(),
            )),
            ExposureSource::Undecided => Some(format!(
                "exposure {word} (auto): undecided, because fewer than {MIN_TRACKS} points of a reconstruction \
                 are known in enough views{}; {}",
                if self.reported >= MIN_STOPS {
                    format!(", but in EXIF, exposures differ by {:.2} stops (rms)", self.reported)
                } else {
                    String::new()
                },
                notes::learn_exposures(spelling)
            )),
        }
    }

    /// The number of views that start from EXIF while the others start from tracks.
    fn exif_views(&self) -> String {
        match self.exif_use {
            ExifUse::Views(views) => format!("; {} views start from their EXIF", grouped(views)),
            ExifUse::Unused | ExifUse::Contradicted { .. } => String::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use densify_data::dataset::ReportedExposures;
    use densify_train::exposure::ExposureModel;

    fn decided(choice: ExposureChoice, reported: &ReportedExposures) -> Exposure {
        let mut spec = RunSpec::default();
        spec.schedule.exposure = choice;
        let evidence = Evidence { reported: reported.clone(), ..Evidence::default() };
        Exposure::decide(&spec, &evidence)
    }

    fn two_stops_apart() -> ReportedExposures {
        let stops = vec![Some(-5.0), Some(-7.0), None];
        ReportedExposures {
            stops,
            implausible: 1,
            example: Some("c.jpg says an exposure of 0 s".to_owned()),
        }
    }

    #[test]
    fn without_tracks_exposures_start_from_exif() {
        let exposure = decided(ExposureChoice::On, &two_stops_apart());
        assert_eq!(
            exposure.line(Spelling::Terminal).as_deref(),
            Some("exposure on, from the EXIF of 2 views")
        );
        // One stop above the mean, and one below; the encoding raises light to the power 1/2.4.
        let up = 2.0_f32.powf(1.0 / 2.4);
        let initial = Exposures::new(ExposureModel::Channels, &exposure.gains);
        for (view, gain) in [up, 1.0 / up, 1.0].into_iter().enumerate() {
            let diagonal = initial.transform(view).matrix[1][1];
            assert!((diagonal / gain - 1.0).abs() < 1e-5, "{view}: {diagonal} {gain}");
        }
        let [note] = &exposure.notes[..] else { panic!("{:?}", exposure.notes) };
        assert!(
            note.contains("EXIF of 1 photograph is not") && note.contains("c.jpg says"),
            "{note}"
        );
        // Without any EXIF, all views start alike.
        let nothing = ReportedExposures { stops: vec![None; 3], ..ReportedExposures::default() };
        let exposure = decided(ExposureChoice::On, &nothing);
        assert_eq!(
            exposure.line(Spelling::Terminal).as_deref(),
            Some("exposure on, initially the same for all views")
        );
        assert!(exposure.gains.is_empty() && exposure.notes.is_empty());
    }

    #[test]
    fn exif_alone_does_not_turn_exposures_on_but_is_reported() {
        let exposure = decided(ExposureChoice::Auto, &two_stops_apart());
        assert!(!exposure.is_on && exposure.gains.is_empty());
        let line = exposure.line(Spelling::Terminal).unwrap();
        assert!(line.contains("off (auto)") && line.contains("differ by 1.00 stops"), "{line}");
        assert!(line.contains("--exposure on"), "{line}");
        let alike =
            ReportedExposures { stops: vec![Some(-5.0); 3], ..ReportedExposures::default() };
        let line = decided(ExposureChoice::Auto, &alike).line(Spelling::Terminal).unwrap();
        assert!(!line.contains("EXIF"), "{line}");
        let exposure = decided(ExposureChoice::Off, &two_stops_apart());
        assert_eq!(
            (exposure.is_on, exposure.line(Spelling::Terminal), exposure.gains.len()),
            (false, None, 0)
        );
    }
}
