//! The numbers and sizes at which renderers break, for every test that needs some: one table of
//! numbers that are none, one of numbers at the ends of `f32`, one of awkward image sizes.

use densify_core::gaussians::Gaussians;
use densify_render::LearningRates;

/// Numbers that are none. What holds one is drawn nowhere and is found by the audit.
pub const POISON: [f32; 4] = [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY];

/// Finite numbers that no row should hold: zeros, subnormal ones, and those whose square is none.
pub const EXTREMES: [f32; 15] = [
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

/// Width and height `[px]` of images that are no multiple of a tile (16 px), smaller than one, as wide
/// as one and a pixel more or less, narrower than the window of SSIM (11 px), and as long as can be.
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

/// Width and height `[px]` at which the number of tiles passes 65,535, the most workgroups along one
/// axis that WebGPU promises: 65,536 tiles, and 66,049.
pub const LARGE_SIZES: [(u32, u32); 2] = [(4096, 4096), (4097, 4097)];

/// Numbers of a row of degree 3.
pub const SLOTS: usize = 59;

/// Number `slot` of a row of degree 3: mean, log-scale, quaternion, opacity logit, coefficients.
///
/// # Panics
/// When the model has no such row, or another degree.
pub fn slot_of(model: &mut Gaussians, row: usize, slot: usize) -> &mut f32 {
    match slot {
        0..3 => &mut model.means[row][slot],
        3..6 => &mut model.log_scales[row][slot - 3],
        6..10 => &mut model.quats[row][slot - 6],
        10 => &mut model.opacity_logits[row],
        _ => &mut model.sh[row * 48 + slot - 11],
    }
}

/// What slot `slot` belongs to.
#[must_use]
pub fn name_of_slot(slot: usize) -> &'static str {
    match slot {
        0..3 => "a mean",
        3..6 => "a log-scale",
        6..10 => "a quaternion",
        10 => "an opacity logit",
        11..14 => "band 0 of the colour",
        _ => "bands 1 to 3 of the colour",
    }
}

/// What `values`, of which each row has `per_row`, are without row `row`.
#[must_use]
pub fn without<T: Clone>(values: &[T], row: usize, per_row: usize) -> Vec<T> {
    let (before, rest) = (&values[..row * per_row], &values[(row + 1) * per_row..]);
    [before, rest].concat()
}

/// The model without row `row`.
#[must_use]
pub fn remove(model: &Gaussians, row: usize) -> Gaussians {
    let per_row = model.sh.len() / model.len();
    Gaussians {
        sh_degree: model.sh_degree,
        means: without(&model.means, row, 1),
        log_scales: without(&model.log_scales, row, 1),
        quats: without(&model.quats, row, 1),
        opacity_logits: without(&model.opacity_logits, row, 1),
        sh: without(&model.sh, row, per_row),
    }
}

/// Step sizes of tests that train: those of the schedule, with means in scene units.
pub const RATES: LearningRates = LearningRates {
    mean: 1e-3,
    noise: 2e-3,
    log_scale: 5e-3,
    quat: 1e-3,
    opacity: 0.025,
    sh_dc: 2.5e-3,
    sh_rest: 1.25e-4,
};
