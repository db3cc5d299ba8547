//! Adam for what is learned of a photograph or a camera. The host computes these steps in a fixed order.

/// Decay rate of the first moment.
const BETA1: f32 = 0.9;
/// Decay rate of the second moment. It must forget the first gradients, because a view has only a few hundred steps, not
/// thousands like a Gaussian, and its gradients fall by orders of magnitude.
const BETA2: f32 = 0.99;
/// Smaller than every relevant gradient, such as that of a hundredth of a photograph's pixels being off by 1/255.
const EPSILON: f32 = 1e-8;

/// A step of values that have been stepped equally often.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Step {
    /// Bias corrections of the moments.
    scales: [f32; 2],
}

impl Step {
    /// Step number `age` of the values, >= 1.
    pub(crate) fn new(age: u32) -> Self {
        let age = i32::try_from(age).unwrap_or(i32::MAX);
        Self { scales: [BETA1, BETA2].map(|beta| 1.0 / (1.0 - beta.powi(age))) }
    }

    /// Updates the moments of a value with its gradient; returns the change of the value for a rate of -1.
    pub(crate) fn take(self, first: &mut f32, second: &mut f32, g: f32) -> f32 {
        let [first_scale, second_scale] = self.scales;
        *first = *first * BETA1 + g * (1.0 - BETA1);
        *second = *second * BETA2 + g * g * (1.0 - BETA2);
        *first * first_scale / ((*second * second_scale).sqrt() + EPSILON)
    }
}
