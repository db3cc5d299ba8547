//! `--vignette`: whether to learn a vignette for each camera, and the vignettes to start with.

use super::inputs::Evidence;
use super::sources::VignetteSource;
use crate::failure::{Failure, OptionProblem, notes};
use crate::spec::RunSpec;
use densify_core::numbers::{counted, grouped};
use densify_core::spelling::Spelling;
use densify_core::vignette::{COEFFICIENTS, PhotographPlace, Vignette};
use densify_data::dataset::{Dataset, Tracks, View, cameras_of};
use densify_data::track_colours::vignettes::{self, VignetteSpread};
use densify_data::track_colours::{MIN_TRACKS, TrackColours};
use densify_train::vignette::{VignetteChoice, Vignettes};

/// The evidence for vignettes.
#[derive(Debug, Clone, Default)]
pub(super) struct VignetteEvidence {
    /// The vignette of each camera by the colours of tracks; empty if they were not measured.
    cameras: Vec<VignetteSpread>,
    /// Name of a view that is one of several of its photograph, for which vignettes cannot be learned.
    divided: Option<String>,
}

impl VignetteEvidence {
    /// Measures the vignettes of the cameras, and removes those that are found from the colours, so that other choices
    /// are not misled by them.
    pub(super) fn measure(
        tracks: &Tracks,
        colours: Option<&mut TrackColours>,
        views: &[View],
    ) -> Self {
        let places: Vec<_> = views.iter().map(View::place_in_photograph).collect();
        let divided = views.iter().zip(&places).find(|(_, place)| place.is_none());
        let divided = divided.map(|(view, _)| view.name.clone());
        let Some(colours) = colours else { return Self { cameras: Vec::new(), divided } };
        let numbers = cameras_of(views);
        let cameras = vignettes::measure(tracks, colours, views, &numbers, &places);
        if divided.is_none() && cameras.iter().any(VignetteSpread::is_found) {
            let of_view = |(camera, place): (&u32, &Option<PhotographPlace>)| {
                let found = cameras[*camera as usize];
                let coefficients = found.is_found().then(|| found.coefficients())?;
                Some(Vignette { coefficients, place: (*place)? })
            };
            let found: Vec<_> = numbers.iter().zip(&places).map(of_view).collect();
            colours.undo_vignettes(tracks, views, &found);
        }
        Self { cameras, divided }
    }
}

/// The vignettes of a run.
#[derive(Debug, Clone)]
pub(crate) struct CameraVignettes {
    /// True if vignettes are learned.
    pub(crate) is_on: bool,
    pub(crate) source: VignetteSource,
    /// Number of cameras, and of those that the colours of tracks show to lose light.
    cameras: [usize; 2],
    /// Initial coefficients of the cameras whose vignette is known; empty if none is. Shape: `[cameras]`.
    start: Vec<Option<[f32; COEFFICIENTS]>>,
    /// Name of a view that is one of several of its photograph.
    divided: Option<String>,
}

impl CameraVignettes {
    /// An earlier decision; the vignettes to start with are in the checkpoint.
    pub(super) fn known(is_on: bool, source: VignetteSource) -> Self {
        Self { is_on, source, cameras: [0; 2], start: Vec::new(), divided: None }
    }

    /// Decides by the option, or with `auto` by the colours of tracks, which also give the vignettes to start with.
    pub(super) fn decide(spec: &RunSpec, evidence: &Evidence) -> Self {
        let VignetteEvidence { cameras: spreads, divided } = &evidence.vignettes;
        let strength = |spread: &VignetteSpread| spread.stops / spread.error.max(1e-6);
        // The camera with the strongest evidence; if none decides anything, there is none.
        let strongest = spreads
            .iter()
            .filter(|spread| spread.decision().is_some())
            .max_by(|a, b| strength(a).total_cmp(&strength(b)));
        let dimmed = spreads.iter().filter(|spread| spread.is_found()).count();
        let divided = divided.clone();
        let (is_on, source) = match (spec.schedule.vignette, strongest) {
            (VignetteChoice::Off, _) => (false, VignetteSource::Given),
            (VignetteChoice::On, _) => (true, VignetteSource::Given),
            (VignetteChoice::Auto, Some(spread)) => {
                (dimmed > 0 && divided.is_none(), VignetteSource::Tracks(*spread))
            }
            (VignetteChoice::Auto, None) => (false, VignetteSource::Undecided),
        };
        let start = spreads
            .iter()
            .map(|spread| spread.decision().is_some().then(|| spread.coefficients()))
            .collect();
        let start = if is_on && strongest.is_some() { start } else { Vec::new() };
        Self { is_on, source, cameras: [spreads.len(), dimmed], start, divided }
    }

