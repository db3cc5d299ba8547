//! How the native backend is set up.

use densify_policies::policy::Needs;

use super::instructions::InstructionSet;
use crate::backend::{Shortcuts, Storage};

/// How to set up a [`CpuBackend`](super::CpuBackend).
#[derive(Debug, Clone)]
pub struct CpuOptions {
    /// Most rows there may ever be, >= 1 and >= the model's.
    pub budget: usize,
    /// Near plane `[scene units]`, > 0: rows nearer to the camera are not rendered.
    pub near: f32,
    /// Most (row, tile) entries held at a time; beyond it the image is processed in bands.
    /// At least one tile's list must fit, so it is raised to the budget.
    pub tile_cap: usize,
    /// Most gradient records, one per entry, held at a time, >= 1; where the lists hold more entries,
    /// the backward pass takes them in parts.
    pub record_cap: usize,
    /// What the kernels may use of the processor.
    pub instructions: InstructionSet,
    /// Worker threads; `None` takes all cores.
    pub threads: Option<usize>,
    /// Largest image that will be rendered (width, height) `[px]`. Larger ones still work, with more
    /// memory than the ledger says.
    pub largest_image: (u32, u32),
    /// How parameters and moments are stored.
    pub storage: Storage,
    /// Signals and candidates to collect.
    pub needs: Needs,
    /// Where to compute less than could be.
    pub shortcuts: Shortcuts,
}

impl CpuOptions {
    /// Options for models of at most `budget` rows: entries for sixteen tiles per row.
    #[must_use]
    pub fn new(budget: usize) -> Self {
        Self {
            budget,
            near: 0.01,
            tile_cap: budget.saturating_mul(16),
            record_cap: usize::MAX,
            instructions: InstructionSet::default(),
            threads: None,
            largest_image: (0, 0),
            storage: Storage::default(),
            needs: Needs::default(),
            shortcuts: Shortcuts::default(),
        }
    }
}
