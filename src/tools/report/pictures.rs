//! Renders the pictures of the report: the worst and the best views beside their photographs, crops of them, and an
//! orbit around the scene.

use image::{RgbImage, imageops};

use super::ReportOptions;
use super::groups::Scene;
use super::runs::RunRecord;
use densify_core::camera::Camera;
use densify_core::camera_path::orbit;
use densify_core::files;
use densify_data::dataset::Dataset;
use densify_data::views::{DatasetViews, ViewSource};
use densify_html::EmbeddedImage;
use densify_render::Backend;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, load, or_moved, read_model, views_of};
use densify_run::{NearPlane, Observer};
use densify_study::window::Window;
use densify_train::evaluate::{Comparison, FittedScore, Split};
use densify_train::output::model_path;
use densify_train::pictures::{photograph, picture};

/// Longest side of a picture `[px]`.
const MAX_SIDE: u32 = 960;
/// JPEG quality of a picture.
const QUALITY: u8 = 88;
/// Number of views from each end of the ranking.
const FROM_EACH_END: usize = 2;
/// Maximum number of views that are evaluated if the run has no scores.
const MAX_EVALUATED: usize = 24;
/// Number of frames of an orbit.
const FRAMES: u32 = 24;
/// Longest side of a frame `[px]`.
const MAX_FRAME_SIDE: u32 = 400;
/// JPEG quality of a frame.
const FRAME_QUALITY: u8 = 80;

/// A picture and its name.
pub(super) struct NamedPicture {
    pub(super) name: String,
    pub(super) picture: EmbeddedImage,
}

/// A view of the dataset: its photograph and the render of each run.
pub(super) struct ViewComparison {
    pub(super) name: String,
    /// Its place in the ranking, such as `worst`.
    pub(super) place: &'static str,
    /// The photograph, then the renders.
    pub(super) pictures: Vec<NamedPicture>,
    /// The same crop of each picture.
    pub(super) crops: Vec<NamedPicture>,
    /// Name of each run, with PSNR `[dB]`, SSIM and FLIP of its render.
    pub(super) scores: Vec<(String, [f64; 3])>,
}

/// An orbit around the scene.
pub(super) struct Orbit {
    pub(super) name: String,
    pub(super) frames: Vec<EmbeddedImage>,
}

/// The pictures of a scene.
pub(super) struct ScenePictures {
    /// The split of the views: test views, or training views if none were held out.
    pub(super) split: Split,
    /// Name of the run that ranked the views.
    pub(super) ranked_by: String,
    /// Number of views in this split.
    pub(super) count: usize,
    pub(super) views: Vec<ViewComparison>,
    pub(super) orbits: Vec<Orbit>,
}

/// Renders the pictures of a scene.
pub(super) fn render(
    scene: &Scene,
    runs: &[RunRecord],
    options: &ReportOptions<'_>,
    machine: &Machine,
    observer: &dyn Observer,
) -> Result<ScenePictures, Failure> {
    let path = options.dataset.unwrap_or(&scene.path);
    let dataset = load(path, &scene.data, observer).map_err(|failure| match options.dataset {
        Some(_) => failure,
        None => or_moved(failure, path),
    })?;
    let split = if dataset.test.is_empty() { Split::Train } else { Split::Test };
    let views = views_of(&dataset, split)?;
    let background = scene.data.background.fixed();
    let mut pictures: Option<ScenePictures> = None;
    let mut chosen: Vec<(usize, Window)> = Vec::new();
    for number in scene.representatives() {
        let run = &runs[number];
        observer.say(format_args!("pictures {}", run.name));
        let model = read_model(&model_path(&run.folder, run.iteration), observer)?;
        let degree = model.sh_degree;
        let given = run.config.spec.start.near;
        let near = given
            .map_or_else(|| NearPlane::choose(None, &dataset).distance(), NearPlane::distance_of);
        let backend = machine.backend(&dataset, model, near)?;
        let mut renderer = Renderer { backend, background, degree };
        // The first run's ranking selects the views; the photograph comes first in each comparison.
        let pictures = match &mut pictures {
            Some(pictures) => pictures,
            None => {
                let (count, ranking) = (views.count(), rank_views(run, &views, &mut renderer)?);
                let mut all = Vec::new();
                for (view, place) in choose_ends(&ranking) {
                    let image = photograph(&*image(&views, view)?, background);
                    let window = Window::with_most_edges(&image).1;
                    chosen.push((view, window));
                    all.push(ViewComparison {
                        name: files::one_line(views.name(view)),
                        place,
                        pictures: vec![named("photograph", shrink(&image, MAX_SIDE), QUALITY)?],
                        crops: vec![crop("photograph", &image, window)?],
                        scores: Vec::new(),
                    });
                }
                let (ranked_by, orbits) = (run.name.clone(), Vec::new());
                pictures.insert(ScenePictures { split, ranked_by, count, views: all, orbits })
            }
        };
        for (comparison, &(view, window)) in pictures.views.iter_mut().zip(&chosen) {
            let (rendered, scores) = renderer.evaluate(&views, view)?;
            comparison.pictures.push(named(&run.name, shrink(&rendered, MAX_SIDE), QUALITY)?);
            comparison.crops.push(crop(&run.name, &rendered, window)?);
            comparison.scores.push((run.name.clone(), scores));
        }
        pictures.orbits.push(Orbit { name: run.name.clone(), frames: renderer.orbit(&dataset)? });
    }
    pictures.ok_or_else(|| {
        Failure::input("no run is named; name the folder that `densify train` wrote")
    })
}

/// A model and the settings to render it.
struct Renderer {
    backend: Box<dyn Backend>,
    background: [f32; 3],
    degree: u8,
}

