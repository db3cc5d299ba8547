//! Posed images by number: what trainer and evaluation need of a dataset.

use std::error::Error;

use crate::camera::Camera;
use crate::dataset::View;
use crate::dataset::images::{ImageCache, SharedImage};

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

/// Views of a dataset with their images, of which some are held decoded.
#[derive(Debug)]
pub struct DatasetViews {
    views: Vec<View>,
    cache: ImageCache,
}

impl DatasetViews {
    /// Serves `views`; holds decoded images of about `cache_bytes`, and decodes ahead with
    /// `threads` threads of its own.
    #[must_use]
    pub fn new(views: Vec<View>, cache_bytes: u64, threads: usize) -> Self {
        let sources = views.iter().map(|view| view.source.clone()).collect();
        Self { cache: ImageCache::new(sources, cache_bytes, threads), views }
    }
}

impl ViewSource for DatasetViews {
    fn count(&self) -> usize {
        self.views.len()
    }

    fn name(&self, view: usize) -> &str {
        &self.views[view].name
    }

    fn camera(&self, view: usize) -> &Camera {
        &self.views[view].camera
    }

    fn image(&self, view: usize) -> Result<SharedImage, ViewError> {
        Ok(self.cache.get(view)?)
    }

    fn prefetch(&self, upcoming: &[usize]) {
        self.cache.prefetch(upcoming);
    }
}
