//! Access to views by index, for training and evaluation.

use std::error::Error;
use std::path::Path;
use std::sync::Arc;

use crate::dataset::View;
use crate::dataset::images::{ImageCache, Loaded};
use crate::error::LoadError;
use densify_core::camera::Camera;
use densify_core::image::depth::SharedDepth;
use densify_core::image::{Image8, SharedImage};

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

    /// Image of a view, and its depth if it is used and known; both have the camera's size.
    ///
    /// # Errors
    /// When the image or its depth cannot be loaded.
    fn image_with_depth(
        &self,
        view: usize,
    ) -> Result<(SharedImage, Option<SharedDepth>), ViewError> {
        Ok((self.image(view)?, None))
    }

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

    /// Checks that at least one view has a visible pixel. Decodes only images that may be transparent, and stops at the
    /// first view with a visible pixel.
    ///
    /// # Errors
    /// When every pixel of every view of the dataset `root` is transparent.
    pub fn check_visible(&self, root: &Path) -> Result<(), LoadError> {
        let shows = |(number, view): (usize, &View)| {
            let is_seen = |image: &Image8| match &image.alpha {
                Some(alpha) => alpha.iter().any(|&alpha| alpha > 0),
                None => true,
            };
            // Training reports images that cannot be loaded.
            !view.source.may_be_transparent()
                || self.cache.get(number).map_or(true, |image| is_seen(&image))
        };
        if self.views.iter().enumerate().any(shows) {
            return Ok(());
        }
        Err(LoadError::Data(format!(
            "{}: nothing is visible: every pixel of all {} views to train on is transparent; render them again with \
             cameras that see a surface, or export them without an alpha channel",
            root.display(),
            self.views.len()
        )))
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

    fn image_with_depth(
        &self,
        view: usize,
    ) -> Result<(SharedImage, Option<SharedDepth>), ViewError> {
        let Loaded { image, depth } = self.cache.get_with_depth(view)?;
        Ok((image, depth))
    }

    fn prefetch(&self, upcoming: &[usize]) {
        self.cache.prefetch(upcoming);
    }
}

/// Views whose cameras may have smaller images than the dataset: these are shrunk whenever they are used.
#[derive(Debug)]
pub struct ShrunkViews(pub DatasetViews);

impl ShrunkViews {
    fn shrunk(&self, view: usize, image: SharedImage) -> SharedImage {
        let Camera { width, height, .. } = *self.camera(view);
        if (image.width, image.height) == (width, height) {
            return image;
        }
        Arc::new(image.shrunk(width, height))
    }
}

impl ViewSource for ShrunkViews {
    fn count(&self) -> usize {
        self.0.count()
    }

    fn name(&self, view: usize) -> &str {
        self.0.name(view)
    }

    fn camera(&self, view: usize) -> &Camera {
        self.0.camera(view)
    }

    fn image(&self, view: usize) -> Result<SharedImage, ViewError> {
        Ok(self.shrunk(view, self.0.image(view)?))
    }

    fn image_with_depth(
        &self,
        view: usize,
    ) -> Result<(SharedImage, Option<SharedDepth>), ViewError> {
        let Camera { width, height, .. } = *self.camera(view);
        let (image, depth) = self.0.image_with_depth(view)?;
        let depth = depth.map(|depth| Arc::new(depth.shrunk(width, height)));
        Ok((self.shrunk(view, image), depth))
    }

    fn prefetch(&self, upcoming: &[usize]) {
        self.0.prefetch(upcoming);
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::dataset::images::ImageSource;
    use crate::dataset::{Dataset, LoadOptions};
    use densify_fixtures::Made;

    #[test]
    fn views_that_show_nothing_are_refused() {
        let made = Made::colmap_txt();
        let dataset = Dataset::load(made.path(), &LoadOptions::default()).unwrap();
        let (width, height) = (4, 3);
        let view = |alpha: Option<u8>| {
            let alpha = alpha.map(|last| [vec![0; 11], vec![last]].concat());
            let image = Image8 { width, height, rgb: vec![9; 36], alpha, mask: None };
            let source = ImageSource::rendered("made".into(), image, (width, height));
            View { source, ..dataset.train[0].clone() }
        };
        let check = |views: Vec<View>| {
            DatasetViews::new(views, 0, 0).check_visible(Path::new("scenes/empty"))
        };
        let message = check(vec![view(Some(0)), view(Some(0))]).unwrap_err().to_string();
        assert!(message.contains("scenes/empty") && message.contains("all 2 views"), "{message}");
        check(vec![view(Some(0)), view(Some(1))]).unwrap();
        check(vec![view(Some(0)), view(None)]).unwrap();
        // An image that cannot be loaded does not count as empty.
        let mut lost = view(Some(0));
        lost.source.rendered = None;
        lost.source.file.path = PathBuf::from("missing.png");
        check(vec![lost]).unwrap();
    }
}
