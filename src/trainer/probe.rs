//! A few training views that are measured along a run, to see what more rows have brought. Which ones
//! follows from the seed.

use super::{TrainError, Trainer};
use crate::metrics::psnr;
use crate::schedule;
use crate::views::ViewSource;

/// One of so many training views is measured.
const ONE_OF: usize = 20;
/// But no fewer, and no more, than these.
const LEAST: usize = 4;
const MOST: usize = 16;
/// Of fewer training views none can be spared.
const ENOUGH_VIEWS: usize = 2 * LEAST;
/// A higher ratio is taken as this one, as that of two equal images is infinite `[dB]`.
const CLEAN: f64 = 99.0;

/// The views, ascending; none where there are too few to choose from.
pub(super) fn probes(views: usize, seed: u64) -> Vec<usize> {
    if views < ENOUGH_VIEWS {
        return Vec::new();
    }
    // No policy's event is at step 0.
    let mut chosen =
        schedule::fresh_views(views, views.div_ceil(ONE_OF).clamp(LEAST, MOST), seed, 0);
    chosen.sort_unstable();
    chosen
}

/// The mean; 0 of none.
pub(super) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

impl<V: ViewSource> Trainer<V> {
    /// The PSNR `[dB]` of each probe as the model is now, at a degree.
    pub(super) fn probe(&mut self, step: u32, sh_degree: u8) -> Result<Vec<f64>, TrainError> {
        let background = self.options.background.fixed();
        let mut measured = Vec::with_capacity(self.probes.len());
        for view in self.probes.clone() {
            let image = self.image(step, view)?;
            let rendering = self.backend.render(self.views.camera(view), background, sh_degree);
            let rendering = rendering.map_err(|source| self.stopped(step, source))?;
            self.extra_forwards += 1;
            let ratio = psnr(&rendering.rgb, &image, background).map_err(|source| {
                let view = self.views.name(view).to_owned();
                TrainError::View { step, view, source: Box::new(source) }
            })?;
            measured.push(ratio.min(CLEAN));
        }
        Ok(measured)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_twentieth_of_the_views_is_measured_where_they_can_be_spared() {
        for (views, count) in [(1, 0), (7, 0), (8, 4), (60, 4), (200, 10), (5_000, 16)] {
            let chosen = probes(views, 3);
            assert_eq!(chosen.len(), count, "{views}");
            assert!(chosen.windows(2).all(|pair| pair[0] < pair[1]), "{chosen:?}");
            assert!(chosen.iter().all(|view| *view < views));
        }
    }
}
