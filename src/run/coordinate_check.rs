//! Detects models whose coordinates are not those of the dataset. Renderings of such a model correlate with the
//! photographs no more than by chance; even renderings of a poor model of the scene correlate better.

use std::path::Path;

use crate::failure::{Failure, ModelProblem, notes};
use crate::observer::Observer;
use densify_core::image::Image8;
use densify_data::views::ViewSource;
use densify_render::{Backend, Rendering};

/// Maximum number of views that are compared, spread evenly over all views.
const MAX_VIEWS: usize = 8;
/// Correlation below which a model is refused. It is −0.1 to 0.3 for models that were moved, mirrored, rotated or
/// scaled, 0.88 to 0.99 for trained models, and 0.97 after a thousand steps (room256, fox, office, chair, cup).
const REFUSED_BELOW: f64 = 0.1;
/// Correlation below which the user is told that the model may be in other coordinates.
const DOUBTED_BELOW: f64 = 0.35;
/// Standard deviation of the sum of three channels in `[0, 1]` below which an image has too little contrast to compare.
const CONTRAST: f64 = 0.02;
/// Share of covered pixels below which a view counts as not showing the model.
const MIN_COVERAGE: f64 = 1e-3;

/// The correlation of a model's renderings with the photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct CoordinateCheck {
    /// Indices of the views to compare.
    views: Vec<usize>,
    /// Correlations in these views, without views in which the rendering or the photograph has only one colour.
    correlations: Vec<f64>,
}

impl CoordinateCheck {
    /// A check of a model in a dataset with this number of views; [`add`](Self::add) compares one view after another.
    pub fn new(views: usize) -> Self {
        let count = views.min(MAX_VIEWS);
        let views = (0..count).map(|place| place * views / count).collect();
        Self { views, correlations: Vec::new() }
    }

    /// Compares a rendering with its photograph if the check needs this view.
    pub fn add(
        &mut self,
        view: usize,
        rendering: &Rendering,
        image: &Image8,
        background: [f32; 3],
    ) {
        if self.views.contains(&view) {
            self.correlations.extend(compare(rendering, image, background));
        }
    }

    /// Compares the model in a backend with some of the photographs.
    ///
    /// # Errors
    /// When a view cannot be read or rendered.
    pub fn measure(
        backend: &mut dyn Backend,
        views: &impl ViewSource,
        (background, sh_degree): ([f32; 3], u8),
    ) -> Result<Self, Failure> {
        let mut check = Self::new(views.count());
        for view in check.views.clone() {
            let image = views.image(view).map_err(Failure::input)?;
            let rendering = backend.render(views.camera(view), background, sh_degree)?;
            check.add(view, &rendering, &image, background);
        }
        Ok(check)
    }

    /// The mean correlation over the views; `None` if no view could be compared.
    fn correlation(&self) -> Option<f64> {
        let (sum, count) = (self.correlations.iter().sum::<f64>(), self.correlations.len());
        (count > 0).then(|| sum / count as f64)
    }

    /// Fails if the model of `file` is in other coordinates than the dataset, and tells the user if it may be. `option`
    /// is the option that names the file, if there is one.
    ///
    /// # Errors
    /// When the correlation is too low.
    pub fn require(
        &self,
        option: Option<&'static str>,
        file: &Path,
        observer: &dyn Observer,
    ) -> Result<(), Failure> {
        match self.correlation() {
            Some(correlation) if correlation < REFUSED_BELOW => {
                let file = file.to_owned();
                Err(ModelProblem::OtherCoordinates { option, file, correlation }.into())
            }
            _ => {
                self.note(option, file, observer);
                Ok(())
            }
        }
    }

    /// Tells the user if the model may be in other coordinates than the dataset.
    pub fn note(&self, option: Option<&'static str>, file: &Path, observer: &dyn Observer) {
        if let Some(correlation) = self.correlation().filter(|&value| value < DOUBTED_BELOW) {
            let note = notes::other_coordinates(observer.spelling(), option, file, correlation);
            observer.say(format_args!("{note}"));
        }
    }
}

/// The correlation of a rendering with its photograph. It is computed over all pixels, so that outlines count, and over
/// the pixels that the model covers, for models of a part of the scene; the larger correlation is returned. `None` if
/// either image has only one colour.
fn compare(rendering: &Rendering, image: &Image8, background: [f32; 3]) -> Option<f64> {
    let covered = rendering.alpha.iter().map(|&alpha| f64::from(alpha)).sum::<f64>();
    if covered < MIN_COVERAGE * rendering.alpha.len() as f64 {
        return Some(0.0);
    }
    let whole = correlation(rendering, image, background, |_| 1.0);
    let part = correlation(rendering, image, background, |pixel| rendering.alpha[pixel].into());
    whole.into_iter().chain(part).reduce(f64::max)
}

