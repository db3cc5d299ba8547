//! The trial runs that decide the degree of `--sh-degree auto` within `--memory`: which are made, and what follows.
//!
//! At a lower degree, memory holds up to twice as many Gaussians. Which of the two gives the better images depends on the
//! scene, and no property of the photographs is known that predicts it. Two short runs do, with half the resolution,
//! a quarter of the rows and a fifth of the iterations, which take 10 to 20 %
//! of the time of the run (`docs/studies/sh-degree-trial.tsv`).

use super::case::Case;
use super::degree::Degree;
use super::size::{Size, rows_at};
use super::sources::{DegreeSource, DegreeTrial, VignetteSource};
use super::vignette::CameraVignettes;
use super::{ResolvedRun, RunSize};
use crate::failure::Failure;
use crate::host::Host;
use crate::spec::{Budget, ImageCache, Rows, RunSpec, ShDegree, Whole};
use densify_core::camera::Camera;
use densify_core::numbers::grouped;
use densify_data::dataset::View;

/// A run is this many times as long as a trial run.
const SHORTER: u32 = 5;
/// A trial run has this many times fewer rows, and as many fewer pixels, which are halved along both sides.
const SMALLER: usize = 4;
/// Fewest iterations of a trial run in which policies reach their budget.
const MIN_ITERATIONS: u32 = 1_000;
/// One training view of this many is held out.
pub(super) const HELD_OUT: usize = 8;
/// Fewest training views, so that two are held out.
const MIN_VIEWS: usize = 2 * HELD_OUT;
/// At the lowest degree, this many times as many rows must be possible at least.
const MIN_RATIO: f64 = 1.25;
/// Smallest width or height of the images of a trial run, whichever is larger `[px]`.
const MIN_SIDE: u32 = 32;

/// Why a run makes no trial runs, although memory decides its degree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Obstacle {
    Iterations,
    Views,
    Images,
    Steps,
    Budget,
    Memory,
}

impl Obstacle {
    /// A line for the user about a run that takes `degree` therefore.
    pub(crate) fn line(self, degree: u8) -> String {
        format!(
            "colour   degree {degree} (auto): not compared with degree 0, because {}",
            self.reason()
        )
    }

    fn reason(self) -> String {
        match self {
            Self::Iterations => format!(
                "trial runs take a run of at least {} iterations",
                grouped((SHORTER * MIN_ITERATIONS) as usize)
            ),
            Self::Views => format!("trial runs take at least {MIN_VIEWS} training views"),
            Self::Images => {
                format!("trial runs take images that still have {MIN_SIDE} px at half the size")
            }
            Self::Steps => "parameters of the policy are given in steps".to_owned(),
            Self::Budget => "the budget allows hardly more Gaussians".to_owned(),
            Self::Memory => "the scene leaves too little memory for trial runs".to_owned(),
        }
    }
}

/// Descriptions of the trial runs.
#[derive(Debug, Clone)]
pub(crate) struct TrialRuns {
    /// Length of each run.
    pub(crate) iterations: u32,
    /// Degree of the second run, the highest that fits; that of the first is 0.
    pub(crate) highest: u8,
    /// Rows of the two runs.
    pub(crate) rows: [usize; 2],
    /// The two runs.
    pub(crate) specs: [RunSpec; 2],
}

impl ResolvedRun<'_> {
    /// The trial runs that decide the degree, or what prevents them; `None` if nothing is to be decided.
    ///
    /// # Errors
    /// When a size cannot be computed.
    pub(crate) fn trial_runs(&self) -> Result<Option<Result<TrialRuns, Obstacle>>, Failure> {
        self.case.find_trial(&self.size)
    }

    /// The same run with the degree that the trial runs decide.
    ///
    /// # Errors
    /// When no model fits.
    pub(crate) fn decided_by(self, trial: DegreeTrial, host: Host<'_>) -> Result<Self, Failure> {
        let mut case = self.case;
        // A degree that memory has lowered is lowered again.
        let wanted = if trial.degree() == 0 { 0 } else { case.choices.degree.highest() };
        case.choices.degree = Degree { range: 0..=wanted, source: DegreeSource::Trial(trial) };
        let size = Size::choose(&case)?;
        let degree_lowered = size.is_lowered(&case);
        Ok(Self::new(case, &size, degree_lowered, host))
    }
}

