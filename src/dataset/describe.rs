//! What a dataset amounts to: the size of its largest image, and a line about it.

use super::Dataset;
use crate::memory::Bytes;
use crate::number::grouped;

impl Dataset {
    /// Width and height that hold every view `[px]`.
    #[must_use]
    pub fn largest_image(&self) -> (u32, u32) {
        let cameras = self.train.iter().chain(&self.test).map(|view| &view.camera);
        cameras.fold((1, 1), |(w, h), camera| (w.max(camera.width), h.max(camera.height)))
    }

    /// A line about it: views, their size, points.
    #[must_use]
    pub fn describe(&self) -> String {
        let (width, height) = self.largest_image();
        let decoded: u64 = self.train.iter().map(|view| view.source.loaded_bytes()).sum();
        format!(
            "{} views to train on ({} decoded), {} held out, up to {width}x{height} px, {} points",
            self.train.len(),
            Bytes(decoded),
            self.test.len(),
            grouped(self.points.len()),
        )
    }
}