/// The correlation of brightness over all pixels, weighted by `weight` and the photograph's mask.
fn correlation(
    rendering: &Rendering,
    image: &Image8,
    background: [f32; 3],
    weight: impl Fn(usize) -> f64,
) -> Option<f64> {
    let width = image.width as usize;
    let brightness =
        |rgb: [f32; 3]| f64::from(rgb.map(|value| value.clamp(0.0, 1.0)).iter().sum::<f32>());
    let [mut sum, mut x, mut y, mut xx, mut yy, mut xy] = [0.0f64; 6];
    for (pixel, &colour) in rendering.rgb.as_chunks::<3>().0.iter().enumerate() {
        let mask = image.mask.as_ref().map_or(1.0, |mask| f64::from(mask[pixel]) / 255.0);
        let w = mask * weight(pixel);
        // An ignored pixel may be NaN.
        if w > 0.0 {
            let truth = image.composited(pixel % width, pixel / width, background);
            let (a, b) = (brightness(colour), brightness(truth));
            sum += w;
            x += w * a;
            y += w * b;
            xx += w * a * a;
            yy += w * b * b;
            xy += w * a * b;
        }
    }
    let variance = |squares: f64, values: f64| squares / sum - (values / sum).powi(2);
    let (model_variance, truth_variance) = (variance(xx, x), variance(yy, y));
    let min_variance = CONTRAST * CONTRAST;
    let varies = sum > 0.0 && model_variance > min_variance && truth_variance > min_variance;
    varies.then(|| (xy / sum - x / sum * (y / sum)) / (model_variance * truth_variance).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 16;

    fn image(value: impl Fn(usize) -> u8) -> Image8 {
        let rgb = (0..SIZE * SIZE).flat_map(|pixel| [value(pixel); 3]).collect();
        Image8 { width: SIZE as u32, height: SIZE as u32, rgb, alpha: None, mask: None }
    }

    fn rendering(value: impl Fn(usize) -> f32, alpha: impl Fn(usize) -> f32) -> Rendering {
        Rendering {
            width: SIZE as u32,
            height: SIZE as u32,
            rgb: (0..SIZE * SIZE).flat_map(|pixel| [value(pixel); 3]).collect(),
            alpha: (0..SIZE * SIZE).map(alpha).collect(),
            depth: vec![0.0; SIZE * SIZE],
        }
    }

    fn noise(pixel: usize) -> f32 {
        (pixel * 7919 % 4093) as f32 / 4093.0
    }

    fn compare_on_black(rendering: &Rendering, image: &Image8) -> Option<f64> {
        compare(rendering, image, [0.0; 3])
    }

    #[test]
    fn the_check_compares_contrast_not_exposure() {
        let photograph = image(|pixel| (pixel % SIZE * 15) as u8);
        let shown = |pixel: usize| 0.3 + 0.4 * (pixel % SIZE) as f32 / SIZE as f32;
        let mirrored = |pixel: usize| shown(SIZE - 1 - pixel % SIZE);
        let correlation = |value: &dyn Fn(usize) -> f32| {
            compare_on_black(&rendering(value, |_| 1.0), &photograph).expect("both have contrast")
        };
        assert!(correlation(&shown) > 0.99);
        assert!(correlation(&mirrored) < -0.99);
        assert!(correlation(&noise).abs() < 0.1);
    }

    #[test]
    fn a_partial_model_matches_and_an_invisible_one_does_not() {
        let photograph = image(|pixel| (255.0 * noise(pixel)) as u8);
        let is_part = |pixel: usize| pixel < 2 * SIZE;
        let part =
            rendering(|p| if is_part(p) { noise(p) } else { 0.0 }, |p| f32::from(is_part(p)));
        assert!(compare_on_black(&part, &photograph).is_some_and(|value| value > 0.99));
        assert_eq!(compare_on_black(&rendering(|_| 0.0, |_| 0.0), &photograph), Some(0.0));
        // An image of a single colour is no evidence.
        assert_eq!(compare_on_black(&rendering(|_| 0.5, |_| 1.0), &photograph), None);
        assert_eq!(compare_on_black(&rendering(noise, |_| 1.0), &image(|_| 99)), None);
    }

    #[test]
    fn other_coordinates_are_refused_and_doubtful_ones_noted() {
        use std::sync::Mutex;

        #[derive(Default)]
        struct Heard(Mutex<Vec<String>>);
        impl Observer for Heard {
            fn say(&self, line: std::fmt::Arguments<'_>) {
                self.0.lock().expect("no panic").push(line.to_string());
            }
        }
        for (correlation, refused, notes) in
            [(None, false, 0), (Some(0.9), false, 0), (Some(0.2), false, 1), (Some(0.05), true, 0)]
        {
            let heard = Heard::default();
            let correlations = Vec::from_iter(correlation);
            let check = CoordinateCheck { views: vec![0], correlations };
            let result = check.require(Some("init"), Path::new("m.ply"), &heard);
            assert_eq!(result.is_err(), refused, "{correlation:?}");
            let message = result.err().map_or_else(String::new, |failure| failure.to_string());
            assert!(message.is_empty() || message.contains("coordinates"), "{message}");
            assert_eq!(heard.0.lock().expect("no panic").len(), notes, "{correlation:?}");
        }
    }
}