impl Case<'_> {
    /// A line of `densify plan` if trial runs would decide the degree, or cannot.
    pub(super) fn trial_line(&self, size: &RunSize) -> Result<Option<String>, Failure> {
        let degree = size.sh_degree;
        Ok(self.find_trial(size)?.map(|trial| match trial {
            Ok(trial) => format!(
                "colour   degree {degree} or 0 (auto): two trial runs of {} iterations decide when training begins; the \
                 sizes here are for degree {degree}",
                grouped(trial.iterations as usize)
            ),
            Err(obstacle) => obstacle.line(degree),
        }))
    }

    /// The trial runs of a run of this size, or what prevents them; `None` if nothing is to be decided.
    fn find_trial(&self, size: &RunSize) -> Result<Option<Result<TrialRuns, Obstacle>>, Failure> {
        let (DegreeSource::Untried, Some(memory)) = (self.choices.degree.source, self.memory())
        else {
            return Ok(None);
        };
        if size.sh_degree == 0 {
            return Ok(None);
        }
        let iterations = self.spec.schedule.iterations.0 / SHORTER;
        if iterations < MIN_ITERATIONS {
            return Ok(Some(Err(Obstacle::Iterations)));
        }
        let dataset = &self.inputs.dataset;
        if dataset.train.len() < MIN_VIEWS {
            return Ok(Some(Err(Obstacle::Views)));
        }
        let (width, height) = dataset.largest_image();
        if width.max(height) / 2 < MIN_SIDE {
            return Ok(Some(Err(Obstacle::Images)));
        }
        let most = self.spec.size.budget.and_then(Budget::most).unwrap_or(usize::MAX);
        let lowest = rows_at(self, memory, 0, size.rows)?.unwrap_or(size.rows).min(most);
        if (lowest as f64) < MIN_RATIO * size.rows as f64 {
            return Ok(Some(Err(Obstacle::Budget)));
        }
        let steps = self.choices.entry.step_parameters();
        if steps.iter().any(|step| self.choices.parameters.contains_key(step.name())) {
            return Ok(Some(Err(Obstacle::Steps)));
        }
        let (degrees, rows) = ([0, size.sh_degree], [lowest, size.rows].map(|rows| rows / SMALLER));
        let tile_cap = |rows: usize| rows.max(size.tile_cap / SMALLER);
        let describe = |degree: u8, rows: usize| {
            let mut spec = self.spec.clone();
            spec.size.sh_degree = Some(ShDegree::Fixed(degree));
            spec.size.budget = Some(Budget::Rows(rows));
            spec.size.memory = None;
            spec.size.tile_cap = Some(Rows(tile_cap(rows)));
            spec.size.image_cache = Some(ImageCache::Bytes(size.image_cache));
            spec.schedule.iterations = Whole(iterations);
            spec
        };
        let specs = [describe(degrees[0], rows[0]), describe(degrees[1], rows[1])];
        // The points are in memory twice meanwhile. Buffers for images of full size are an upper limit.
        let points = dataset.points.bytes();
        for (sh_degree, rows) in degrees.into_iter().zip(rows) {
            let size = RunSize { rows, sh_degree, tile_cap: tile_cap(rows), ..*size };
            let bytes = self.inputs.device.limited_bytes(&self.ledger_of(&size)?);
            if bytes + points > memory {
                return Ok(Some(Err(Obstacle::Memory)));
            }
        }
        Ok(Some(Ok(TrialRuns { iterations, highest: size.sh_degree, rows, specs })))
    }

    /// Halves the images of the training views, makes one view of `every` a test view, and drops the other test views.
    /// Vignettes, which belong to whole photographs, are not learned.
    pub(super) fn halve_and_hold_out(&mut self, every: usize) {
        let trains = |view: usize| !(view + 1).is_multiple_of(every);
        let dataset = &mut self.inputs.to_mut().dataset;
        let mut numbers = 0..;
        let (train, test) = std::mem::take(&mut dataset.train)
            .into_iter()
            .partition(|_| numbers.next().is_some_and(trains));
        (dataset.train, dataset.test) = (train, test);
        for View { camera, source, .. } in dataset.train.iter_mut().chain(&mut dataset.test) {
            *camera = halved(camera);
            // Then images are shrunk when they are decoded; otherwise, whenever they are used.
            if source.window.is_none() && source.depth.is_none() {
                (source.width, source.height) = (camera.width, camera.height);
            }
        }
        self.choices.exposure.keep(trains);
        self.choices.poses.halve_and_keep(trains);
        self.choices.vignette = CameraVignettes::known(false, VignetteSource::Given);
    }
}

/// The camera with an image of half the size.
pub(super) fn halved(camera: &Camera) -> Camera {
    camera.resized((camera.width / 2).max(1), (camera.height / 2).max(1))
}
