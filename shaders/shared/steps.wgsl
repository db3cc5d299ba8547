// The optimiser's constants and moments, for adam.wgsl, apply.wgsl and mask.wgsl, as in src/render/cpu/adam.rs.

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;
// Largest absolute value of opacity logits.
const LOGIT_MAX: f32 = 9.2;
// The bias correction is 1 from this age on.
const MATURE: u32 = 17400u;


// The two moments of a pair of numbers.
struct Moments {
    first: vec2<f32>,
    second: vec2<f32>,
}
