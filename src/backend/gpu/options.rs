//! How a GPU backend is set up.

use densify_policies::policy::Needs;

use super::photographs::KeptPhotographs;
use crate::backend::Shortcuts;

/// Largest image side `[px]`; at this size every index of the stages still fits its type.
pub(super) const MAX_SIDE: u32 = 16_384;

/// How to set up a [`GpuBackend`](super::GpuBackend).
#[derive(Debug, Clone)]
pub struct GpuOptions {
    /// Most rows there may ever be, >= 1 and >= the model's.
    pub budget: usize,
    /// Near plane `[scene units]`, > 0: rows nearer to the camera are not rendered.
    pub near: f32,
    /// Most (row, tile) entries held at a time; beyond it the image is processed in bands. `None`:
    /// 16 per row of the budget, or as many as the device can bind. Raised to the budget.
    pub tile_cap: Option<usize>,
    /// Largest image that will be rendered (width, height) `[px]`. Larger ones still work, with more
    /// memory than the ledger says.
    pub largest_image: (u32, u32),
    /// Photographs that stay on the device instead of being uploaded at every step.
    pub photographs: KeptPhotographs,
    /// Signals and candidates to collect.
    pub needs: Needs,
    /// Where to compute less than could be.
    pub shortcuts: Shortcuts,
}

impl GpuOptions {
    /// Options for models of at most `budget` rows.
    #[must_use]
    pub fn new(budget: usize) -> Self {
        Self {
            budget,
            near: 0.01,
            tile_cap: None,
            largest_image: (0, 0),
            photographs: KeptPhotographs::default(),
            needs: Needs::default(),
            shortcuts: Shortcuts::default(),
        }
    }
}
