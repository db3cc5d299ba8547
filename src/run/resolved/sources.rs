//! Why a run makes a choice that the scene can decide.

use serde::{Deserialize, Serialize};

use densify_core::numbers::{counted, gaussians, grouped};
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
    /// Nothing yet: [trial runs](DegreeTrial) decide, if they are possible; otherwise the degree is the highest.
    Untried,
    /// Trial runs of the lowest and the highest degree.
    Trial(DegreeTrial),
}

/// The lowest degree is chosen if it leads by this much `[dB]`: in the run itself, with more pixels per Gaussian and
/// more iterations, view-dependent colours gain more.
const MIN_LEAD: f64 = 1.1;

/// Two short runs, of the lowest and of the highest degree, with the rows that the memory limit allows at each, divided
/// by the same number.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DegreeTrial {
    /// Length of each run.
    pub iterations: u32,
    /// The highest degree; the lowest is 0.
    pub highest: u8,
    /// Number of training views that were held out, to measure the models.
    pub views: usize,
    /// Rows at the lowest and at the highest degree.
    pub rows: [usize; 2],
    /// Mean PSNR of the views held out, at the lowest and at the highest degree `[dB]`.
    pub psnr: [f64; 2],
}

impl DegreeTrial {
    /// The result, for the user.
    pub fn describe(&self) -> String {
        let Self { iterations, highest, views, rows, psnr: [low, high] } = *self;
        format!(
            "in trial runs of {} iterations, degree 0 with {} reached {low:.2} dB in {} held out, degree {} with {} \
             {high:.2} dB; degree 0 is taken from a lead of {MIN_LEAD} dB on",
            grouped(iterations as usize),
            gaussians(rows[0]),
            counted(views, "view"),
            highest,
            gaussians(rows[1]),
        )
    }

    /// The degree that is taken.
    pub fn degree(&self) -> u8 {
        if self.psnr[0] - self.psnr[1] >= MIN_LEAD { 0 } else { self.highest }
    }
}
