//! Renderings for people who inspect a model. Training needs none of them.

use std::str::FromStr;

use densify_core::camera::Camera;

use super::{BackendError, Rendering};

/// The depth of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DepthKind {
    /// Expected depth Σ α·T·z / Σ α·T.
    Expected,
    /// Depth of the row at which transmittance falls below ½.
    Median,
}

impl FromStr for DepthKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "expected" => Ok(Self::Expected),
            "median" => Ok(Self::Median),
            _ => Err("give expected or median".to_owned()),
        }
    }
}

impl std::fmt::Display for DepthKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Expected => "expected",
            Self::Median => "median",
        })
    }
}

/// Depths of a view: camera-space z, with each row at the depth of its mean `[scene units]`. Shape of each:
/// `[height, width]`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SurfaceDepths {
    /// Width `[px]`.
    pub width: u32,
    /// Height `[px]`.
    pub height: u32,
    /// 1 − final transmittance, in `[0, 1]`.
    pub alpha: Vec<f32>,
    /// Expected depth Σ α·T·z / Σ α·T; 0 where alpha is 0.
    pub expected: Vec<f32>,
    /// Depth of the row at which transmittance falls below ½; 0 where it does not.
    pub median: Vec<f32>,
    /// Standard deviation of the depths with weights α·T; 0 where alpha is 0.
    pub spread: Vec<f32>,
}

impl SurfaceDepths {
    /// The depths of this kind.
    pub fn of_kind(&self, kind: DepthKind) -> &[f32] {
        match kind {
            DepthKind::Expected => &self.expected,
            DepthKind::Median => &self.median,
        }
    }
}

/// Renders properties of the rows instead of their colours.
pub trait Inspect {
    /// Renders a view with the given colours instead of the rows' own: sRGB-encoded, >= 0, the same from every
    /// direction. The model is unchanged.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When there is not one colour per row: a bug in the caller.
    fn render_painted(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        colours: &[[f32; 3]],
    ) -> Result<Rendering, BackendError>;

    /// Returns whether the backend supports [`render_counts`](Self::render_counts).
    fn counts_rows(&self) -> bool {
        false
    }

    /// Renders a view whose depth plane holds the number of rows blended into each pixel.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`] unless the backend [counts rows](Self::counts_rows).
    fn render_counts(&mut self, _camera: &Camera) -> Result<Rendering, BackendError> {
        Err(BackendError::Unsupported("counting the Gaussians per pixel"))
    }

    /// Renders the depths of a view.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`] on a GPU.
    fn render_depths(&mut self, _camera: &Camera) -> Result<SurfaceDepths, BackendError> {
        Err(BackendError::Unsupported("median depth"))
    }
}
