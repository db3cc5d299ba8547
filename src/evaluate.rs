//! Scores of a model on held-out views.

use std::ops::ControlFlow;

use crate::backend::{Backend, BackendError};
use crate::metrics::{MetricError, flip, psnr, ssim};
use crate::output::Mean;
use crate::views::{ViewError, ViewSource};

/// Which views of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// Those held out.
    Test,
    /// Those trained on.
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
}

/// Scores of a set of views.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Scores {
    /// One entry per view, in the order of the views.
    pub views: Vec<ViewScore>,
}

impl Scores {
    /// Mean over the views; NaN where there are none.
    #[must_use]
    pub fn mean(&self) -> Mean {
        let mean = |score: fn(&ViewScore) -> f64| {
            self.views.iter().map(score).sum::<f64>() / self.views.len() as f64
        };
        Mean {
            psnr: mean(|view| view.psnr),
            ssim: mean(|view| view.ssim),
            flip: mean(|view| view.flip),
        }
    }
}

/// Why a view cannot be scored.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// Its pixels could not be read.
    #[error("view `{view}`: {source}")]
    View {
        /// The view's name.
        view: String,
        /// What the source of the views says.
        source: ViewError,
    },
    /// It could not be rendered.
    #[error("view `{view}`: {source}")]
    Backend {
        /// The view's name.
        view: String,
        /// What the backend says.
        source: BackendError,
    },
    /// Rendering and image cannot be compared.
    #[error("view `{view}`: {source}")]
    Metric {
        /// The view's name.
        view: String,
        /// What the comparison says.
        source: MetricError,
    },
    /// The caller wanted no more.
    #[error("stopped before all views were measured")]
    Stopped,
}

/// Renders every view and compares it with its image. `seen` is called after each view, and may stop
/// it there.
///
/// # Errors
/// [`EvaluateError`] at the first view that cannot be scored; [`EvaluateError::Stopped`].
pub fn evaluate(
    backend: &mut dyn Backend,
    views: &impl ViewSource,
    background: [f32; 3],
    sh_degree: u8,
    mut seen: impl FnMut(&ViewScore) -> ControlFlow<()>,
) -> Result<Scores, EvaluateError> {
    let count = views.count();
    let mut scores = Scores::default();
    for view in 0..count {
        let ahead: Vec<usize> = (view + 1..count.min(view + 3)).collect();
        views.prefetch(&ahead);
        let name = || views.name(view).to_owned();
        let image =
            views.image(view).map_err(|source| EvaluateError::View { view: name(), source })?;
        let rendering = backend
            .render(views.camera(view), background, sh_degree)
            .map_err(|source| EvaluateError::Backend { view: name(), source })?;
        let metric = |source| EvaluateError::Metric { view: name(), source };
        let score = ViewScore {
            name: name(),
            psnr: psnr(&rendering.rgb, &image, background).map_err(metric)?,
            ssim: ssim(&rendering.rgb, &image, background).map_err(metric)?,
            flip: flip(&rendering.rgb, &image, background).map_err(metric)?,
        };
        let flow = seen(&score);
        scores.views.push(score);
        if flow.is_break() {
            return Err(EvaluateError::Stopped);
        }
    }
    Ok(scores)
}
