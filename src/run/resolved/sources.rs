//! Why a run makes a choice that the scene can decide.

use serde::{Deserialize, Serialize};

use densify_data::track_colours::Spread;
use densify_data::track_colours::exposures::ExposureSpread;
use densify_data::track_colours::vignettes::VignetteSpread;
use densify_data::track_poses::PoseErrors;

/// The reason for a choice that the tracks of the reconstruction can decide, with their evidence.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TrackSource<E> {
    /// The options.
    #[default]
    Given,
    /// The tracks, before training.
    Tracks(E),
    /// No evidence: too few tracks are known, so nothing is learned.
    Undecided,
}

impl<E> TrackSource<E> {
    /// True if the options decided.
    pub fn is_given(&self) -> bool {
        matches!(self, Self::Given)
    }
}

/// The reason for learning an exposure for each photograph, or not.
pub type ExposureSource = TrackSource<ExposureSpread>;
/// The reason for refining the poses of the training views, or not.
pub type PoseSource = TrackSource<PoseErrors>;
/// The reason for learning a vignette for each camera, or not, by the camera with the clearest evidence.
pub type VignetteSource = TrackSource<VignetteSpread>;

/// The reason for the spherical-harmonic degree of a run.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DegreeSource {
    /// The options.
    #[default]
    Given,
    /// The colours of tracks, before training.
    Spread(Spread),
    /// No evidence: too few tracks are known, so the degree is the highest.
    Undecided,
}
