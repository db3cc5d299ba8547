//! The processor threads of this process.

use densify_run::failure::Failure;
use densify_run::finished::Machine;
use densify_run::{DeviceSpec, Observer, Threads};

/// Limits rayon's common pool, which reads datasets and measures models, to the threads that the user grants. Only a
/// command may do so: the pool belongs to the process, not to the library.
pub(super) fn limit(threads: Option<Threads>) {
    if let Some(threads) = threads {
        // It fails only if the pool is in use already; then its size is what it is.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.0 as usize);
        let _ = pool.build_global();
    }
}

/// Opens the device to render on, with as many threads as the user grants.
pub(super) fn open_machine(
    device: &DeviceSpec,
    observer: &dyn Observer,
) -> Result<Machine, Failure> {
    let machine = Machine::open(device, observer)?;
    limit(device.threads);
    Ok(machine)
}
