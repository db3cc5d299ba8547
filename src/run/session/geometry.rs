//! Measures the model of a complete run against the known surface, as `densify eval` does. This takes a backend of its
//! own, which is made after the backend of training has been freed.

use std::path::Path;

use super::Session;
use crate::failure::Failure;
use crate::finished::Opened;
use crate::models::read_model;
use densify_core::memory::{Bytes, Section};
use densify_core::numbers::percent;
use densify_train::evaluate::Split;
use densify_train::output::{geometry_of, model_path, write_geometry};

/// Writes `geometry.json` for the test views, if the surface is known and the promised memory has room for measuring.
/// `folder` contains the run's model.
///
/// # Errors
/// When the files of the surface are damaged, or as [`Opened::geometry`].
pub(super) fn measure(session: Session<'_>, folder: &Path) -> Result<(), Failure> {
    // The fields that stay in `session`, among them `guard`, keep the folder locked until this function returns.
    let (run, observer) = (session.run, session.observer);
    let Some(measurement) = run.geometry_measurement else { return Ok(()) };
    let iteration = run.trainer.steps_done();
    if geometry_of(folder, iteration)?.is_some() || observer.interrupt().is_some() {
        return Ok(());
    }
    let [host, device] = measurement.bytes(run.trainer.rows(), run.config.sh_degree);
    let process = run.ledger.lines.iter().filter(|line| line.section == Section::Process);
    let host = host + process.map(|line| line.bytes).sum::<u64>();
    drop(run.trainer);
    // A complete run does not fail because too little memory is available now: the measurement is skipped.
    let granted = (run.process.grant)(measurement.threads).zip((run.process.resident)());
    let granted = granted.map_or(u64::MAX, |(limit, now)| now.saturating_add(limit.left));
    let promised = run.ledger.total();
    let limits = [(host + device, promised), (device, run.ledger.on_device()), (host, granted)];
    let skip = |why: std::fmt::Arguments<'_>| {
        let folder = folder.display();
        observer.say(format_args!(
            "note: geometry is not measured: {why}; `densify eval {folder}` measures it"
        ));
        Ok(())
    };
    if let Some(&(needed, room)) = limits.iter().find(|(needed, room)| needed > room) {
        let (needed, room) = (Bytes(needed), Bytes(room));
        return skip(format_args!("that takes {needed}, and there is room for {room}"));
    }
    let model = read_model(&model_path(folder, iteration), observer)?;
    let model = run.dataset.normalisation.model_from_world(model);
    let backend = measurement.device.backend(&model, &measurement.for_rows(model.len()))?;
    let (dataset, data) = (run.dataset, run.spec.data);
    let (sh_degree, trained_on_depth) = (model.sh_degree, dataset.depth.is_some());
    let mut opened = Opened { sh_degree, backend, dataset, data, trained_on_depth };
    drop(model);
    let measured = match opened.geometry(&run.test, &|| observer.interrupt().is_some()) {
        Ok(None) => return Ok(()),
        Ok(Some(measured)) => measured,
        Err(_) if observer.interrupt().is_some() => return skip(format_args!("stopped")),
        Err(failure) => return Err(failure),
    };
    write_geometry(folder, Split::Test, iteration, &measured)?;
    let peak =
        (run.process.peak)().map_or_else(String::new, |peak| format!("; peak {}", Bytes(peak)));
    observer.say(format_args!(
        "geometry depth RMSE {}, Chamfer distance {} of the diagonal{peak}",
        percent(measured.depth.rmse),
        percent(measured.centres.chamfer)
    ));
    Ok(())
}
