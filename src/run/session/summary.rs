//! The summary of a run: `stats/summary.json`, the automatic reductions, and a few lines for the user.

use std::path::Path;

use super::requirements::{REQUIREMENTS, Requirements};
use super::{Run, Session};
use densify_core::files::FileError;
use densify_core::memory::Bytes;
use densify_core::numbers::{duration, grouped};
use densify_data::views::ViewSource;
use densify_train::evaluate::FittedScore;
use densify_train::output::{Mean, Summary, model_path, write_json};

impl Session<'_> {
    pub(super) fn write_summary(&self, finished: bool) -> Result<(), FileError> {
        let Run { spec, config, trainer, test, ledger, .. } = &self.run;
        let state = trainer.progress();
        let more = [
            ("policy events", state.policy_time.saturating_sub(state.views_time)),
            ("policy views", state.views_time),
            ("images", trainer.images_time()),
        ];
        let more = more.map(|(stage, time)| (stage.to_owned(), time));
        let stages = self.run.totals.stages.clone().into_iter().chain(more);
        let stage_seconds = stages.map(|(stage, time)| (stage, time.as_secs_f64())).collect();
        let summary = Summary {
            densify: config.densify.clone(),
            policy: spec.density.policy.clone(),
            finished,
            iterations: state.step,
            rows: trainer.rows(),
            peak_rows: state.peak_rows,
            budget: config.budget,
            extra_forwards: state.extra_forwards,
            peak_bytes: self.run.totals.peak_bytes(self.run.process),
            memory: spec.size.memory.map(|bytes| bytes.0),
            ledger_bytes: ledger.total(),
            ledger: ledger.clone(),
            seconds: self.run.totals.wall.as_secs_f64(),
            stage_seconds,
            cpu_seconds: self.run.totals.cpu.map(|cpu| cpu.as_secs_f64()),
            train_views: trainer.views().count(),
            test_views: test.count(),
            test: self.run.totals.tested.clone(),
        };
        write_json(&self.folder.join(REQUIREMENTS), &self.requirements())?;
        write_json(&self.folder.join("stats/summary.json"), &summary)
    }

    /// The report on what the run required, and its automatic reductions.
    fn requirements(&self) -> Requirements {
        let Run { config, trainer, .. } = &self.run;
        let growth = trainer.progress().auto_budget.as_ref();
        let vignettes = trainer.progress().vignettes.as_ref();
        Requirements::new(config, trainer.rows(), growth, trainer.unscored_views(), vignettes)
    }

    /// Tells the user the result in a few lines.
    pub(super) fn report(&self, path: &Path) {
        let Run { config, trainer, test, ledger, .. } = &self.run;
        let steps = trainer.steps_done();
        if let Some(Mean { psnr, ssim, flip, fitted, .. }) = self.run.totals.tested.get(&steps) {
            let views = test.count();
            self.observer.say(format_args!(
                "test     PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4} (mean of {views} views)"
            ));
            if let Some(FittedScore { psnr, ssim, flip, .. }) = fitted {
                let what = match (config.resolved.has_exposures, config.resolved.refines_poses) {
                    (true, true) => "pose and exposure",
                    (false, true) => "pose",
                    (_, false) => "exposure",
                };
                self.observer.say(format_args!(
                    "fitted   PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4}, with the best {what} of each view"
                ));
            }
        }
        if let Some(poses) = &trainer.progress().poses {
            let given = |view| trainer.views().camera(view);
            let [turned, moved] = poses.rms(given);
            let extent = self.run.dataset.extent();
            self.observer.say(format_args!(
                "poses    moved by {:.3} degrees and {:.2} % of the extent (rms); cameras.json has them",
                turned.to_degrees(),
                100.0 * moved / extent
            ));
        }
        self.observer.say(format_args!(
            "rows     {}, peak {}, budget {}",
            grouped(trainer.rows()),
            grouped(trainer.progress().peak_rows),
            grouped(config.budget)
        ));
        let promised = Bytes(ledger.total());
        if let Some(peak) = self.run.totals.peak_bytes(self.run.process) {
            let peak = Bytes(peak);
            self.observer.say(format_args!("memory   {peak} at its peak, {promised} promised"));
        }
        let cpu = self.run.totals.cpu_of_steps().map_or_else(String::new, |cpu| {
            format!(", {:.4} CPU-seconds per iteration", cpu.as_secs_f64() / f64::from(steps))
        });
        self.observer.say(format_args!("time     {}{cpu}", duration(self.run.totals.wall)));
        for line in self.requirements().lines(self.observer.spelling()) {
            self.observer.say(format_args!("{line}"));
        }
        self.observer.say(format_args!("model    {}", model_path(path, steps).display()));
        self.observer.say(format_args!("numbers  {}", path.join("stats").display()));
    }
}
