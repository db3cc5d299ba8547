//! Scores a model on a set of views.

use std::ops::ControlFlow;

use serde::{Deserialize, Deserializer, Serialize};

use crate::exposure::fitted;
pub use crate::metrics::EvaluateError;
use crate::metrics::{Lpips, MetricError, flip, psnr, ssim};
use crate::poses::fitted_camera;
use densify_core::image::Image8;
use densify_data::views::ViewSource;
use densify_render::{Backend, Rendering};

/// Part of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Split {
    /// The views held out
    Test,
    /// The views trained on
    Train,
}

/// Scores of one view.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewScore {
    /// The view's name.
    pub name: String,
    /// Peak signal-to-noise ratio `[dB]`.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
    /// FLIP error.
    pub flip: f64,
    /// LPIPS; `None` if its weights are not available.
    pub lpips: Option<f64>,
    /// Scores of the rendering with the pose and the exposure that fit the photograph best, of which each may be
    /// requested.
    pub fitted: Option<FittedScore>,
}

/// Mean scores of a set of views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Mean {
    /// Peak signal-to-noise ratio `[dB]`.
    #[serde(rename = "PSNR", deserialize_with = "or_infinite")]
    pub psnr: f64,
    /// Structural similarity.
    #[serde(rename = "SSIM")]
    pub ssim: f64,
    /// FLIP error: visible difference, 0 for equal images.
    #[serde(rename = "FLIP")]
    pub flip: f64,
    /// LPIPS: distance between network features, 0 for equal images; `None` if its weights were not available.
    #[serde(rename = "LPIPS", default, skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    /// Mean scores of the renderings with the poses and exposures that fit the photographs best, if requested.
    #[serde(flatten)]
    pub fitted: Option<FittedScore>,
}

/// Scores of a rendering, or means of several. In [`ViewScore`] and [`Mean`] they are measured after fitting to the
/// photograph the pose, or a factor and an offset per channel, or both; [`Comparison::score`] returns them without a fit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FittedScore {
    /// Peak signal-to-noise ratio `[dB]`.
    #[serde(rename = "PSNR_fitted", deserialize_with = "or_infinite")]
    pub psnr: f64,
    /// Structural similarity.
    #[serde(rename = "SSIM_fitted")]
    pub ssim: f64,
    /// FLIP error.
    #[serde(rename = "FLIP_fitted")]
    pub flip: f64,
    /// LPIPS, if its weights are available.
    #[serde(rename = "LPIPS_fitted", default, skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
}

/// Reads a PSNR; for equal images it is infinite, which JSON writes as null.
fn or_infinite<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f64::INFINITY))
}

impl Mean {
    /// Mean over the views; NaN without views.
    pub fn over(views: &[ViewScore]) -> Self {
        let mean = |score: fn(&ViewScore) -> f64| {
            views.iter().map(score).sum::<f64>() / views.len() as f64
        };
        // An optional score has a mean only if every view has it.
        let optional_mean = |score: &dyn Fn(&ViewScore) -> Option<f64>| {
            let sum = views.iter().map(score).sum::<Option<f64>>();
            sum.filter(|_| !views.is_empty()).map(|sum| sum / views.len() as f64)
        };
        let fitted = |score: fn(&FittedScore) -> Option<f64>| {
            optional_mean(&|view| view.fitted.as_ref().and_then(score))
        };
        let fitted_scores = |psnr| {
            let (ssim, flip) =
                (fitted(|score| Some(score.ssim))?, fitted(|score| Some(score.flip))?);
            Some(FittedScore { psnr, ssim, flip, lpips: fitted(|score| score.lpips) })
        };
        Self {
            psnr: mean(|view| view.psnr),
            ssim: mean(|view| view.ssim),
            flip: mean(|view| view.flip),
            lpips: optional_mean(&|view| view.lpips),
            fitted: fitted(|score| Some(score.psnr)).and_then(fitted_scores),
        }
    }
}

/// Metrics by which renderings are compared with photographs.
#[derive(Clone, Copy, Default)]
pub struct Comparison<'a> {
    /// Network for LPIPS; without one, LPIPS is not measured.
    pub lpips: Option<&'a Lpips>,
    /// True if renderings are compared a second time, with the exposure that fits the photograph best.
    pub fits_exposure: bool,
    /// True if renderings are compared a second time, from the pose that fits the photograph best; requires a backend
    /// [set up](densify_render::Setup::poses) for poses.
    pub fits_pose: bool,
}

impl Comparison<'_> {
    /// Scores of a rendering, without fitting an exposure.
    ///
    /// # Errors
    /// When the images cannot be compared.
    pub fn score(
        self,
        rendered: &[f32],
        image: &Image8,
        background: [f32; 3],
    ) -> Result<FittedScore, MetricError> {
        let lpips = self.lpips.map(|lpips| lpips.compare(rendered, image, background));
        Ok(FittedScore {
            psnr: psnr(rendered, image, background)?,
            ssim: ssim(rendered, image, background)?,
            flip: flip(rendered, image, background)?,
            lpips: lpips.transpose()?,
        })
    }
}

/// A view that has been evaluated.
#[derive(Clone, Copy)]
pub struct Evaluated<'a> {
    /// Index of the view.
    pub view: usize,
    /// The scores of the rendering.
    pub score: &'a ViewScore,
    /// The rendering.
    pub rendering: &'a Rendering,
    /// The photograph.
    pub image: &'a Image8,
}

/// Renders every view and compares it with its image. `after_view` is called after each view and may stop the
/// evaluation.
///
/// # Errors
/// When a view cannot be read, rendered or compared, and when `after_view` stops the evaluation.
pub fn evaluate(
    backend: &mut dyn Backend,
    views: &impl ViewSource,
    background: [f32; 3],
    sh_degree: u8,
    comparison: Comparison<'_>,
    mut after_view: impl FnMut(Evaluated<'_>) -> ControlFlow<()>,
) -> Result<Vec<ViewScore>, EvaluateError> {
    let count = views.count();
    let mut scores = Vec::new();
    for view in 0..count {
        views.prefetch_after(view);
        let name = || views.name(view).to_owned();
        let image =
            views.image(view).map_err(|source| EvaluateError::View { view: name(), source })?;
        let rendering = backend
            .render(views.camera(view), background, sh_degree)
            .map_err(|source| EvaluateError::Backend { view: name(), source })?;
        let metric = |e: MetricError| EvaluateError::View { view: name(), source: e.into() };
        let score = |rendered: &[f32]| comparison.score(rendered, &image, background);
        let FittedScore { psnr, ssim, flip, lpips } = score(&rendering.rgb).map_err(metric)?;
        let mut best = None;
        if comparison.fits_pose {
            let device = |source| EvaluateError::Backend { view: name(), source };
            let camera = fitted_camera(backend, views.camera(view), &image, background, sh_degree);
            let rendering = backend.render(&camera.map_err(device)?, background, sh_degree);
            best = Some(rendering.map_err(device)?.rgb);
        }
        if comparison.fits_exposure {
            best = Some(fitted(best.as_ref().unwrap_or(&rendering.rgb), &image, background));
        }
        let fitted = best.as_deref().map(score).transpose().map_err(metric)?;
        let score = ViewScore { name: name(), psnr, ssim, flip, lpips, fitted };
        let flow =
            after_view(Evaluated { view, score: &score, rendering: &rendering, image: &image });
        scores.push(score);
        if flow.is_break() {
            return Err(EvaluateError::Stopped);
        }
    }
    Ok(scores)
}
