//! Wall time per stage of a training step.

use std::time::{Duration, Instant};

/// Wall time of the stages of the last step.
#[derive(Debug, Default)]
pub(super) struct StageClock {
    pub(super) laps: Vec<(&'static str, Duration)>,
    last: Option<Instant>,
}

impl StageClock {
    pub(super) fn start(&mut self) {
        self.laps.clear();
        self.last = Some(Instant::now());
    }

    pub(super) fn lap(&mut self, stage: &'static str) {
        let now = Instant::now();
        if let Some(last) = self.last.replace(now) {
            self.laps.push((stage, now - last));
        }
    }
}
