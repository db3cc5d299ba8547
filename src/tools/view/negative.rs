//! From a wish to a rendering: all that needs the models, and nothing else, as the thread that has them may be
//! training.

use std::ops::Range;
use std::time::{Duration, Instant};

use super::asked::Wanted;
use super::darkroom::camera;
use super::desk::Unmade;
use super::kinds::Kind;
use super::measured::Measured;
use super::paint::{self, Colours, Known, colours};
use super::stage::{Shown, Stage};
use densify_render::{Backend, Rendering};
use densify_run::failure::Failure;
use densify_train::checkpoint::{Checkpoint, CheckpointError};
use densify_train::trainer::RowHistory;

/// How long rows are measured in training views before what is known of them is shown.
const PATIENCE: Duration = Duration::from_millis(150);

/// A rendering, of which a picture can be made.
#[derive(Debug)]
pub(super) struct Negative {
    /// Empty where nothing but a photograph is wanted.
    pub(super) rendering: Rendering,
    /// What the ends of the scale of the rows' colours stand for, if they have one.
    pub(super) range: Option<Range<f64>>,
    /// In how many training views the rows' numbers were measured, and how many there are, if they are.
    pub(super) measured: Option<[usize; 2]>,
    /// What it took `[ms]`.
    pub(super) milliseconds: f64,
}

impl Default for Negative {
    fn default() -> Self {
        let rendering = Rendering {
            width: 0,
            height: 0,
            rgb: Vec::new(),
            alpha: Vec::new(),
            depth: Vec::new(),
        };
        Self { rendering, range: None, measured: None, milliseconds: 0.0 }
    }
}

/// What is kept of a model that does not change.
#[derive(Debug, Default)]
pub(super) struct Brush {
    /// The newest colours, what they say, and in how many views that was measured.
    colours: Option<(Kind, usize, Colours)>,
    measured: Option<Measured>,
    /// When rows were edited, and the step of the model.
    edits: Option<(RowHistory, u32)>,
}

/// Renders a model that does not change.
pub(super) fn expose(
    stage: &Stage,
    backend: &mut dyn Backend,
    brush: &mut Brush,
    wanted: &Wanted,
) -> Result<Negative, Unmade> {
    let begun = Instant::now();
    let Brush { colours: kept, measured, edits } = brush;
    let mut progress = None;
    if matches!(wanted.kind, Kind::RowGradient | Kind::RowWeight) {
        let shown = &stage.models[wanted.model];
        let measured = match measured {
            Some(measured) => measured,
            None => measured.insert(Measured::new(stage, shown, backend).map_err(failed)?),
        };
        // Who moves sees what is known.
        if !wanted.is_moving || measured.progress()[0] == 0 {
            measured.go_on(stage, shown.sh_degree, PATIENCE).map_err(failed)?;
        }
        progress = Some(measured.progress());
    }
    if wanted.kind == Kind::RowEdit && edits.is_none() {
        *edits = edits_of(&stage.models[wanted.model]).map_err(failed)?;
    }
    if wanted.kind.paints() {
        let views = progress.map_or(0, |[seen, _]| seen);
        let is_kept =
            kept.as_ref().is_some_and(|(kind, of, _)| (*kind, *of) == (wanted.kind, views));
        if !is_kept {
            let history = edits.as_ref().map(|(edits, step)| (edits, *step));
            let known = Known { measured: measured.as_ref(), history, ..Known::default() };
            *kept = Some((wanted.kind, views, coloured(stage, backend, known, wanted.kind)?));
        }
    }
    let painted = kept.as_ref().filter(|_| wanted.kind.paints()).map(|(.., colours)| colours);
    let negative = rendered(stage, backend, wanted, painted)?;
    Ok(Negative { measured: progress, milliseconds: milliseconds(begun), ..negative })
}

/// When the rows of a run's model were edited, as its checkpoint says it.
fn edits_of(shown: &Shown) -> Result<Option<(RowHistory, u32)>, CheckpointError> {
    let Some(path) = &shown.checkpoint else { return Ok(None) };
    let mut checkpoint = Checkpoint::open(path)?;
    let step = checkpoint.header().trainer.step;
    let edited = checkpoint.ages()?.into_iter().map(|age| step.saturating_sub(age));
    let edited: Vec<u32> = edited.collect();
    if edited.len() == shown.rows {
        return Ok(Some((RowHistory::from_edits(&edited, shown.rows), step)));
    }
    let problem = format!("it has {} Gaussians, and the model {}", edited.len(), shown.rows);
    Err(CheckpointError::Invalid { path: path.clone(), problem })
}

/// Renders a model in training; nothing is kept.
pub(super) fn expose_live(
    stage: &Stage,
    backend: &mut dyn Backend,
    known: Known<'_>,
    wanted: &Wanted,
) -> Result<Negative, Unmade> {
    let begun = Instant::now();
    let painted = match wanted.kind.paints() {
        false => None,
        true => Some(coloured(stage, backend, known, wanted.kind)?),
    };
    let negative = rendered(stage, backend, wanted, painted.as_ref())?;
    Ok(Negative { milliseconds: milliseconds(begun), ..negative })
}

fn coloured(
    stage: &Stage,
    backend: &mut dyn Backend,
    known: Known<'_>,
    kind: Kind,
) -> Result<Colours, Unmade> {
    colours(kind, backend, known, 1.0 / stage.normalisation.scale).map_err(failed)
}

fn rendered(
    stage: &Stage,
    backend: &mut dyn Backend,
    wanted: &Wanted,
    painted: Option<&Colours>,
) -> Result<Negative, Unmade> {
    let camera = camera(stage, wanted);
    let rendering = match (wanted.kind, painted) {
        (Kind::Photograph, _) => return Ok(Negative::default()),
        (_, Some(colours)) => backend
            .inspect()
            .and_then(|inspect| inspect.render_painted(&camera, paint::BACKGROUND, &colours.rows)),
        (Kind::Count, _) => backend.inspect().and_then(|inspect| inspect.render_counts(&camera)),
        _ => backend.render(&camera, stage.background, stage.models[wanted.model].sh_degree),
    };
    let range = painted.and_then(|colours| colours.range.clone());
    Ok(Negative { rendering: rendering.map_err(failed)?, range, ..Negative::default() })
}

fn failed(error: impl Into<Failure>) -> Unmade {
    Unmade::Failed(error.into().to_string())
}

fn milliseconds(since: Instant) -> f64 {
    1e3 * since.elapsed().as_secs_f64()
}
