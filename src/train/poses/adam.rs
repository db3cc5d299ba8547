//! Adam for one pose.

use serde::{Deserialize, Serialize};

use densify_core::pose::{PoseGradient, Twist};

/// Values that are refined: translation and rotation.
const VALUES: usize = 6;
/// Decay rate of the first moment.
const BETA1: f64 = 0.9;
/// Decay rate of the second moment: a view has only tens or hundreds of steps.
const BETA2: f64 = 0.99;
/// Far below every gradient that matters.
const EPSILON: f64 = 1e-15;
/// Step size at the end, relative to that at the start.
pub(super) const FADE: f64 = 0.01;
/// How far Adam can move a value, as a multiple of step size and number of steps, if step sizes fall to [`FADE`].
pub(super) const REACH: f64 = 0.215;

/// The state of the optimiser of a pose.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Adam {
    first: [f64; VALUES],
    second: [f64; VALUES],
    /// Number of steps so far.
    age: u32,
}

impl Adam {
    /// The motion of a step with these rates of translations and of rotations; `None` if the gradient is not finite.
    pub(super) fn step(&mut self, gradient: &PoseGradient, rates: [f64; 2]) -> Option<Twist> {
        let gradient = gradient.to_array();
        if gradient.iter().any(|x| !x.is_finite()) {
            return None;
        }
        self.age = self.age.saturating_add(1);
        let age = i32::try_from(self.age).unwrap_or(i32::MAX);
        let [first_scale, second_scale] = [BETA1, BETA2].map(|beta| 1.0 / (1.0 - beta.powi(age)));
        let mut by = Twist::default().to_array();
        for i in 0..VALUES {
            let g = gradient[i];
            self.first[i] = BETA1 * self.first[i] + (1.0 - BETA1) * g;
            self.second[i] = BETA2 * self.second[i] + (1.0 - BETA2) * g * g;
            let size = (self.second[i] * second_scale).sqrt() + EPSILON;
            by[i] = -rates[i / 3] * self.first[i] * first_scale / size;
        }
        Some(Twist::from_array(by))
    }

    /// True if the state is finite.
    pub(super) fn is_finite(&self) -> bool {
        self.first.iter().chain(&self.second).all(|x| x.is_finite())
    }
}
