//! Access to views by index, for training and evaluation.

use std::error::Error;

use crate::dataset::View;
use crate::dataset::images::ImageCache;
use densify_core::camera::Camera;
use densify_core::image::SharedImage;

/// The error of a source of views.
pub type ViewError = Box<dyn Error + Send + Sync>;

/// Views with their cameras and images, by index.
pub trait ViewSource: Send {
    /// Number of views, at least 1.
    fn count(&self) -> usize;

    /// Name of a view, for messages.
    fn name(&self, view: usize) -> &str;

    /// Camera of a view.
    fn camera(&self, view: usize) -> &Camera;

    /// Image of a view, of the camera's size.
    ///
    /// # Errors
    /// When the image cannot be loaded.
    fn image(&self, view: usize) -> Result<SharedImage, ViewError>;

    /// Announces the views that are needed next, in order.
    fn prefetch(&self, upcoming: &[usize]) {
        let _ = upcoming;
    }

    /// Announces the views after this one, for loops over all views in order.
    fn prefetch_after(&self, view: usize) {
        let ahead: Vec<usize> = (view + 1..self.count().min(view + 3)).collect();
        self.prefetch(&ahead);
    }
}

/// The views of a dataset with a cache of decoded images.
#[derive(Debug)]
pub struct DatasetViews {
    views: Vec<View>,
    cache: ImageCache,
}

impl DatasetViews {
    /// Views with a cache of about `cache_bytes` of decoded images, which `threads` threads fill ahead of use.
    pub fn new(views: Vec<View>, cache_bytes: u64, threads: usize) -> Self {
        let sources = views.iter().map(|view| view.source.clone()).collect();
        let cache = ImageCache::new(sources, cache_bytes, threads);
        Self { views, cache }
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
