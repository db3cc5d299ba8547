//! A part of the program that works alongside a run, such as the page that shows it.

use densify_core::memory::Ledger;
use densify_render::Device;

/// A part of the program that works alongside a run, with memory of its own. It does not affect the run's result.
#[derive(Debug, Clone, Copy)]
pub struct Companion {
    /// Adds the bytes that the companion needs to the ledger of a run of this size.
    pub reserve: fn(&CompanionSize<'_>, &mut Ledger),
    /// Maximum number of the dataset's points that the companion receives.
    pub points: usize,
}

/// The sizes of a run that the memory of a [`Companion`] may depend on.
#[derive(Debug, Clone, Copy)]
pub struct CompanionSize<'a> {
    /// Maximum number of Gaussians.
    pub budget: u64,
    /// The device that trains.
    pub device: &'a Device,
    /// Width and height of the largest image `[px]`.
    pub largest_image: (u32, u32),
    /// Bytes for reading one photograph: decoded images held meanwhile, plus the memory for decoding.
    pub photograph: u64,
    /// Number of views, training and test.
    pub views: usize,
    /// Number of worker threads.
    pub threads: usize,
}
