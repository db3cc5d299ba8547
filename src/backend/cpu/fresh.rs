//! Blend weights in views that are rendered for a policy's decision rather than for training.
//!
//! The backward kernel replays the blending of every pixel, so it finds the largest weights here as
//! it does in training; the image's gradient is zero. That is more than a forward pass alone would
//! take, but weights are then the same to the bit as those of training.

use rayon::prelude::*;

use super::rasterize::DARK;
use super::{BackendError, Camera, CpuBackend};

impl CpuBackend {
    /// Counts one more view for `FreshWeightMax`.
    pub(super) fn measure(&mut self, camera: &Camera, sh_degree: u8) -> Result<(), BackendError> {
        if !self.signals.measures() {
            return Ok(());
        }
        // Stage times stay those of training.
        let clock = std::mem::take(&mut self.clock);
        let frame = self.forward(camera, [0.0; 3], sh_degree, false);
        let measured = frame.map(|frame| {
            let Self { threads, gradient, .. } = self;
            let tiles = gradient[..frame.grid.tiles()].par_iter_mut();
            threads.install(|| {
                threads.each("no gradient", tiles, |tile| tile.planes = [DARK; 5]);
            });
            self.backward(&frame, self.signals.layout());
            let Self { threads, signals, sums, visible, rows, .. } = self;
            threads.install(|| signals.measure(threads, *rows, sums, visible));
        });
        self.clock = clock;
        measured
    }
}
