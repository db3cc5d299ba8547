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
use densify_data::dataset::View;
use densify_data::views::{DatasetViews, ShrunkViews, ViewSource};
use densify_train::evaluate::{Comparison, EvaluateError, evaluate};
use densify_train::output::Mean;

/// The run with its degree decided, and the time that this took; unchanged if trial runs have nothing to decide.
///
/// # Errors
/// When a view cannot be read, the device fails, or the observer asks to stop.
pub(super) fn decide<'a>(
    run: ResolvedRun<'a>,
    host: Host<'_>,
) -> Result<(ResolvedRun<'a>, Option<Spent>), Failure> {
    let Some(TrialRuns { iterations, highest, rows, specs }) = run.trial_runs()? else {
        return Ok((run, None));
    };
    let (wall, cpu) = (Instant::now(), ProcessTime::try_now().ok());
    host.observer.say(format_args!(
        "colour   two trial runs of {} iterations compare degree 0 with degree {highest}",
        grouped(iterations as usize)
    ));
    let [low, high] = &specs;
    let ((low, views), (high, _)) = (measure(&run, low, host)?, measure(&run, high, host)?);
    let trial = DegreeTrial { iterations, highest, views, rows, psnr: [low, high] };
    let run = run.decided_by(trial, host)?;
    Ok((run, Some(Spent::since(wall, cpu))))
}

/// Makes one of the trial runs; returns the mean PSNR `[dB]` of the views held out, and their number.
fn measure(run: &ResolvedRun<'_>, spec: &RunSpec, host: Host<'_>) -> Result<(f64, usize), Failure> {
    let trial = run.for_trial(spec, Host { observer: &Silent, ..host })?;
    let (model, training) = start(&trial, &Silent)?;
    let ResolvedRun { case, size, .. } = &trial;
    let of_views = |views: &[View], cache: u64, decoders: usize| {
        ShrunkViews(DatasetViews::new(views.to_vec(), cache, decoders))
    };
    let views = of_views(&case.inputs.dataset.train, size.image_cache, DECODERS);
    let mut trainer = trainer(&trial, model, training, views, |_| Ok(()))?;
    while trainer.steps_done() < spec.schedule.iterations.0 {
        check_interrupt(host.observer)?;
        trainer.step()?;
    }
    let views = of_views(&case.inputs.dataset.test, 0, TEST_DECODERS);
    let progress = trainer.progress();
    let (fits_exposure, fits_pose) = (progress.exposures.is_some(), progress.poses.is_some());
    let comparison = Comparison { lpips: None, fits_exposure, fits_pose };
    let background = spec.data.background.fixed();
    let backend = trainer.backend();
    let scores = evaluate(backend, &views, background, size.sh_degree, comparison, |_| {
        host.observer.interrupt().map_or(ControlFlow::Continue(()), |_| ControlFlow::Break(()))
    });
    if matches!(scores, Err(EvaluateError::Stopped)) {
        check_interrupt(host.observer)?;
    }
    let mean = Mean::over(&scores?);
    Ok((mean.fitted.map_or(mean.psnr, |fitted| fitted.psnr), views.count()))
}
