//! Views by number: the part of a dataset that training and evaluation use.

use std::error::Error;

use crate::camera::Camera;
use crate::dataset::View;
use crate::dataset::images::{ImageCache, ImageSource, SharedImage};

/// The error of a source of views.
pub type ViewError = Box<dyn Error + Send + Sync>;

/// Views by number.
pub trait ViewSource: Send {
    /// Number of views, >= 1.
    fn count(&self) -> usize;

    /// Name of a view, for messages.
    fn name(&self, view: usize) -> &str;

    /// Camera of a view.
    fn camera(&self, view: usize) -> &Camera;

    /// Pixels of a view, of the camera's size.
    fn image(&self, view: usize) -> Result<SharedImage, ViewError>;

    /// Announces the next views, soonest first.
    fn prefetch(&self, upcoming: &[usize]) {
        let _ = upcoming;
    }

    /// Divides both sides of all cameras and images by this from now on. Sources that cannot shrink
    /// images ignore it.
    fn shrink(&mut self, divisor: u32) {
        let _ = divisor;
    }
}

/// Images are not shrunk below this side: nothing could be learned from them `[px]`.
const MIN_SIDE: u32 = 16;

/// Views of a dataset, with a cache of decoded images.
#[derive(Debug)]
pub struct DatasetViews {
    views: Vec<View>,
    divisor: u32,
    /// Cameras of the shrunk images; empty with divisor 1.
    cameras: Vec<Camera>,
    cache: ImageCache,
    cache_bytes: u64,
    threads: usize,
}

impl DatasetViews {
    /// Serves `views` with a cache of about `cache_bytes` of decoded images, which `threads` threads
    /// fill ahead of use.
    #[must_use]
    pub fn new(views: Vec<View>, cache_bytes: u64, threads: usize) -> Self {
        let sources = views.iter().map(|view| view.source.clone()).collect();
        let cache = ImageCache::new(sources, cache_bytes, threads);
        Self { views, divisor: 1, cameras: Vec::new(), cache, cache_bytes, threads }
    }
}

/// The camera with both sides divided, as far as [`MIN_SIDE`] allows.
fn shrunk(camera: &Camera, divisor: u32) -> Camera {
    let shorter = camera.width.min(camera.height);
    let divisor = f64::from((shorter / MIN_SIDE).clamp(1, divisor.max(1)));
    let side = |side: u32| ((f64::from(side) / divisor).round() as u32).max(1);
    camera.resized(side(camera.width), side(camera.height))
}

impl ViewSource for DatasetViews {
    fn count(&self) -> usize {
        self.views.len()
    }

    fn name(&self, view: usize) -> &str {
        &self.views[view].name
    }

    fn camera(&self, view: usize) -> &Camera {
        self.cameras.get(view).unwrap_or(&self.views[view].camera)
    }

    fn image(&self, view: usize) -> Result<SharedImage, ViewError> {
        Ok(self.cache.get(view)?)
    }

    fn prefetch(&self, upcoming: &[usize]) {
        self.cache.prefetch(upcoming);
    }

    fn shrink(&mut self, divisor: u32) {
        if divisor == self.divisor {
            return;
        }
        self.divisor = divisor;
        self.cameras.clear();
        if divisor > 1 {
            self.cameras.extend(self.views.iter().map(|view| shrunk(&view.camera, divisor)));
        }
        let source = |view: usize| {
            let Camera { width, height, .. } = *self.camera(view);
            ImageSource { width, height, ..self.views[view].source.clone() }
        };
        let sources = (0..self.views.len()).map(source).collect();
        // First the threads end and the memory is freed, then the new cache is made.
        self.cache = ImageCache::new(Vec::new(), 0, 0);
        self.cache = ImageCache::new(sources, self.cache_bytes, self.threads);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Dataset, LoadOptions};

    #[test]
    fn shrunk_views_have_cameras_and_images_of_one_size() {
        let dataset = Dataset::load("scene:spheres".as_ref(), &LoadOptions::default()).unwrap();
        let full = dataset.train[0].camera;
        let mut views = DatasetViews::new(dataset.train[..2].to_vec(), 1 << 20, 1);
        for divisor in [4, 2, 1, 1000, 1] {
            views.shrink(divisor);
            let camera = *views.camera(0);
            let image = views.image(0).unwrap();
            assert_eq!((image.width, image.height), (camera.width, camera.height));
            let least = camera.width.min(camera.height);
            match divisor {
                1 => assert_eq!(camera, full),
                1000 => assert!((MIN_SIDE..2 * MIN_SIDE).contains(&least), "{least}"),
                _ => assert_eq!(camera.width, full.width / divisor),
            }
            // The same rays at the same share of the image.
            let share = |camera: &Camera| camera.cx / f64::from(camera.width);
            assert!((share(&camera) - share(&full)).abs() < 1e-12);
        }
    }
}
