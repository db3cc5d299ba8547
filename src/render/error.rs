//! Errors of backends, as data. They contain no remedies and no option names: only the layer that shows messages knows
//! these.

use densify_core::memory::Bytes;
use densify_shaders::Accumulation;

/// An error that stops a backend, or keeps it from starting.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    /// A planned buffer cannot be allocated.
    #[error("cannot allocate {bytes} bytes for {what}")]
    OutOfMemory {
        /// What the memory was for.
        what: &'static str,
        /// The size of the allocation `[bytes]`.
        bytes: u64,
    },
    /// The worker threads cannot be started.
    #[error("cannot start the worker threads: {0}")]
    Threads(String),
    /// An image is larger than the backend supports.
    #[error(
        "an image of {width}x{height} px is too large: sides of at most {max} px are supported"
    )]
    ImageTooLarge {
        /// Width `[px]`.
        width: u32,
        /// Height `[px]`.
        height: u32,
        /// The longest side supported `[px]`.
        max: u32,
    },
    /// No adapter can be used; the text lists the adapters found and what they lack.
    #[error("{0}")]
    NoAdapter(String),
    /// An adapter was named for the native backend.
    #[error("an adapter is named, but the native backend uses none")]
    AdapterUnused,
    /// The program was built without the GPU backend.
    #[error("this program was built without the feature `gpu` of the crate densify")]
    WithoutGpu,
    /// The adapter cannot hold the budget.
    #[error("a budget of {budget} rows: {device} holds at most {most} at degree {sh_degree}")]
    TooManyRows {
        /// The budget, in rows.
        budget: usize,
        /// The adapter's name.
        device: String,
        /// The largest budget that the adapter supports, in rows.
        most: u64,
        /// Spherical-harmonic degree of the model.
        sh_degree: u8,
    },
    /// A buffer is larger than the adapter supports.
    #[error(
        "{buffer}: {} in one buffer, but {device} supports at most {}", Bytes(*bytes), Bytes(*most)
    )]
    BufferTooLarge {
        /// The purpose of the buffer.
        buffer: &'static str,
        /// The size of the buffer `[bytes]`.
        bytes: u64,
        /// The adapter's name.
        device: String,
        /// The largest buffer supported `[bytes]`.
        most: u64,
        /// The setting that would make the buffer fit.
        fit: Fit,
    },
    /// The backend does not support the request.
    #[error("this backend does not support {0}")]
    Unsupported(&'static str),
    /// The device was lost, with everything on it.
    #[error("the device {device} was lost ({why})")]
    DeviceLost {
        /// The adapter's name.
        device: String,
        /// The driver's message.
        why: String,
    },
    /// The device has failed, or computes wrongly.
    #[error("the device {device} has failed ({why})")]
    Device {
        /// The adapter's name.
        device: String,
        /// The driver's message, or the wrong result.
        why: String,
    },
    /// The driver ended a loop before it had processed all Gaussians of a tile.
    #[error(
        "the device {device} has failed (its driver ends loops before they have gone through the \
         Gaussians of a tile)"
    )]
    LoopCut {
        /// The adapter's name.
        device: String,
        /// The accumulation in use; [`Accumulation::Slots`] can process the most Gaussians.
        accumulation: Accumulation,
    },
}

/// The setting that decides the size of a buffer, with the largest value that fits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fit {
    /// Maximum number of (row, tile) pairs in memory at a time.
    TileCap(u64),
    /// The budget, in rows.
    Budget(u64),
    /// The size of the images.
    ImageSize,
}
