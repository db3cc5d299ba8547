//! What is seen: the worst and the best views beside their photographs, windows of them, and a turn around the
//! scene.

use image::{RgbImage, imageops};

use super::Wanted;
use super::groups::Scene;
use super::runs::Told;
use densify_core::camera::Camera;
use densify_core::camera_path::orbit;
use densify_core::files;
use densify_data::dataset::Dataset;
use densify_data::views::{DatasetViews, ViewSource};
use densify_html::Embedded;
use densify_render::Backend;
use densify_run::Observer;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, load, or_moved, read_model, views_of};
use densify_study::window::Window;
use densify_train::evaluate::{Comparison, FittedScore, Split};
use densify_train::output::model_path;
use densify_train::pictures::{photograph, picture};

/// Longest side of a picture `[px]`.
const LONGEST: u32 = 960;
/// Quality of its JPEG.
const QUALITY: u8 = 88;
/// Views from each end of the ranking.
const FROM_EACH_END: usize = 2;
/// Views that are measured where nothing is known of them.
const MOST_MEASURED: usize = 24;
/// Frames of a turn.
const FRAMES: u32 = 24;
/// Longest side of a frame `[px]`, and the quality of its JPEG.
const FRAME: u32 = 400;
const FRAME_QUALITY: u8 = 80;

/// A picture with what it is called.
pub(super) struct Named {
    pub(super) name: String,
    pub(super) picture: Embedded,
}

/// A view of the dataset: its photograph, and what each run makes of it.
pub(super) struct View {
    pub(super) name: String,
    /// Its place among all, such as `worst`.
    pub(super) place: &'static str,
    /// The photograph, then the runs.
    pub(super) pictures: Vec<Named>,
    /// The same window of each.
    pub(super) crops: Vec<Named>,
    /// Run, PSNR `[dB]`, SSIM and FLIP.
    pub(super) scores: Vec<(String, [f64; 3])>,
}

/// A turn around the scene.
pub(super) struct Turn {
    pub(super) name: String,
    pub(super) frames: Vec<Embedded>,
}

/// Everything that is seen of a scene.
pub(super) struct Shown {
    /// Whether the views are held out; else they were trained on.
    pub(super) split: Split,
    /// What decided which are worst and best.
    pub(super) ranked_by: String,
    /// Views that the scene has of this split.
    pub(super) count: usize,
    pub(super) views: Vec<View>,
    pub(super) turns: Vec<Turn>,
}

/// Renders what there is to see of a scene.
pub(super) fn show(
    scene: &Scene,
    runs: &[Told],
    wanted: &Wanted<'_>,
    machine: &Machine,
    observer: &dyn Observer,
) -> Result<Shown, Failure> {
    let path = wanted.scene.unwrap_or(&scene.path);
    let dataset = load(path, &scene.data, observer).map_err(|failure| match wanted.scene {
        Some(_) => failure,
        None => or_moved(failure, path),
    })?;
    let split = if dataset.test.is_empty() { Split::Train } else { Split::Test };
    let views = views_of(&dataset, split)?;
    let background = scene.data.background.fixed();
    let mut shown: Option<Shown> = None;
    let mut chosen: Vec<(usize, Window)> = Vec::new();
    for number in scene.shown() {
        let run = &runs[number];
        observer.say(format_args!("pictures {}", run.name));
        let model = read_model(&model_path(&run.folder, run.iteration), observer)?;
        let degree = model.sh_degree;
        let near = (run.config.spec.start.near.0 * dataset.extent()) as f32;
        let mut eye = Eye { backend: machine.backend(&dataset, model, near)?, background, degree };
        // The first run says which views, and their photographs come first.
        let shown = match &mut shown {
            Some(shown) => shown,
            None => {
                let (count, ranking) = (views.count(), ranking(run, &views, &mut eye)?);
                let mut all = Vec::new();
                for (view, place) in ends(&ranking) {
                    let image = photograph(&*image(&views, view)?, background);
                    let window = Window::with_most_edges(&image).1;
                    chosen.push((view, window));
                    all.push(View {
                        name: files::one_line(views.name(view)),
                        place,
                        pictures: vec![named("photograph", fitted(&image, LONGEST), QUALITY)?],
                        crops: vec![crop("photograph", &image, window)?],
                        scores: Vec::new(),
                    });
                }
                let (ranked_by, turns) = (run.name.clone(), Vec::new());
                shown.insert(Shown { split, ranked_by, count, views: all, turns })
            }
        };
        for (shown, &(view, window)) in shown.views.iter_mut().zip(&chosen) {
            let (rendered, scores) = eye.measured(&views, view)?;
            shown.pictures.push(named(&run.name, fitted(&rendered, LONGEST), QUALITY)?);
            shown.crops.push(crop(&run.name, &rendered, window)?);
            shown.scores.push((run.name.clone(), scores));
        }
        shown.turns.push(Turn { name: run.name.clone(), frames: eye.turn(&dataset)? });
    }
    shown.ok_or_else(|| {
        Failure::input("no run is named; name the folder that `densify train` wrote")
    })
}

