//! Makes the trial runs that decide the degree of `--sh-degree auto` within `--memory`. They write nothing.

use std::ops::ControlFlow;
use std::time::Instant;

use cpu_time::ProcessTime;

use super::prepare::{start, trainer};
use super::records::Spent;
use crate::failure::Failure;
use crate::host::Host;
use crate::observer::{Silent, check_interrupt};
use crate::resolved::{DECODERS, DegreeTrial, ResolvedRun, TEST_DECODERS, TrialRuns};
use crate::spec::RunSpec;
use densify_core::numbers::grouped;
use densify_data::views::{DatasetViews, ShrunkViews, ViewSource};
use densify_train::evaluate::{Comparison, ViewScore, evaluate};

/// The largest PSNR of a view `[dB]`: that of equal images is infinite.
const MAX_PSNR: f64 = 100.0;

/// The run with its degree decided, and the time that this took; unchanged if trial runs have nothing to decide, are
/// prevented, or fail.
///
/// # Errors
/// When a size cannot be computed, or the observer asks to stop.
pub(super) fn decide<'a>(
    run: ResolvedRun<'a>,
    host: Host<'_>,
) -> Result<(ResolvedRun<'a>, Option<Spent>), Failure> {
    let observer = host.observer;
    let TrialRuns { iterations, highest, rows, specs } = match run.trial_runs()? {
        None => return Ok((run, None)),
        Some(Err(obstacle)) => {
            observer.say(format_args!("{}", obstacle.line(run.size.sh_degree)));
            return Ok((run, None));
        }
        Some(Ok(runs)) => runs,
    };
    let (wall, cpu) = (Instant::now(), ProcessTime::try_now().ok());
    observer.say(format_args!(
        "colour   two trial runs of {} iterations compare degree 0 with degree {highest}",
        grouped(iterations as usize)
    ));
    let [low, high] = &specs;
    // A failure of the first makes the second pointless.
    let measured = measure(&run, low, host).and_then(|low| Ok((low, measure(&run, high, host)?)));
    check_interrupt(observer)?;
    let keeps = |reason: &dyn std::fmt::Display| {
        observer.say(format_args!("note: a trial run failed, so degree {highest} stays: {reason}"));
    };
    let run = match measured {
        Ok(((low, views), (high, _))) if low.is_finite() && high.is_finite() => {
            let trial = DegreeTrial { iterations, highest, views, rows, psnr: [low, high] };
            run.decided_by(trial, host)?
        }
        Ok(_) => {
            keeps(&"not finite");
            run
        }
        Err(failure) => {
            keeps(&failure);
            run
        }
    };
    Ok((run, Some(Spent::since(wall, cpu))))
}

/// Makes one of the trial runs; returns the mean PSNR `[dB]` of the views held out, and their number.
fn measure(run: &ResolvedRun<'_>, spec: &RunSpec, host: Host<'_>) -> Result<(f64, usize), Failure> {
    let trial = run.for_trial(spec, Host { observer: &Silent, ..host })?;
    let (model, training) = start(&trial, &Silent)?;
    let ResolvedRun { case, size, .. } = &trial;
    let dataset = &case.inputs.dataset;
    let views = DatasetViews::new(dataset.train.clone(), size.image_cache, DECODERS);
    views.check_visible(&dataset.root)?;
    let mut trainer = trainer(&trial, model, training, ShrunkViews(views), |_| Ok(()))?;
    let last = spec.schedule.iterations.0;
    for step in 1..=last {
        check_interrupt(host.observer)?;
        let report = trainer.step()?;
        host.observer.trial_step([step, last], report.output.loss, [report.rows, size.rows]);
    }
    let views = ShrunkViews(DatasetViews::new(dataset.test.clone(), 0, TEST_DECODERS));
    let progress = trainer.progress();
    let (fits_exposure, fits_pose) = (progress.exposures.is_some(), progress.poses.is_some());
    let comparison = Comparison { lpips: None, fits_exposure, fits_pose };
    let background = spec.data.background.fixed();
    let backend = trainer.backend();
    let scores = evaluate(backend, &views, background, size.sh_degree, comparison, |_| {
        host.observer.interrupt().map_or(ControlFlow::Continue(()), |_| ControlFlow::Break(()))
    });
    let psnr = |score: &ViewScore| score.fitted.map_or(score.psnr, |fitted| fitted.psnr);
    let sum: f64 = scores?.iter().map(|score| psnr(score).min(MAX_PSNR)).sum();
    Ok((sum / views.count() as f64, views.count()))
}
