//! How a backend is set up.

use densify_policies::policy::Needs;

use super::cpu::InstructionSet;

/// How to set up a backend, whichever it is. The default has room for one row.
#[derive(Debug, Clone)]
pub struct Setup {
    /// Most rows there may ever be, >= 1 and >= the model's.
    pub budget: usize,
    /// Rows at the front that are rendered, and never change: no optimiser steps them, and they have memory for
    /// nothing but what rendering needs.
    pub frozen: usize,
    /// Near plane `[scene units]`, > 0: rows nearer to the camera are not rendered.
    pub near: f32,
    /// Most (row, tile) pairs held at a time, beyond which an image is processed in bands; `None`: 16
    /// per row, or as many as the device can hold. At least the budget is taken, as one tile's list
    /// must fit.
    pub tile_cap: Option<usize>,
    /// Most gradient records, one per pair, held at a time, >= 1; where there are more pairs, the
    /// backward pass takes them in parts (native backend).
    pub record_cap: usize,
    /// What the kernels may use of the processor (native backend).
    pub instructions: InstructionSet,
    /// Processor threads; `None`: all cores.
    pub threads: Option<usize>,
    /// Largest image that will be rendered (width, height) `[px]`. Larger ones still work, with more
    /// memory than the ledger says.
    pub largest_image: (u32, u32),
    /// Photographs that stay on a GPU instead of being uploaded at every step.
    pub photographs: KeptPhotographs,
    /// How parameters and moments are stored (native backend).
    pub storage: Storage,
    /// Where to compute less than could be.
    pub shortcuts: Shortcuts,
    /// Signals and candidates to collect.
    pub needs: Needs,
    /// Whether steps and measured views may have exposures of their own.
    pub exposures: bool,
    /// Whether nothing but rendering will be asked for: then there is no room for what only training needs
    /// (native backend).
    pub only_renders: bool,
}

impl Setup {
    /// Options for models of at most `budget` rows.
    #[must_use]
    pub fn new(budget: usize) -> Self {
        Self {
            budget,
            frozen: 0,
            near: 0.01,
            tile_cap: None,
            record_cap: usize::MAX,
            instructions: InstructionSet::default(),
            threads: None,
            largest_image: (0, 0),
            photographs: KeptPhotographs::default(),
            storage: Storage::default(),
            shortcuts: Shortcuts::default(),
            needs: Needs::default(),
            exposures: false,
            only_renders: false,
        }
    }
}

impl Default for Setup {
    fn default() -> Self {
        Self::new(1)
    }
}

/// Photographs that may stay on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KeptPhotographs {
    /// How many.
    pub count: usize,
    /// Whether any of them has a mask.
    pub with_masks: bool,
}

impl KeptPhotographs {
    /// Bytes that one takes on the device, where the largest has this size: its pixels, and its mask.
    #[must_use]
    pub fn bytes((width, height): (u32, u32), with_masks: bool) -> [u64; 2] {
        let pixels = u64::from(width) * u64::from(height);
        [4 * pixels, if with_masks { pixels.next_multiple_of(4) } else { 0 }]
    }
}

/// The formats in which the numbers of a model and of its optimiser are stored between steps; arithmetic
/// is always f32.
///
/// Numbers stored in fewer bits are rounded stochastically, without bias: a step of Adam is often
/// smaller than half the distance between two neighbours and would always be lost if it were rounded
/// to the nearest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Storage {
    /// The model.
    pub parameters: ParameterStorage,
    /// Adam's two moments.
    pub moments: MomentStorage,
}

/// How parameters are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ParameterStorage {
    /// 4 bytes each.
    #[default]
    F32,
    /// Means 4 bytes each, all others 2. Coefficients of colour are IEEE 754 binary16: 11 significant
    /// bits, up to 65,504. Log-scales and opacity logits (within ±16) and quaternions (±2), which are
    /// bounded, are in fixed point, steps of 2⁻¹¹ and 2⁻¹⁴.
    F16,
}

/// How the optimiser's moments are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum MomentStorage {
    /// 4 bytes each.
    #[default]
    F32,
    /// 1 byte each: the second, a squared gradient, as a float of one significant digit after the first,
    /// from 2⁻⁹⁶ (whose root is near Adam's ε) to 1.5·2³⁰; the first as a multiple of the root of the
    /// second, which bounds it.
    Both8,
}

/// Where a backend computes less than it could. The default is the renderer as published, and what
/// every other renderer of Gaussian splats does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shortcuts {
    /// Alpha below this is not blended; above 0.
    pub alpha_min: f32,
    /// A pixel stops before its transmittance reaches this; above 0.
    pub transmittance_min: f32,
}

impl Default for Shortcuts {
    fn default() -> Self {
        Self { alpha_min: 1.0 / 255.0, transmittance_min: 1e-4 }
    }
}

impl Shortcuts {
    /// log₂ of 1/[`alpha_min`](Self::alpha_min): a splat reaches as far as its exponent stays above
    /// minus this.
    #[must_use]
    pub fn log2_reach(&self) -> f32 {
        -f64::from(self.alpha_min).log2() as f32
    }
}
