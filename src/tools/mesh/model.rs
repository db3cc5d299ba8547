//! The depth maps of a model of Gaussian splats.

use densify_core::camera::Camera;
use densify_data::views::ViewSource;
use densify_render::{Backend, DepthKind};
use densify_run::failure::Failure;

use super::{DepthFrame, DepthSource};

/// Pixels whose alpha is lower show no surface.
const MIN_ALPHA: f32 = 0.5;

/// The views of a dataset, rendered from a model by the native backend.
pub struct ModelSource<'a, V> {
    /// The backend with the model.
    pub backend: &'a mut dyn Backend,
    /// The views.
    pub views: &'a V,
    /// Spherical-harmonic degree to render at.
    pub sh_degree: u8,
    /// The depth of a pixel.
    pub depth: DepthKind,
    /// Pixels whose depths, weighted by α·T, have a standard deviation above this fraction of the depth are unknown.
    pub max_spread: f32,
}

impl<V: ViewSource> DepthSource for ModelSource<'_, V> {
    fn count(&self) -> usize {
        self.views.count()
    }

    fn camera(&self, view: usize) -> Camera {
        *self.views.camera(view)
    }

    fn frame(&mut self, view: usize) -> Result<DepthFrame, Failure> {
        let camera = self.views.camera(view);
        let rendering = self.backend.render(camera, [0.0; 3], self.sh_degree)?;
        let depths = self.backend.inspect()?.render_depths(camera)?;
        let of_kind = depths.of_kind(self.depth);
        let depth = (0..depths.alpha.len()).map(|at| {
            let value = of_kind[at];
            let is_shown = depths.alpha[at] >= MIN_ALPHA
                && depths.spread[at] <= self.max_spread * depths.expected[at];
            if is_shown && value.is_finite() { value } else { 0.0 }
        });
        // Without the background, which is black.
        let colour = |(rgb, alpha): (&[f32; 3], &f32)| {
            rgb.map(|value| (value / alpha.max(MIN_ALPHA) * 255.0).round() as u8)
        };
        let (rgb, _) = rendering.rgb.as_chunks::<3>();
        Ok(DepthFrame {
            width: depths.width as usize,
            height: depths.height as usize,
            depth: depth.collect(),
            rgb: rgb.iter().zip(&rendering.alpha).map(colour).collect(),
        })
    }
}
