//! The memory and the extent of runs that are only planned here and trained later, such as those of a batch.

use super::case::Case;
use super::size::Size;
use super::{ModelSize, ResolvedRun};
use crate::failure::Failure;
use crate::host::Host;
use crate::spec::RunSpec;
use densify_core::memory::Ledger;

/// The number of rows and the ledger of a run whose models of `--init` and `--freeze` do not exist yet. Exposures are
/// counted if they may be learned.
///
/// # Errors
/// The errors of preparing the run.
pub fn estimate(
    spec: &RunSpec,
    models: [Option<ModelSize>; 2],
    host: Host<'_>,
) -> Result<(usize, Ledger), Failure> {
    let run = ResolvedRun::for_estimate(spec, models, host)?;
    Ok((run.size.rows, run.case.ledger_of(&run.size)?))
}

/// How much a run is going to hold and to process.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// Upper bound of its host memory `[bytes]`.
    pub host_bytes: u64,
    /// Maximum number of rows.
    pub rows: usize,
    /// Mean number of pixels of a training view.
    pub pixels: f64,
    /// Number of views held out.
    pub test_views: usize,
    /// Number of processor threads.
    pub threads: usize,
    /// True if a GPU trains.
    pub is_on_gpu: bool,
}

/// The extent of a run in another process.
///
/// # Errors
/// The errors of preparing the run.
pub fn extent(spec: &RunSpec, host: Host<'_>) -> Result<Extent, Failure> {
    let mut case = Case::for_new_run(spec, host)?;
    case.leave_out_this_process();
    let size = Size::choose(&case)?.run_size;
    let dataset = &case.inputs.dataset;
    let areas = dataset.train.iter().map(|view| {
        let camera = &view.camera;
        f64::from(camera.width) * f64::from(camera.height)
    });
    Ok(Extent {
        host_bytes: case.ledger_of(&size)?.on_host(),
        rows: size.rows,
        pixels: areas.sum::<f64>() / dataset.train.len().max(1) as f64,
        test_views: dataset.test.len(),
        threads: case.choices.threads,
        is_on_gpu: case.inputs.device.adapter().is_some(),
    })
}