impl Renderer {
    /// Renders a view and evaluates it: PSNR, SSIM and FLIP.
    fn evaluate(
        &mut self,
        views: &DatasetViews,
        view: usize,
    ) -> Result<(RgbImage, [f64; 3]), Failure> {
        let truth = image(views, view)?;
        let rendering = self.backend.render(views.camera(view), self.background, self.degree)?;
        let score = Comparison::default().score(&rendering.rgb, &truth, self.background);
        let FittedScore { psnr, ssim, flip, .. } =
            score.map_err(|error| Failure::input(format!("{}: {error}", views.name(view))))?;
        Ok((picture(&rendering), [psnr, ssim, flip]))
    }

    /// Renders an orbit around the point that the cameras look at.
    fn orbit(&mut self, dataset: &Dataset) -> Result<Vec<EmbeddedImage>, Failure> {
        let views = if dataset.train.is_empty() { &dataset.test } else { &dataset.train };
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        let Some(first) = cameras.first() else { return Ok(Vec::new()) };
        let (width, height) = limit_size((first.width, first.height), MAX_FRAME_SIDE);
        let path = orbit(&cameras);
        let mut frame = |at: u32| {
            let camera = path.frame(at, FRAMES).camera((width, height));
            let rendering = self.backend.render(&camera, self.background, self.degree)?;
            EmbeddedImage::jpeg(&picture(&rendering), FRAME_QUALITY)
        };
        (0..FRAMES).map(&mut frame).collect()
    }
}

/// Ranks views by PSNR, the lowest first. Without scores in the run, evaluates some of the views.
fn rank_views(
    run: &RunRecord,
    views: &DatasetViews,
    renderer: &mut Renderer,
) -> Result<Vec<usize>, Failure> {
    let all = 0..views.count();
    let known = |view: usize| Some((*run.by_view.get(views.name(view))?, view));
    let mut ranked = match all.clone().map(known).collect::<Option<Vec<(f64, usize)>>>() {
        Some(known) => known,
        None => {
            let every = views.count().div_ceil(MAX_EVALUATED).max(1);
            let evaluated =
                all.step_by(every).map(|view| Ok((renderer.evaluate(views, view)?.1[0], view)));
            evaluated.collect::<Result<_, Failure>>()?
        }
    };
    // Views of equal PSNR stay in the order of the dataset.
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    Ok(ranked.into_iter().map(|(_, view)| view).collect())
}

/// The worst and the best views with their place in the ranking; all views if there are few.
fn choose_ends(ranking: &[usize]) -> Vec<(usize, &'static str)> {
    let place = |at: usize| match (at, ranking.len() - 1 - at) {
        (_, 0) if ranking.len() == 1 => "only",
        (0, _) => "worst",
        (_, 0) => "best",
        (1, more) if more > 1 => "second worst",
        (more, 1) if more > 1 => "second best",
        _ => "middle",
    };
    let is_near_an_end = |at: &usize| *at < FROM_EACH_END || ranking.len() - 1 - at < FROM_EACH_END;
    (0..ranking.len()).filter(is_near_an_end).map(|at| (ranking[at], place(at))).collect()
}

fn image(views: &DatasetViews, view: usize) -> Result<densify_core::image::SharedImage, Failure> {
    views.image(view).map_err(|error| Failure::input(format!("{}: {error}", views.name(view))))
}

fn named(name: &str, image: RgbImage, quality: u8) -> Result<NamedPicture, Failure> {
    Ok(NamedPicture { name: name.to_owned(), picture: EmbeddedImage::jpeg(&image, quality)? })
}

fn crop(name: &str, image: &RgbImage, window: Window) -> Result<NamedPicture, Failure> {
    Ok(NamedPicture {
        name: name.to_owned(),
        picture: EmbeddedImage::lossless(&window.crop(image))?,
    })
}

/// Shrinks a size to fit into a square of this side, keeping the aspect ratio.
fn limit_size((width, height): (u32, u32), side: u32) -> (u32, u32) {
    let scale = (f64::from(side) / f64::from(width.max(height))).min(1.0);
    let scaled = |side: u32| ((f64::from(side) * scale).round() as u32).max(1);
    (scaled(width), scaled(height))
}

fn shrink(image: &RgbImage, side: u32) -> RgbImage {
    let (width, height) = limit_size(image.dimensions(), side);
    if (width, height) == image.dimensions() {
        return image.clone();
    }
    imageops::resize(image, width, height, imageops::FilterType::Triangle)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_views_come_first_and_none_is_repeated() {
        let places = |count: usize| -> Vec<&str> {
            choose_ends(&(0..count).collect::<Vec<_>>())
                .into_iter()
                .map(|(_, place)| place)
                .collect()
        };
        assert_eq!(places(0), [""; 0]);
        assert_eq!(places(1), ["only"]);
        assert_eq!(places(2), ["worst", "best"]);
        assert_eq!(places(3), ["worst", "middle", "best"]);
        assert_eq!(places(4), ["worst", "second worst", "second best", "best"]);
        let many: Vec<usize> = (0..9).rev().collect();
        let views: Vec<usize> = choose_ends(&many).into_iter().map(|(view, _)| view).collect();
        assert_eq!(views, [8, 7, 1, 0]);
        assert_eq!(places(9), ["worst", "second worst", "second best", "best"]);
    }

    #[test]
    fn pictures_keep_their_aspect_ratio_and_are_never_enlarged() {
        assert_eq!(limit_size((640, 480), 960), (640, 480));
        assert_eq!(limit_size((1920, 1080), 960), (960, 540));
        assert_eq!(limit_size((5000, 2), 400), (400, 1));
        assert_eq!(shrink(&RgbImage::new(2000, 1000), 960).dimensions(), (960, 480));
    }
}
