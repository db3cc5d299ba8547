//! Scores a model on a set of views.

use std::ops::ControlFlow;

use serde::{Deserialize, Deserializer, Serialize};

use crate::exposure::fitted;
use crate::metrics::{Lpips, MetricError, flip, psnr, ssim};
use densify_core::image::Image8;
use densify_data::views::{ViewError, ViewSource};
use densify_render::{Backend, BackendError};

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
    /// LPIPS, where there are weights for it.
    pub lpips: Option<f64>,
    /// The same with the exposure that fits the photograph best, if asked for.
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
    /// LPIPS: distance by the features of a network, 0 for equal images; where there were weights for it.
    #[serde(rename = "LPIPS", default, skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    /// The same of renderings that are exposed as their photographs were, where asked for.
    #[serde(flatten)]
    pub fitted: Option<FittedScore>,
}

/// Scores of a rendering, or means of several, with the factor and the offset per channel that bring it nearest
/// to its photograph.
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
    /// LPIPS, where there are weights for it.
    #[serde(rename = "LPIPS_fitted", default, skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
}

/// JSON has no infinity, the ratio of two equal images, and writes it as null.
fn or_infinite<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f64::INFINITY))
}

impl Mean {
    /// Mean over the views; NaN without views.
    #[must_use]
    pub fn of(views: &[ViewScore]) -> Self {
        let mean = |score: fn(&ViewScore) -> f64| {
            views.iter().map(score).sum::<f64>() / views.len() as f64
        };
        // Of what was not measured in every view there is none.
        let mean_of = |score: &dyn Fn(&ViewScore) -> Option<f64>| {
            let sum = views.iter().map(score).sum::<Option<f64>>();
            sum.filter(|_| !views.is_empty()).map(|sum| sum / views.len() as f64)
        };
        let fitted = |score: fn(&FittedScore) -> Option<f64>| {
            mean_of(&|view| view.fitted.as_ref().and_then(score))
        };
        let of_fitted = |psnr| {
            let (ssim, flip) = (fitted(|it| Some(it.ssim))?, fitted(|it| Some(it.flip))?);
            Some(FittedScore { psnr, ssim, flip, lpips: fitted(|it| it.lpips) })
        };
        Self {
            psnr: mean(|view| view.psnr),
            ssim: mean(|view| view.ssim),
            flip: mean(|view| view.flip),
            lpips: mean_of(&|view| view.lpips),
            fitted: fitted(|it| Some(it.psnr)).and_then(of_fitted),
        }
    }
}

/// Why a model cannot be measured.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// A view's pixels or known surface could not be read, or not be compared with the rendering.
    #[error("view `{view}`: {source}")]
    View {
        /// The view's name.
        view: String,
        /// What is wrong with it.
        source: ViewError,
    },
    /// A view could not be rendered.
    #[error("view `{view}`: {source}")]
    Backend {
        /// The view's name.
        view: String,
        /// The error of the backend.
        source: BackendError,
    },
    /// The model or its signals could not be copied from the device.
    #[error(transparent)]
    Model(#[from] BackendError),
    /// The neighbour search does not support so many rows.
    #[error("{0} rows are too many to search for neighbours")]
    TooManyRows(usize),
    /// Stopped by the caller.
    #[error("stopped before all views were measured")]
    Stopped,
}

/// How renderings are compared with photographs.
#[derive(Clone, Copy, Default)]
pub struct Comparison<'a> {
    /// The network for LPIPS, which is measured where there is one.
    pub lpips: Option<&'a Lpips>,
    /// Whether each is compared a second time, with the exposure that fits the photograph best.
    pub fits_exposure: bool,
}

impl Comparison<'_> {
    /// Scores of a rendering, as it is.
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

/// Renders every view and compares it with its image. `after_view` is called after each view and may stop the
/// evaluation.
pub fn evaluate(
    backend: &mut dyn Backend,
    views: &impl ViewSource,
    background: [f32; 3],
    sh_degree: u8,
    comparison: Comparison<'_>,
    mut after_view: impl FnMut(&ViewScore) -> ControlFlow<()>,
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
        let fitted = match comparison.fits_exposure {
            true => Some(score(&fitted(&rendering.rgb, &image, background)).map_err(metric)?),
            false => None,
        };
        let score = ViewScore { name: name(), psnr, ssim, flip, lpips, fitted };
        let flow = after_view(&score);
        scores.push(score);
        if flow.is_break() {
            return Err(EvaluateError::Stopped);
        }
    }
    Ok(scores)
}
