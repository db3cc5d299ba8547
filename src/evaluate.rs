//! Scores a model on a set of views.

use std::ops::ControlFlow;

use serde::{Deserialize, Deserializer, Serialize};

use crate::backend::{Backend, BackendError};
use crate::metrics::{Lpips, MetricError, flip, psnr, ssim};
use crate::views::{ViewError, ViewSource};

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
        Self {
            psnr: mean(|view| view.psnr),
            ssim: mean(|view| view.ssim),
            flip: mean(|view| view.flip),
            lpips: views
                .iter()
                .map(|view| view.lpips)
                .sum::<Option<f64>>()
                .filter(|_| !views.is_empty())
                .map(|sum| sum / views.len() as f64),
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

/// Renders every view and compares it with its image, by LPIPS too where there is a network. `after_view` is
/// called after each view and may stop the evaluation.
pub fn evaluate(
    backend: &mut dyn Backend,
    views: &impl ViewSource,
    background: [f32; 3],
    sh_degree: u8,
    lpips: Option<&Lpips>,
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
        let score = ViewScore {
            name: name(),
            psnr: psnr(&rendering.rgb, &image, background).map_err(metric)?,
            ssim: ssim(&rendering.rgb, &image, background).map_err(metric)?,
            flip: flip(&rendering.rgb, &image, background).map_err(metric)?,
            lpips: lpips
                .map(|lpips| lpips.compare(&rendering.rgb, &image, background))
                .transpose()
                .map_err(metric)?,
        };
        let flow = after_view(&score);
        scores.push(score);
        if flow.is_break() {
            return Err(EvaluateError::Stopped);
        }
    }
    Ok(scores)
}
