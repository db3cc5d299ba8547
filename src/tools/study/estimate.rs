//! Estimates how long runs take: first from their extent, then from the runs that are done.

use super::outcome::Outcome;
use super::planned_run::PlannedRun;
use densify_run::failure::Failure;
use densify_run::{Extent, Host, Partial, RunSpec, extent};

/// Time of a step on one thread, per pixel of the view and per row of the budget `[s]`. From 7,000 steps on bonsai at
/// 800×533 pixels and 200,000 rows: 1,790 processor-seconds, of which, by the stages' shares, three fifths grow with the
/// rows. Good to a factor of two; measured runs correct it.
const PER_PIXEL: f64 = 0.25e-6;
const PER_ROW: f64 = 0.7e-6;
/// Speed of a GPU as a number of threads (an NVIDIA H200 with a million rows: 480 ms on a thread, 11 ms on the GPU).
const GPU_AS_THREADS: f64 = 40.0;
/// Time of measuring a view, as a number of steps: a forward pass, SSIM and FLIP.
const VIEW_AS_STEPS: f64 = 1.0;
/// Time to start a process, open the scene, and write the outputs `[s]`.
const PER_RUN: f64 = 1.0;

/// Estimated time of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Estimate {
    /// Time `[s]`.
    pub(super) seconds: f64,
    /// True if a finished run has corrected the estimate.
    pub(super) is_measured: bool,
}

/// The extents of runs that were opened, by their description without the seed, on which extents do not depend.
#[derive(Default)]
pub(super) struct Extents(Vec<(Partial, Extent)>);

impl Extents {
    /// Opens the scene of a run, unless that was done for another seed, and notes what the run takes.
    ///
    /// # Errors
    /// When the run cannot be prepared.
    pub(super) fn measure(&mut self, run: &mut PlannedRun) -> Result<(), Failure> {
        let mut options = run.spec.clone();
        options.remove("seed");
        let spec = run.spec.clone().describe()?;
        let known = self.0.iter().find(|(other, _)| *other == options).map(|(_, extent)| *extent);
        let extent = match known {
            Some(extent) => extent,
            None => {
                let extent = extent(&spec, Host::default()).map_err(|failure| {
                    failure.and(&format!("this was the run {run}; no run was started"))
                })?;
                self.0.push((options, extent));
                extent
            }
        };
        run.promised_bytes = Some(extent.host_bytes);
        run.modelled_seconds = Some(modelled_seconds(&spec, &extent));
        Ok(())
    }
}

/// Time of a run by the constants above `[s]`.
fn modelled_seconds(spec: &RunSpec, extent: &Extent) -> f64 {
    let step = PER_PIXEL * extent.pixels + PER_ROW * extent.rows as f64;
    let threads = if extent.is_on_gpu { GPU_AS_THREADS } else { extent.threads.max(1) as f64 };
    let evaluations = (spec.output.test_iterations.len() + 1) as f64;
    let views = evaluations * extent.test_views as f64;
    let steps = f64::from(spec.schedule.iterations.0) + VIEW_AS_STEPS * views;
    PER_RUN + steps * step / threads
}

/// Estimates a run whose extent is known: the modelled time, times the mean ratio of measured to modelled time of the
/// finished runs that are most alike: of the same scene, level and factor; of the same scene and level; of the same
/// scene; or of any.
pub(super) fn estimate<'a>(
    run: &PlannedRun,
    done: impl Iterator<Item = &'a Outcome> + Clone,
) -> Estimate {
    let modelled = run.modelled_seconds.unwrap_or(PER_RUN);
    let likeness = |other: &Outcome| {
        let is_scene = other.scene == run.label;
        let is_level = is_scene && other.level == run.level;
        u8::from(is_scene) + u8::from(is_level) + u8::from(is_level && other.factor == run.factor)
    };
    let ratio = |other: &Outcome| {
        let ratio = other.wall_seconds? / other.modelled_seconds?;
        (ratio.is_finite() && ratio > 0.0).then_some(ratio.ln())
    };
    let measured = done.filter_map(|other| Some((likeness(other), ratio(other)?)));
    let most_alike = measured.clone().map(|(likeness, _)| likeness).max();
    let alike = measured.filter(|(likeness, _)| Some(*likeness) == most_alike);
    let ratio = super::difference::mean(alike.map(|(_, ratio)| ratio));
    let seconds = modelled * ratio.map_or(1.0, f64::exp);
    Estimate { seconds, is_measured: ratio.is_some() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::sample;

    fn run(scene: &str, factor: &str, level: &str) -> PlannedRun {
        PlannedRun {
            label: scene.into(),
            factor: factor.into(),
            level: level.into(),
            modelled_seconds: Some(100.0),
            ..PlannedRun::default()
        }
    }

    #[test]
    fn the_runs_that_are_most_alike_correct_the_estimate() {
        let done = |scene: &str, factor: &str, level: &str, seconds: f64| Outcome {
            scene: scene.into(),
            wall_seconds: Some(seconds),
            modelled_seconds: Some(100.0),
            ..sample(factor, level, 0, 30.0)
        };
        let seconds = |run: &PlannedRun, done: &[Outcome]| estimate(run, done.iter()).seconds;
        let planned = run("room", "diet", "900");
        let unmeasured = estimate(&planned, [sample("diet", "900", 0, 30.0)].iter());
        assert_eq!(unmeasured, Estimate { seconds: 100.0, is_measured: false });
        // The geometric mean of a half and of twice is 1.
        let mut all = vec![done("cup", "diet", "900", 50.0), done("fox", "diet", "900", 200.0)];
        assert!((seconds(&planned, &all) - 100.0).abs() < 1e-9);
        all.push(done("room", "igs", "300", 300.0));
        assert!((seconds(&planned, &all) - 300.0).abs() < 1e-9);
        all.push(done("room", "igs", "900", 400.0));
        assert!((seconds(&planned, &all) - 400.0).abs() < 1e-9);
        all.push(done("room", "diet", "900", 500.0));
        assert!((seconds(&planned, &all) - 500.0).abs() < 1e-9);
        assert!(estimate(&planned, all.iter()).is_measured);
    }

    #[test]
    fn time_grows_with_steps_rows_and_pixels_and_shrinks_with_threads() {
        let spec = |iterations: u32| {
            let options = Partial::option("iterations", i64::from(iterations));
            options.describe().expect("options")
        };
        let bonsai = Extent {
            host_bytes: 0,
            rows: 200_000,
            pixels: 800.0 * 533.0,
            test_views: 32,
            threads: 2,
            is_on_gpu: false,
        };
        let base = modelled_seconds(&spec(7_000), &bonsai);
        // 1,788 processor-seconds on two threads.
        assert!((base / 894.0 - 1.0).abs() < 0.2, "{base}");
        for (more, factor) in [
            (modelled_seconds(&spec(14_000), &bonsai), 2.0),
            (modelled_seconds(&spec(7_000), &Extent { threads: 1, ..bonsai }), 2.0),
            (modelled_seconds(&spec(7_000), &Extent { rows: 400_000, ..bonsai }), 1.57),
            (modelled_seconds(&spec(7_000), &Extent { pixels: 4e6, ..bonsai }), 4.6),
        ] {
            assert!((more / base / factor - 1.0).abs() < 0.05, "{more} of {base}, not {factor}");
        }
    }
}
