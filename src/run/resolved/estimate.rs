//! The memory of runs that are only planned here and trained later, such as those of a batch.

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

/// Upper bound of the host memory of a run `[bytes]`.
///
/// # Errors
/// The errors of preparing the run.
pub fn host_bytes(spec: &RunSpec, host: Host<'_>) -> Result<u64, Failure> {
    let run = ResolvedRun::for_new_run(spec, host)?;
    Ok(run.case.ledger_of(&run.size)?.on_host())
}
