//! Renders picture requests. Only rendering needs the models, so the thread that owns them, which may be training, does
//! no other work for the page.

use std::ops::Range;
use std::time::{Duration, Instant};

use super::encoder::camera;
use super::picture_kind::PictureKind;
use super::picture_request::PictureRequest;
use super::render_queue::RenderError;
use super::row_colours::{self, RowColours, RowData};
use super::row_measurements::RowMeasurements;
use super::scene::{ModelInfo, Scene};
use densify_render::{Backend, Rendering};
use densify_run::failure::Failure;
use densify_train::checkpoint::{Checkpoint, CheckpointError};
use densify_train::trainer::RowHistory;

/// Time per picture spent on measuring Gaussians in further training views.
const MEASURING_TIME: Duration = Duration::from_millis(150);

/// A rendering with its data, ready to be encoded.
#[derive(Debug, Default)]
pub(super) struct RenderedPicture {
    /// Empty if the request is for a photograph.
    pub(super) rendering: Rendering,
    /// The values at both ends of the colour map, if the colours represent numbers.
    pub(super) range: Option<Range<f64>>,
    /// Number of training views in which the Gaussians were measured, and number of all training views.
    pub(super) measured_views: Option<[usize; 2]>,
    /// Rendering time `[ms]`.
    pub(super) milliseconds: f64,
}

/// Data kept per model between pictures, as the model does not change.
#[derive(Debug, Default)]
pub(super) struct ModelCache {
    /// The last colours, with their kind and the number of measured views.
    colours: Option<(PictureKind, usize, RowColours)>,
    measurements: Option<RowMeasurements>,
    /// The history of the Gaussians, and the model's step.
    edits: Option<(RowHistory, u32)>,
}

/// Renders a request for a model that does not change.
pub(super) fn render(
    scene: &Scene,
    backend: &mut dyn Backend,
    cache: &mut ModelCache,
    request: &PictureRequest,
) -> Result<RenderedPicture, RenderError> {
    let begun = Instant::now();
    let ModelCache { colours: kept, measurements, edits } = cache;
    let mut progress = None;
    if request.kind.is_measured() {
        let model = &scene.models[request.model];
        let measurements = match measurements {
            Some(measurements) => measurements,
            None => {
                let new = RowMeasurements::new(scene, model, backend);
                measurements.insert(new.map_err(failed)?)
            }
        };
        // While the camera moves, show the measurements made so far.
        if !request.is_moving || measurements.progress()[0] == 0 {
            let measured = measurements.measure_more(scene, model.sh_degree, MEASURING_TIME);
            measured.map_err(failed)?;
        }
        progress = Some(measurements.progress());
    }
    if request.kind == PictureKind::RowEdit && edits.is_none() {
        *edits = read_edits(&scene.models[request.model]).map_err(failed)?;
    }
    if request.kind.colours_rows() {
        let views = progress.map_or(0, |[seen, _]| seen);
        let is_current =
            kept.as_ref().is_some_and(|(kind, seen, _)| (*kind, *seen) == (request.kind, views));
        if !is_current {
            let history = edits.as_ref().map(|(edits, step)| (edits, *step));
            let row_data =
                RowData { measurements: measurements.as_ref(), history, ..RowData::default() };
            let colours = colour_rows(scene, backend, row_data, request.kind)?;
            *kept = Some((request.kind, views, colours));
        }
    }
    let colours = kept.as_ref().filter(|_| request.kind.colours_rows());
    let rendered = render_with(scene, backend, request, colours.map(|(.., colours)| colours))?;
    Ok(RenderedPicture { measured_views: progress, milliseconds: milliseconds(begun), ..rendered })
}

/// Reads from the run's checkpoint when each Gaussian was last edited.
fn read_edits(model: &ModelInfo) -> Result<Option<(RowHistory, u32)>, CheckpointError> {
    let Some(path) = &model.checkpoint else { return Ok(None) };
    let mut checkpoint = Checkpoint::open(path)?;
    let step = checkpoint.header().trainer.step;
    let edited = checkpoint.ages()?.into_iter().map(|age| step.saturating_sub(age));
    let edited: Vec<u32> = edited.collect();
    if edited.len() == model.rows {
        return Ok(Some((RowHistory::from_edits(&edited, model.rows), step)));
    }
    let problem = format!("it has {} Gaussians, but the model has {}", edited.len(), model.rows);
    Err(CheckpointError::Invalid { path: path.clone(), problem })
}

/// Renders a request for a model in training.
pub(super) fn render_live(
    scene: &Scene,
    backend: &mut dyn Backend,
    row_data: RowData<'_>,
    request: &PictureRequest,
) -> Result<RenderedPicture, RenderError> {
    let begun = Instant::now();
    let colours = match request.kind {
        kind if kind.colours_rows() => Some(colour_rows(scene, backend, row_data, kind)?),
        _ => None,
    };
    let rendered = render_with(scene, backend, request, colours.as_ref())?;
    Ok(RenderedPicture { milliseconds: milliseconds(begun), ..rendered })
}

fn colour_rows(
    scene: &Scene,
    backend: &mut dyn Backend,
    row_data: RowData<'_>,
    kind: PictureKind,
) -> Result<RowColours, RenderError> {
    row_colours::colour_rows(kind, backend, row_data, 1.0 / scene.normalisation.scale)
        .map_err(failed)
}

fn render_with(
    scene: &Scene,
    backend: &mut dyn Backend,
    request: &PictureRequest,
    colours: Option<&RowColours>,
) -> Result<RenderedPicture, RenderError> {
    let camera = camera(scene, request);
    let rendering = match (request.kind, colours) {
        (PictureKind::Photograph, _) => return Ok(RenderedPicture::default()),
        (_, Some(colours)) => backend.inspect().and_then(|inspect| {
            inspect.render_painted(&camera, row_colours::BACKGROUND, &colours.rows)
        }),
        (PictureKind::Count, _) => {
            backend.inspect().and_then(|inspect| inspect.render_counts(&camera))
        }
        _ => backend.render(&camera, scene.background, scene.models[request.model].sh_degree),
    };
    let range = colours.and_then(|colours| colours.range.clone());
    Ok(RenderedPicture {
        rendering: rendering.map_err(failed)?,
        range,
        ..RenderedPicture::default()
    })
}

fn failed(error: impl Into<Failure>) -> RenderError {
    RenderError::Failed(error.into().to_string())
}

fn milliseconds(since: Instant) -> f64 {
    1e3 * since.elapsed().as_secs_f64()
}