    /// Fails if vignettes were asked for, but photographs are divided into several views.
    pub(super) fn check(&self, dataset: &Dataset) -> Result<(), Failure> {
        let divided = || {
            let view = dataset.train.iter().find(|view| view.place_in_photograph().is_none());
            view.map(|view| view.name.clone())
        };
        match divided().filter(|_| self.is_on) {
            Some(view) => Err(OptionProblem::VignetteOfDivided { view }.into()),
            None => Ok(()),
        }
    }

    /// The vignettes that the run starts with, if vignettes are learned.
    pub(crate) fn initial(&self, dataset: &Dataset) -> Option<Vignettes> {
        let cameras = cameras_of(&dataset.train);
        let count = cameras.iter().max().map_or(0, |last| *last as usize + 1);
        let alike = vec![None; count];
        let start = if self.start.is_empty() { &alike } else { &self.start };
        let places = dataset.train.iter().filter_map(View::place_in_photograph);
        self.is_on.then(|| Vignettes::new(start, cameras.into_iter().zip(places)))
    }

    /// A line for the user with the choice and the evidence for it.
    pub(super) fn line(&self, spelling: Spelling) -> Option<String> {
        let word = if self.is_on { "on" } else { "off" };
        let [cameras, dimmed] = self.cameras;
        match self.source {
            VignetteSource::Given if self.is_on && !self.start.is_empty() => {
                Some("vignette on, from the colours of points at different radii".to_owned())
            }
            VignetteSource::Given if self.is_on => Some("vignette on, initially none".to_owned()),
            VignetteSource::Given => None,
            VignetteSource::Tracks(spread) => Some(format!(
                "vignette {word} (auto): judged by the colours of {} points at different radii, {} {:.2} ± {:.2} stops \
                 towards the corners{}",
                grouped(spread.tracks),
                if cameras > 1 {
                    format!("{dimmed} of {} lose light, the clearest", counted(cameras, "camera"))
                } else {
                    "the camera loses".to_owned()
                },
                spread.stops,
                spread.error,
                match &self.divided {
                    Some(view) =>
                        format!(", but photographs are divided into several views, such as {view}"),
                    None => String::new(),
                }
            )),
            VignetteSource::Undecided => Some(format!(
                "vignette {word} (auto): undecided, because no camera sees {MIN_TRACKS} points of a reconstruction at \
                 different radii; {}",
                notes::learn_vignettes(spelling)
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CLEAR: VignetteSpread =
        VignetteSpread { tracks: 4000, views: 30, spread: 0.1, stops: 0.8, error: 0.01 };

    fn decided(choice: VignetteChoice, spreads: &[VignetteSpread]) -> CameraVignettes {
        let mut spec = RunSpec::default();
        spec.schedule.vignette = choice;
        let vignettes = VignetteEvidence { cameras: spreads.to_vec(), divided: None };
        let evidence = Evidence { vignettes, ..Evidence::default() };
        CameraVignettes::decide(&spec, &evidence)
    }

    #[test]
    fn vignettes_are_learned_where_a_camera_clearly_loses_light() {
        let none = VignetteSpread { stops: 0.02, ..CLEAR };
        let both = decided(VignetteChoice::Auto, &[none, CLEAR]);
        assert!(both.is_on && both.start[1].is_some_and(|start| start[0] < -0.5), "{both:?}");
        let line = both.line(Spelling::Terminal).unwrap();
        assert!(line.contains("on (auto)") && line.contains("1 of 2 cameras"), "{line}");
        let off = decided(VignetteChoice::Auto, &[none]);
        assert!(!off.is_on && off.start.is_empty(), "{off:?}");
        let line = off.line(Spelling::Terminal).unwrap();
        assert!(line.contains("off (auto)") && line.contains("loses 0.02 ± 0.01 stops"), "{line}");
    }

    #[test]
    fn without_evidence_auto_is_off_and_says_so() {
        let few = VignetteSpread { tracks: 10, ..CLEAR };
        for spreads in [&[][..], &[few]] {
            let found = decided(VignetteChoice::Auto, spreads);
            let line = found.line(Spelling::Terminal).unwrap();
            assert!(!found.is_on && line.contains("undecided"), "{line}");
            assert!(line.contains("--vignette on learns vignettes anyway"), "{line}");
        }
        let on = decided(VignetteChoice::On, &[few]);
        assert!(on.is_on && on.start.is_empty(), "{on:?}");
        assert_eq!(on.line(Spelling::Terminal).as_deref(), Some("vignette on, initially none"));
        let on = decided(VignetteChoice::On, &[CLEAR]);
        assert!(on.line(Spelling::Terminal).unwrap().contains("from the colours"), "{on:?}");
        let off = decided(VignetteChoice::Off, &[CLEAR]);
        assert_eq!((off.is_on, off.line(Spelling::Terminal)), (false, None));
    }
}
