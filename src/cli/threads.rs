//! The processor threads of this process.

use densify_run::failure::Failure;
use densify_run::finished::Machine;
use densify_run::{DeviceSpec, Observer, Threads};

/// Limits rayon's global pool, which reads datasets and measures models, to the number of threads from the command
/// line. Only a command may limit the pool: it belongs to the process, not to the library.
pub(super) fn limit(threads: Option<Threads>) {
    if let Some(threads) = threads {
        // Fails only if the pool is already in use; it then keeps its size.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.0 as usize);
        let _ = pool.build_global();
    }
}

/// Opens the device to render on, and limits the threads.
pub(super) fn open_machine(
    device: &DeviceSpec,
    observer: &dyn Observer,
) -> Result<Machine, Failure> {
    let machine = Machine::open(device, observer)?;
    limit(device.threads);
    Ok(machine)
}
