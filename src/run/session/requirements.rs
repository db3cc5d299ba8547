//! `stats/requirements.json`: what the scene did not require and the run therefore left out (its automatic reductions),
//! with evidence and cost.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::resolved::{DegreeSource, ExposureSource, PoseSource, RunConfig, VignetteSource};
use densify_core::files::FileError;
use densify_core::gaussians::MAX_SH_DEGREE;
use densify_core::numbers::counted;
use densify_core::spelling::Spelling;
use densify_data::dataset::DepthFinding;
use densify_render::DepthTerm;
use densify_train::output::read_json;
use densify_train::trainer::{Annealed, AutoBudget, MIN_GAIN};
use densify_train::vignette::{VignetteChoice, Vignettes};

/// Path within the folder of the run.
pub(super) const REQUIREMENTS: &str = "stats/requirements.json";

/// The report on what a run required and what it left out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Requirements {
    /// True if automatic reductions were disabled (`--full`).
    pub full: bool,
    /// Spherical-harmonic degree of the model.
    pub sh_degree: u8,
    /// The reason for the degree.
    pub sh_degree_from: DegreeSource,
    /// True if an exposure was learned for each photograph.
    pub exposures: bool,
    /// The reason for learning exposures or not.
    pub exposures_from: ExposureSource,
    /// True if the poses of the training views were refined.
    pub poses: bool,
    /// The reason for refining poses or not.
    pub poses_from: PoseSource,
    /// The vignettes, unless the options left them off.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vignettes: Option<VignetteUse>,
    /// Measurements of `--budget auto`.
    pub rows: Option<AutoBudget>,
    /// Number of training views not rendered for scores because of near-duplicates.
    pub unscored_views: usize,
    /// The given depth that was trained on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<DepthUse>,
    /// The automatic reductions; reductions that options ask for are not among them.
    pub left_out: Vec<LeftOut>,
}

/// The given depth of a run, and its part in the loss.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DepthUse {
    /// The depth, and how it agrees with the points.
    #[serde(flatten)]
    pub given: DepthFinding,
    /// The term of the loss.
    pub term: DepthTerm,
    /// Weight of the term, at the first and at the last iteration.
    pub weight: Annealed,
}

/// The choice to learn vignettes or not, and the light that cameras lose.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct VignetteUse {
    /// True if a vignette was learned for each camera.
    pub learned: bool,
    /// The reason for it.
    pub from: VignetteSource,
    /// The light that each camera loses at the corner of a 4:3 photograph, as learned `[stops]`.
    pub corner_stops: Vec<f64>,
}

/// The reductions in a `stats/requirements.json`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Reductions {
    /// True if automatic reductions were disabled.
    pub full: bool,
    /// The reductions.
    pub left_out: Vec<LeftOut>,
}

impl Reductions {
    /// Reads the reductions of a run; `None` if the file does not exist.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn read(run: &Path) -> Result<Option<Self>, FileError> {
        read_json(&run.join(REQUIREMENTS))
    }
}

/// One automatic reduction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    /// The part of the model or of training that was left out.
    pub what: String,
    /// The reason for leaving it out.
    pub evidence: String,
    /// The measured loss of quality, with its method.
    pub loss: String,
}

impl Requirements {
    /// The report of a run that ended with `rows` rows.
    pub fn new(
        config: &RunConfig,
        rows: usize,
        auto_budget: Option<&AutoBudget>,
        unscored_views: usize,
        vignettes: Option<&Vignettes>,
    ) -> Self {
        let left_out = [
            degree_left_out(config),
            exposures_left_out(config),
            poses_left_out(config),
            vignettes_left_out(config),
            auto_budget.and_then(|auto| rows_left_out(auto, rows, config.budget)),
            auto_budget.and_then(rows_removed),
            (unscored_views > 0).then(|| unscored(unscored_views)),
        ];
        Self {
            full: config.spec.size.full,
            sh_degree: config.sh_degree,
            sh_degree_from: config.resolved.sh_degree_from,
            exposures: config.resolved.has_exposures,
            exposures_from: config.resolved.exposure_from,
            poses: config.resolved.refines_poses,
            poses_from: config.resolved.poses_from,
            vignettes: (config.spec.schedule.vignette != VignetteChoice::Off).then(|| {
                VignetteUse {
                    learned: config.resolved.has_vignettes,
                    from: config.resolved.vignette_from,
                    corner_stops: vignettes
                        .map(Vignettes::corner_stops)
                        .into_iter()
                        .flatten()
                        .collect(),
                }
            }),
            rows: auto_budget.cloned(),
            unscored_views,
            depth: config.resolved.depth.clone().and_then(|given| {
                let training = config.spec.depth.training()?;
                Some(DepthUse { given, term: training.term, weight: training.weight })
            }),
            left_out: left_out.into_iter().flatten().collect(),
        }
    }

