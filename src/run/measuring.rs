//! Measures the model of a run that is complete against the known surface, as `densify eval` does: in a
//! backend of its own, once that of training is freed.

use std::path::Path;

use super::finished::{Opened, read_model};
use super::session::Session;
use crate::failure::Failure;
use crate::memory::grant;
use densify_core::memory::{Bytes, Ledger, Section, peak_resident, resident};
use densify_core::numbers::percent;
use densify_render::{Device, Setup};
use densify_train::evaluate::Split;
use densify_train::metrics::geometry;
use densify_train::output::{geometry_of, model_path, write_geometry};

/// How the model is measured in a scene whose surface is known.
#[derive(Debug, Clone)]
pub(super) struct Measuring {
    pub(super) device: Device,
    /// Of the backend, for any number of rows.
    pub(super) options: Setup,
    /// Threads that measure.
    pub(super) threads: usize,
    /// What the known surface takes `[bytes]`.
    pub(super) surface: u64,
    /// Number of views held out.
    pub(super) views: usize,
}

impl Measuring {
    /// The ledger of training with what measuring a model of so many rows takes after it.
    pub(super) fn counted(&self, training: &Ledger, rows: usize, sh_degree: u8) -> Ledger {
        let mut counted = training.clone();
        let [host, device] = self.bytes(rows, sh_degree);
        // The device's memory is that of training; what is beyond it would come on top.
        let beyond = device.saturating_sub(training.on_device());
        counted.add_to(Section::After, "measuring geometry", host + beyond);
        counted
    }

    /// What measuring takes beside the process, of the host's memory and of a device's `[bytes]`.
    fn bytes(&self, rows: usize, sh_degree: u8) -> [u64; 2] {
        let options = self.for_rows(rows);
        let promise = self.device.promise(sh_degree, &options, self.threads);
        let geometry = geometry::bytes(rows, sh_degree, options.largest_image, self.views);
        [promise.on_host() + geometry + self.surface, promise.on_device()]
    }

    fn for_rows(&self, rows: usize) -> Setup {
        let rows = rows.max(1);
        // A view rarely has more pairs; it is rendered in bands then, with the same result.
        let pairs = rows.saturating_mul(3).min(self.device.most_pairs(&self.options.needs));
        let cap = self.options.tile_cap.map_or(pairs, |cap| cap.min(pairs));
        Setup {
            budget: rows,
            tile_cap: Some(cap.max(rows)),
            // Nothing is differentiated.
            record_cap: rows,
            ..self.options.clone()
        }
    }
}

/// Writes `geometry.json` for the views held out, where the surface is known and the run's promise has
/// room for measuring. `folder` has the run's model.
///
/// # Errors
/// When the files of the surface are damaged, or as [`geometry::measure`].
pub(super) fn measure(session: Session<'_>, folder: &Path) -> Result<(), Failure> {
    // The rest of the session keeps the folder locked.
    let (run, observer) = (session.run, session.observer);
    let Some(measuring) = run.measuring else { return Ok(()) };
    let iteration = run.trainer.steps_done();
    if geometry_of(folder, iteration)?.is_some() || observer.interrupt().is_some() {
        return Ok(());
    }
    let [host, device] = measuring.bytes(run.trainer.rows(), run.config.sh_degree());
    let process = run.ledger.lines.iter().filter(|line| line.section == Section::Process);
    let host = host + process.map(|line| line.bytes).sum::<u64>();
    drop(run.trainer);
    // The run is not refused for what the system does not grant this; and then it may grant less.
    let granted = grant(measuring.threads).zip(resident());
    let granted = granted.map_or(u64::MAX, |(limit, now)| now.saturating_add(limit.left));
    let promised = run.ledger.total();
    let limits = [(host + device, promised), (device, run.ledger.on_device()), (host, granted)];
    let left_out = |why: std::fmt::Arguments<'_>| {
        let folder = folder.display();
        observer.say(format_args!(
            "note: geometry is not measured: {why}; `densify eval {folder}` measures it"
        ));
        Ok(())
    };
    if let Some(&(needed, room)) = limits.iter().find(|(needed, room)| needed > room) {
        let (needed, room) = (Bytes(needed), Bytes(room));
        return left_out(format_args!("that takes {needed}, and there is room for {room}"));
    }
    let model = read_model(&model_path(folder, iteration), observer)?;
    let model = run.dataset.normalisation.model_from_world(model);
    let backend = measuring.device.backend(&model, &measuring.for_rows(model.len()))?;
    let (dataset, data) = (run.dataset, run.config.spec.data);
    let mut opened = Opened { sh_degree: model.sh_degree, backend, dataset, data };
    drop(model);
    let measured = match opened.geometry(&run.test, &|| observer.interrupt().is_some()) {
        Ok(None) => return Ok(()),
        Ok(Some(measured)) => measured,
        Err(_) if observer.interrupt().is_some() => return left_out(format_args!("stopped")),
        Err(failure) => return Err(failure),
    };
    write_geometry(folder, Split::Test, iteration, &measured)?;
    let peak = peak_resident().map_or_else(String::new, |peak| format!("; peak {}", Bytes(peak)));
    observer.say(format_args!(
        "geometry depth RMSE {}, Chamfer distance {} of the diagonal{peak}",
        percent(measured.depth.rmse),
        percent(measured.centres.chamfer)
    ));
    Ok(())
}
