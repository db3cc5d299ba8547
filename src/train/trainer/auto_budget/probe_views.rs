//! Probe views: a few training views whose PSNR is measured during a run.

use crate::metrics::psnr;
use crate::schedule;
use crate::trainer::{AtStep, TrainError, Trainer};
use densify_data::views::ViewSource;

/// One in this many training views is a probe view.
const ONE_IN: usize = 20;
/// Smallest number of probe views.
const MIN_PROBES: usize = 4;
/// Largest number of probe views.
const MAX_PROBES: usize = 16;
/// Smallest number of training views for which probe views are chosen.
const MIN_VIEWS: usize = 2 * MIN_PROBES;
/// Upper bound to which a measured PSNR is clamped, because equal images have an infinite PSNR `[dB]`.
const MAX_PSNR: f64 = 99.0;

/// The probe views in ascending order, chosen by the seed; empty if there are too few views.
pub(in crate::trainer) fn probe_views(views: usize, seed: u64) -> Vec<usize> {
    if views < MIN_VIEWS {
        return Vec::new();
    }
    // No policy gets the sample of step 0, because policies sample views only at later steps.
    let mut chosen =
        schedule::fresh_views(views, views.div_ceil(ONE_IN).clamp(MIN_PROBES, MAX_PROBES), seed, 0);
    chosen.sort_unstable();
    chosen
}

/// The mean; 0 without values.
pub(super) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

impl<V: ViewSource> Trainer<V> {
    /// The PSNR of each probe view with the current model `[dB]`.
    pub(super) fn probe_psnr(&mut self, step: u32, sh_degree: u8) -> Result<Vec<f64>, TrainError> {
        let background = self.options.background.fixed();
        let mut measured = Vec::with_capacity(self.probe_views.len());
        for view in self.probe_views.clone() {
            let image = self.image(step, view)?;
            let exposure = self.state.exposures.as_ref().map(|exposures| exposures.transform(view));
            let unexposed = exposure.map_or(background, |exposure| exposure.behind(background));
            let camera = self.camera(view);
            let mut rendering = self.backend.render(&camera, unexposed, sh_degree).at(step)?;
            self.state.extra_forwards += 1;
            if let Some(exposure) = exposure {
                for colour in rendering.rgb.as_chunks_mut::<3>().0 {
                    *colour = exposure.apply(*colour);
                }
            }
            if let Some(vignette) = self.vignette(view, self.views.camera(view)) {
                let width = image.width as usize;
                for (i, colour) in rendering.rgb.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                    let (x, y) = (i % width, i / width);
                    *colour = vignette.apply(x, y, image.alpha_at(x, y), *colour);
                }
            }
            let ratio = psnr(&rendering.rgb, &image, background).map_err(|source| {
                let view = self.views.name(view).to_owned();
                TrainError::View { step, view, source: Box::new(source) }
            })?;
            measured.push(ratio.min(MAX_PSNR));
        }
        Ok(measured)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_twentieth_of_the_views_are_probe_views() {
        for (views, count) in [(1, 0), (7, 0), (8, 4), (60, 4), (200, 10), (5_000, 16)] {
            let chosen = probe_views(views, 3);
            assert_eq!(chosen.len(), count, "{views}");
            assert!(chosen.windows(2).all(|pair| pair[0] < pair[1]), "{chosen:?}");
            assert!(chosen.iter().all(|view| *view < views));
        }
    }
}