    /// The report in a few lines.
    pub fn lines(&self, spelling: Spelling) -> Vec<String> {
        let depth = self.depth.as_ref().map(|depth| {
            format!("trained on depth with weight {}: {}", depth.weight, depth.given.describe())
        });
        let vignettes = self.vignettes.as_ref().and_then(VignetteUse::line);
        let uses = depth.into_iter().chain(vignettes);
        if self.left_out.is_empty() {
            let full = spelling.switch("full");
            let why = if self.full { format!(" ({full})") } else { String::new() };
            return std::iter::once(format!("left out nothing{why}")).chain(uses).collect();
        }
        let line =
            |left: &LeftOut| format!("left out {}: {}; {}", left.what, left.evidence, left.loss);
        self.left_out.iter().map(line).chain(uses).collect()
    }
}

fn degree_left_out(config: &RunConfig) -> Option<LeftOut> {
    let degree = config.sh_degree;
    let what = match MAX_SH_DEGREE.checked_sub(degree)? {
        0 => return None,
        1 => format!("degree {MAX_SH_DEGREE} of colour"),
        _ => format!("degrees {} to {MAX_SH_DEGREE} of colour", degree + 1),
    };
    if config.resolved.sh_degree_lowered {
        return Some(LeftOut {
            what,
            // In the file, options are spelled as on the command line, even if a library started the run.
            evidence: format!(
                "within {}, fewer rows fit at the requested degree than the scene starts with",
                Spelling::Terminal.option("memory")
            ),
            loss: "the cost in quality was not measured".to_owned(),
        });
    }
    match config.resolved.sh_degree_from {
        // Here a degree below the highest was set by an option: no automatic reduction.
        DegreeSource::Given | DegreeSource::Undecided | DegreeSource::Untried => None,
        DegreeSource::Trial(trial) => Some(LeftOut {
            what,
            evidence: trial.describe(),
            loss: "at most 0.5 dB in studies with 7,000 iterations (docs/tradeoffs.md)".to_owned(),
        }),
        DegreeSource::Spread(spread) => Some(LeftOut {
            what,
            evidence: format!(
                "the colour of a twentieth of {} points varies by {:.2}/255 or more between the views that see them",
                spread.tracks, spread.twentieth
            ),
            loss: format!(
                "the colours of all these points vary by {:.2}/255 (rms); with as many rows, degree 3 still gained \
                 0.5 to 1.4 dB on matt scenes (docs/tradeoffs.md)",
                spread.rms
            ),
        }),
    }
}

fn exposures_left_out(config: &RunConfig) -> Option<LeftOut> {
    let ExposureSource::Tracks(spread) = config.resolved.exposure_from else { return None };
    (!config.resolved.has_exposures).then(|| LeftOut {
        what: "an exposure for each photograph".to_owned(),
        evidence: format!(
            "judged by the colours of {} points, the exposures of {} views differ by {:.2} stops (rms)",
            spread.tracks, spread.views, spread.stops
        ),
        loss: "the cost in quality was not measured".to_owned(),
    })
}

fn poses_left_out(config: &RunConfig) -> Option<LeftOut> {
    let PoseSource::Tracks(errors) = config.resolved.poses_from else { return None };
    (!config.resolved.refines_poses).then(|| LeftOut {
        what: "refinement of poses".to_owned(),
        evidence: format!(
            "judged by {} points, the poses of {} views are off by {:.2} px (rms)",
            errors.tracks, errors.views, errors.motion
        ),
        loss: "the cost in quality was not measured".to_owned(),
    })
}

impl VignetteUse {
    /// The light that the cameras lose, in a line; `None` if no vignettes were learned.
    fn line(&self) -> Option<String> {
        let least = self.corner_stops.iter().copied().reduce(f64::min)?;
        let most = self.corner_stops.iter().copied().reduce(f64::max)?;
        let cameras = counted(self.corner_stops.len(), "camera");
        let range = if self.corner_stops.len() > 1 {
            format!("{least:.2} to {most:.2}")
        } else {
            format!("{most:.2}")
        };
        Some(format!(
            "vignettes learned: {cameras}, {range} stops at the corner of a 4:3 photograph"
        ))
    }
}

fn vignettes_left_out(config: &RunConfig) -> Option<LeftOut> {
    let VignetteSource::Tracks(spread) = config.resolved.vignette_from else { return None };
    (!config.resolved.has_vignettes).then(|| LeftOut {
        what: "a vignette for each camera".to_owned(),
        evidence: format!(
            "judged by the colours of {} points at different radii, {:.2} ± {:.2} stops are lost towards the corners",
            spread.tracks, spread.stops, spread.error
        ),
        loss: "the cost in quality was not measured".to_owned(),
    })
}

