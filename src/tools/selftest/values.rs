//! Numbers and image sizes at which renderers tend to break, shared by all tests.

use densify_core::gaussians::Gaussians;
use densify_render::LearningRates;

/// Numbers that are not finite. A row that holds one is not rendered, and the audit reports it.
pub const POISON: [f32; 4] = [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY];

/// Extreme finite numbers: zeros, subnormal numbers, and numbers whose square overflows.
pub(crate) const EXTREMES: [f32; 15] = [
    0.0,
    -0.0,
    1e-45,
    -1e-45,
    1e-38,
    1e-30,
    1e-20,
    1e4,
    -1e4,
    1e19,
    -1e19,
    1e20,
    -1e38,
    f32::MAX,
    f32::MIN,
];

/// Image sizes, width and height `[px]`: around the size of a tile (16 px), narrower than the SSIM window
/// (11 px), and the longest side supported.
pub const SIZES: [(u32, u32); 11] = [
    (1, 1),
    (1, 17),
    (17, 1),
    (5, 4),
    (11, 11),
    (15, 15),
    (16, 16),
    (17, 17),
    (33, 47),
    (257, 17),
    (1, 16_384),
];

/// Image sizes `[px]` of 65,536 and 66,049 tiles: more than 65,535, the number of workgroups along one axis that every
/// WebGPU device supports.
pub(crate) const LARGE_SIZES: [(u32, u32); 2] = [(4096, 4096), (4097, 4097)];

/// Number of parameters of a row of degree 3.
pub const SLOTS: usize = 59;

/// Parameter `slot` of a row of degree 3, in the order mean, log-scale, quaternion, opacity logit, coefficients.
///
/// # Panics
/// When the model has no such row, or another degree.
pub fn slot_mut(model: &mut Gaussians, row: usize, slot: usize) -> &mut f32 {
    match slot {
        0..3 => &mut model.means[row][slot],
        3..6 => &mut model.log_scales[row][slot - 3],
        6..10 => &mut model.quats[row][slot - 6],
        10 => &mut model.opacity_logits[row],
        _ => &mut model.sh[row * 48 + slot - 11],
    }
}

/// The attribute that parameter `slot` belongs to.
pub(crate) fn slot_name(slot: usize) -> &'static str {
    match slot {
        0..3 => "a mean",
        3..6 => "a log-scale",
        6..10 => "a quaternion",
        10 => "an opacity logit",
        11..14 => "band 0 of the colour",
        _ => "bands 1 to 3 of the colour",
    }
}

/// The model without row `row`.
pub fn remove(model: &Gaussians, row: usize) -> Gaussians {
    model.gather(&(0..model.len()).filter(|&other| other != row).collect::<Vec<_>>())
}

/// Learning rates of tests that train: those of the schedule, with means in scene units.
pub const RATES: LearningRates = LearningRates {
    mean: 1e-3,
    noise: 2e-3,
    log_scale: 5e-3,
    quat: 1e-3,
    opacity: 0.025,
    sh_dc: 2.5e-3,
    sh_rest: 1.25e-4,
};
