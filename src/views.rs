//! Posed images by number: what trainer and evaluation need of a dataset.

use std::error::Error;

use crate::camera::Camera;
use crate::dataset::images::SharedImage;

/// Why a view cannot be had: whatever the source of the views says.
pub type ViewError = Box<dyn Error + Send + Sync>;

/// Posed images by number, as the trainer needs them.
pub trait ViewSource: Send {
    /// Number of views, >= 1.
    fn count(&self) -> usize;

    /// Name of a view, for messages.
    fn name(&self, view: usize) -> &str;

    /// The view's camera.
    fn camera(&self, view: usize) -> &Camera;

    /// The view's pixels, of the camera's size.
    ///
    /// # Errors
    /// When they cannot be read.
    fn image(&self, view: usize) -> Result<SharedImage, ViewError>;

    /// Says which views will be asked for next, soonest first.
    fn prefetch(&self, upcoming: &[usize]);
}