fn rows_left_out(auto: &AutoBudget, rows: usize, budget: usize) -> Option<LeftOut> {
    let last = auto.intervals.iter().find(|interval| Some(interval.step) == auto.stopped)?;
    let gain = last.gain.filter(|_| rows < budget && auto.idle >= 2)?;
    auto.stopped.map(|step| LeftOut {
        what: format!("rows beyond {}", last.rows),
        evidence: format!(
            "growth ended at step {step}, as a doubling of rows gained less than {MIN_GAIN:.2} dB \
             twice in a row"
        ),
        loss: format!("about {gain:.2} dB per doubling on training views"),
    })
}

fn rows_removed(auto: &AutoBudget) -> Option<LeftOut> {
    let removals = auto.removals.iter().filter(|removal| removal.after < removal.before);
    let removals: Vec<_> = removals.collect();
    let change: f64 = removals.iter().map(|removal| removal.change).sum();
    let removed: usize = removals.iter().map(|removal| removal.before - removal.after).sum();
    (removed > 0).then(|| LeftOut {
        what: format!("{removed} rows of low weight"),
        evidence: format!(
            "hiding rows cost less than {MIN_GAIN:.2} dB per halving in each of {}",
            counted(removals.len(), "trial")
        ),
        loss: format!("{change:.3} dB in all on training views, measured at removal"),
    })
}

fn unscored(views: usize) -> LeftOut {
    LeftOut {
        what: format!("{views} training views from the policy's scores"),
        evidence: "each has a near-duplicate within 1 % of the scene's extent and one degree"
            .into(),
        loss: "the cost in quality was not measured".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::resolved::sample;
    use densify_data::track_colours::Spread;
    use densify_train::trainer::{Interval, Removal};

    fn spread() -> Spread {
        let (median, tenth, twentieth, rms) = (0.0, 0.25, 0.5, 0.125);
        Spread { tracks: 4000, on_surface: 0.9, median, tenth, twentieth, rms }
    }

    #[test]
    fn reductions_by_options_are_not_reported() {
        let mut config = sample();
        let lines = |config: &RunConfig, unscored| {
            Requirements::new(config, 500, None, unscored, None)
                .lines(Spelling::Terminal)
                .join("\n")
        };
        config.resolved.sh_degree_from = DegreeSource::Given;
        config.sh_degree = 0;
        assert_eq!(lines(&config, 0), "left out nothing");
        config.resolved.sh_degree_from = DegreeSource::Undecided;
        config.sh_degree = MAX_SH_DEGREE;
        assert_eq!(lines(&config, 0), "left out nothing");
        assert!(lines(&config, 4).starts_with("left out 4 training views"));
        config.spec.size.full = true;
        assert_eq!(lines(&config, 0), "left out nothing (--full)");
    }

    #[test]
    fn each_reduction_has_its_evidence_and_its_loss() {
        let mut config = sample();
        let line = |config: &RunConfig, auto_budget: Option<&AutoBudget>| {
            Requirements::new(config, 900, auto_budget, 0, None)
                .lines(Spelling::Terminal)
                .join("\n")
        };
        config.resolved.sh_degree_from = DegreeSource::Spread(spread());
        config.sh_degree = 0;
        let text = line(&config, None);
        for words in ["degrees 1 to 3", "4000 points", "0.50/255", "0.12/255"] {
            assert!(text.contains(words), "{words}: {text}");
        }
        config.resolved.sh_degree_lowered = true;
        config.sh_degree = 2;
        let text = line(&config, None);
        assert!(text.contains("degree 3 of") && text.contains("not measured"), "{text}");
        config.sh_degree = 3;
        let interval = |step, rows, gain| Interval { step, rows, psnr: 30.0, settled: true, gain };
        let auto_budget = AutoBudget {
            limit: 900,
            stopped: Some(300),
            idle: 2,
            intervals: vec![
                interval(200, 700, Some(0.06)),
                interval(300, 1000, Some(0.04)),
                interval(400, 1000, None),
            ],
            removals: vec![
                Removal { step: 400, before: 1000, after: 900, change: -0.015 },
                Removal { step: 500, before: 900, after: 900, change: -0.125 },
            ],
        };
        let text = line(&config, Some(&auto_budget));
        for words in ["beyond 1000", "step 300", "0.04 dB", "100 rows", "1 trial", "-0.015 dB"] {
            assert!(text.contains(words), "{words}: {text}");
        }
    }
}
