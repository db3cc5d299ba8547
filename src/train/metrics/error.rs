//! Errors of comparing images and of evaluating models.

use densify_data::views::ViewError;
use densify_render::BackendError;

/// Reason why two images cannot be compared.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MetricError {
    /// The number of values of the render, or of a channel of the target, does not match the target's size.
    #[error("{found} values in the {part}; an image of {width}x{height} px needs {expected}")]
    Size {
        /// The render, or the target's colours, coverage or mask.
        part: &'static str,
        /// Actual number of values.
        found: usize,
        /// Expected number of values.
        expected: usize,
        /// The target's width `[px]`.
        width: u32,
        /// The target's height `[px]`.
        height: u32,
    },
    /// The image is too small for the network.
    #[error(
        "an image of {width}x{height} px is too small for LPIPS; its sides must have at least {least} px"
    )]
    TooSmall {
        /// Smallest side that the network accepts `[px]`.
        least: usize,
        /// The target's width `[px]`.
        width: u32,
        /// The target's height `[px]`.
        height: u32,
    },
    /// The mask hides every pixel.
    #[error("the mask ignores every pixel of the target; remove the mask, or leave this view out")]
    NothingToCompare,
}

/// Reason why a model cannot be evaluated.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// A view's pixels or known surface cannot be read, or cannot be compared with the rendering.
    #[error("view `{view}`: {source}")]
    View {
        /// The view's name.
        view: String,
        /// The cause.
        source: ViewError,
    },
    /// A view cannot be rendered.
    #[error("view `{view}`: {source}")]
    Backend {
        /// The view's name.
        view: String,
        /// The error of the backend.
        source: BackendError,
    },
    /// The model or its signals cannot be copied from the device.
    #[error(transparent)]
    Model(#[from] BackendError),
    /// The caller has stopped the evaluation.
    #[error("stopped before all views were measured")]
    Stopped,
}