/// A model that looks at views.
struct Eye {
    backend: Box<dyn Backend>,
    background: [f32; 3],
    degree: u8,
}

impl Eye {
    /// A view as the model shows it, with PSNR, SSIM and FLIP.
    fn measured(
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

    /// Once around what the cameras look at.
    fn turn(&mut self, dataset: &Dataset) -> Result<Vec<Embedded>, Failure> {
        let views = if dataset.train.is_empty() { &dataset.test } else { &dataset.train };
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        let Some(first) = cameras.first() else { return Ok(Vec::new()) };
        let (width, height) = within((first.width, first.height), FRAME);
        let path = orbit(&cameras);
        let mut frame = |at: u32| {
            let camera = path.frame(at, FRAMES).camera((width, height));
            let rendering = self.backend.render(&camera, self.background, self.degree)?;
            Embedded::jpeg(&picture(&rendering), FRAME_QUALITY)
        };
        (0..FRAMES).map(&mut frame).collect()
    }
}

/// Views by PSNR, the lowest first: as the run has measured them, or else as some of them are now.
fn ranking(run: &Told, views: &DatasetViews, eye: &mut Eye) -> Result<Vec<usize>, Failure> {
    let all = 0..views.count();
    let known = |view: usize| Some((*run.by_view.get(views.name(view))?, view));
    let mut ranked = match all.clone().map(known).collect::<Option<Vec<(f64, usize)>>>() {
        Some(known) => known,
        None => {
            let every = views.count().div_ceil(MOST_MEASURED).max(1);
            let measured =
                all.step_by(every).map(|view| Ok((eye.measured(views, view)?.1[0], view)));
            measured.collect::<Result<_, Failure>>()?
        }
    };
    // Of equals the first.
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    Ok(ranked.into_iter().map(|(_, view)| view).collect())
}

/// The worst and the best, with what they are called; all of few.
fn ends(ranking: &[usize]) -> Vec<(usize, &'static str)> {
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

fn named(name: &str, image: RgbImage, quality: u8) -> Result<Named, Failure> {
    Ok(Named { name: name.to_owned(), picture: Embedded::jpeg(&image, quality)? })
}

fn crop(name: &str, image: &RgbImage, window: Window) -> Result<Named, Failure> {
    Ok(Named { name: name.to_owned(), picture: Embedded::lossless(&window.of(image))? })
}

/// A size within a square of this side, of the same shape; never larger.
fn within((width, height): (u32, u32), side: u32) -> (u32, u32) {
    let scale = (f64::from(side) / f64::from(width.max(height))).min(1.0);
    let scaled = |of: u32| ((f64::from(of) * scale).round() as u32).max(1);
    (scaled(width), scaled(height))
}

fn fitted(image: &RgbImage, side: u32) -> RgbImage {
    let (width, height) = within(image.dimensions(), side);
    match (width, height) == image.dimensions() {
        true => image.clone(),
        false => imageops::resize(image, width, height, imageops::FilterType::Triangle),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_come_first_and_every_view_once() {
        let called = |count: usize| -> Vec<&str> {
            ends(&(0..count).collect::<Vec<_>>()).into_iter().map(|(_, place)| place).collect()
        };
        assert_eq!(called(0), [""; 0]);
        assert_eq!(called(1), ["only"]);
        assert_eq!(called(2), ["worst", "best"]);
        assert_eq!(called(3), ["worst", "middle", "best"]);
        assert_eq!(called(4), ["worst", "second worst", "second best", "best"]);
        let many: Vec<usize> = (0..9).rev().collect();
        let views: Vec<usize> = ends(&many).into_iter().map(|(view, _)| view).collect();
        assert_eq!(views, [8, 7, 1, 0]);
        assert_eq!(called(9), ["worst", "second worst", "second best", "best"]);
    }

    #[test]
    fn pictures_keep_their_shape_and_are_never_enlarged() {
        assert_eq!(within((640, 480), 960), (640, 480));
        assert_eq!(within((1920, 1080), 960), (960, 540));
        assert_eq!(within((5000, 2), 400), (400, 1));
        assert_eq!(fitted(&RgbImage::new(2000, 1000), 960).dimensions(), (960, 480));
    }
}
