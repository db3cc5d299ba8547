// Constants of the optimiser, for adam.wgsl and mask.wgsl; src/backend/cpu/adam.rs.

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;
// Logits of opacities stay within this.
const LOGIT_MAX: f32 = 9.2;
// The age from which there is no bias left to correct.
const MATURE: u32 = 17400u;

