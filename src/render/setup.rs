//! The settings of a backend.

use densify_core::budget::RowBudget;
use densify_policies::policy::Needs;

use super::cpu::InstructionSet;

/// The settings of a backend of either kind. The default has room for one row.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The largest number of rows, >= 1 and >= the model's. For frozen rows only the memory for rendering is allocated.
    pub budget: RowBudget,
    /// Near plane `[scene units]`, > 0: rows closer to the camera are not rendered.
    pub near: f32,
    /// Maximum number of (row, tile) pairs in memory at a time; an image with more is processed in bands. `None` means
    /// 16 per row, or as many as the device can hold. Raised to the budget if smaller, as one tile's list must fit.
    pub tile_cap: Option<usize>,
    /// Maximum number of gradient records, one per pair, in memory at a time, >= 1; if there are more pairs, the
    /// backward pass processes them in parts (native backend).
    pub record_cap: usize,
    /// Instruction set of the kernels (native backend).
    pub instructions: InstructionSet,
    /// Processor threads; `None` means one per core.
    pub threads: Option<usize>,
    /// The largest image to render (width, height) `[px]`. Larger images work, but need more memory than the
    /// ledger lists.
    pub largest_image: (u32, u32),
    /// Photographs kept in GPU memory instead of being uploaded at every step.
    pub photographs: KeptPhotographs,
    /// Storage formats of parameters and moments.
    pub storage: Storage,
    /// Thresholds of blending.
    pub shortcuts: Shortcuts,
    /// Signals and candidates to collect.
    pub needs: Needs,
    /// True if steps and [observed](crate::Backend::observe) views may have exposures.
    pub exposures: bool,
    /// True if steps may be differentiated with respect to the camera's pose.
    pub poses: bool,
    /// True if steps and [observed](crate::Backend::observe) views may have vignettes.
    pub vignettes: bool,
    /// True if steps may have given depth or a distortion term.
    pub depth: bool,
    /// True if the backend only renders, and so needs no memory for training (native backend).
    pub only_renders: bool,
}

impl Setup {
    /// Default settings for models of at most `budget` rows.
    pub fn new(budget: usize) -> Self {
        Self {
            budget: budget.into(),
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
            poses: false,
            vignettes: false,
            depth: false,
            only_renders: false,
        }
    }

    /// The budget with room for at least one row, so that no buffer is empty.
    pub(crate) fn row_budget(&self) -> RowBudget {
        RowBudget { total: self.budget.total.max(1), ..self.budget }
    }
}

impl Default for Setup {
    fn default() -> Self {
        Self::new(1)
    }
}

/// Photographs kept on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KeptPhotographs {
    /// Number of photographs.
    pub count: usize,
    /// True if any of them has a mask.
    pub with_masks: bool,
}

impl KeptPhotographs {
    /// Bytes reserved per photograph on the device, given the size of the largest: for its pixels and for its mask.
    pub fn bytes((width, height): (u32, u32), with_masks: bool) -> [u64; 2] {
        let pixels = u64::from(width) * u64::from(height);
        [4 * pixels, if with_masks { pixels.next_multiple_of(4) } else { 0 }]
    }
}

/// Storage formats of the model and of its optimiser between steps; arithmetic is always f32.
///
/// Numbers stored in fewer bits are rounded stochastically, without bias: a step of Adam is often
/// smaller than half the distance between two representable numbers, and rounding to nearest would always lose it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Storage {
    /// The model.
    pub parameters: ParameterStorage,
    /// Adam's two moments.
    pub moments: MomentStorage,
}

/// Storage formats of the parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ParameterStorage {
    /// 4 bytes each.
    #[default]
    F32,
    /// 4 bytes each for means, 2 for all others. Colour coefficients are IEEE 754 binary16: 11 significant
    /// bits, up to 65,504. Log-scales and opacity logits (within ±16) and quaternions (within ±2) are bounded and
    /// in fixed point, in steps of 2⁻¹¹ and 2⁻¹⁴.
    F16,
}

/// Storage formats of the optimiser's moments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum MomentStorage {
    /// 4 bytes each.
    #[default]
    F32,
    /// 1 byte each. The second moment, a squared gradient, is a float with one mantissa bit
    /// from 2⁻⁹⁶ (whose root is near Adam's ε) to 1.5·2³⁰. The first is a multiple of the root of the
    /// second, which bounds it.
    Both8,
}

/// Thresholds below which blending is skipped. The defaults are those of the published renderer, which other
/// renderers of Gaussian splats use as well.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shortcuts {
    /// Smallest alpha that is blended, > 0: a splat is skipped in pixels where its alpha is lower.
    pub alpha_min: f32,
    /// A pixel is finished before the first splat that would reduce its transmittance to this value or below; > 0.
    pub transmittance_min: f32,
}

impl Default for Shortcuts {
    fn default() -> Self {
        Self { alpha_min: 1.0 / 255.0, transmittance_min: 1e-4 }
    }
}

impl Shortcuts {
    /// log₂ of 1/[`alpha_min`](Self::alpha_min): a splat covers the pixels where its exponent is at least minus this
    /// value.
    pub(crate) fn log2_reach(&self) -> f32 {
        -f64::from(self.alpha_min).log2() as f32
    }
}
