//! Loss terms and noise that a policy adds to every row, visible or not. Noise moves the means (*3D Gaussian
//! Splatting as Markov Chain Monte Carlo*, Kheradmand et al. 2024).

use densify_policies::policy::{LossTerms, NoiseTerm};
use densify_policies::rng::{PolicyRng, Purpose};
use glam::{Quat, Vec3};
use pulp::Simd;

use super::blocks::plane;
use super::project::lanes;
use super::simd::{V, WIDTH};
use crate::StepInput;
use densify_core::gaussians::sigmoid;

/// The coefficients of the loss terms, divided by the number of values that each term averages.
#[derive(Debug, Clone, Copy)]
pub(super) struct Terms {
    /// Coefficient / rows.
    opacity: f32,
    /// Coefficient / (3 · rows).
    scale: f32,
}

impl Terms {
    pub(super) fn new(terms: LossTerms, rows: usize) -> Option<Self> {
        let n = rows.max(1) as f32;
        let per_row = Self { opacity: terms.opacity / n, scale: terms.scale / (3.0 * n) };
        (!terms.is_none()).then_some(per_row)
    }

    /// Adds the derivatives of the terms to the gradient of a block: d o/d(logit) = o·(1 − o), d s/d(log s) = s.
    #[inline(always)]
    pub(super) fn add<S: Simd>(&self, s: S, params: &[f32], gradient: &mut [f32]) {
        let one = V::splat(s, 1.0);
        for at in (0..WIDTH).step_by(S::F32_LANES) {
            let mut put = |p: usize, x: V<S>| {
                let to = &mut gradient[p * WIDTH + at..(p + 1) * WIDTH];
                (V::load(s, to) + x).store(to);
            };
            // The sigmoid's derivative e^x / (1 + e^x)² is even; it is evaluated for x <= 0, where nothing cancels.
            let e = (V::zero(s) - lanes(s, params, plane::OPACITY, at).abs()).exp();
            let sum = one + e;
            put(plane::OPACITY, e / (sum * sum) * self.opacity);
            for p in plane::LOG_SCALE..plane::QUAT {
                put(p, lanes(s, params, p, at).exp() * self.scale);
            }
        }
    }
}

/// Noise is skipped for rows whose share of it is less than this, 2⁻²⁴. At the published strength (5e5 times a step
/// size of 1.6e-4) this share moves a mean by 5e-6 σ² per step, and by 1e-3 σ² in 30,000 steps.
const LEAST_SHARE: f32 = 5.960_464_5e-8;

/// The noise of one step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Noise {
    term: NoiseTerm,
    /// Strength times step size.
    factor: f32,
    rng: PolicyRng,
}

impl Noise {
    pub(super) fn new(term: NoiseTerm, input: &StepInput<'_>) -> Self {
        let rng = PolicyRng::new(input.seed, input.step);
        Self { term, factor: term.strength * input.rates.noise, rng }
    }

    /// Adds noise to the means of the first `rows` rows of a block, which starts at `first_row`. Draws are keyed by
    /// row, and so independent of threads.
    pub(super) fn add(&self, params: &mut [f32], first_row: usize, rows: usize) {
        for lane in 0..rows {
            let get = |p: usize| params[p * WIDTH + lane];
            let share = self.term.share(sigmoid(get(plane::OPACITY)));
            if share < LEAST_SHARE {
                continue;
            }
            let xi = self.rng.normal3((first_row + lane) as u32, Purpose::Noise, 0);
            let [w, x, y, z] = [0, 1, 2, 3].map(|i| get(plane::QUAT + i));
            let rotation = Quat::from_xyzw(x, y, z, w).normalize();
            let scale = Vec3::from([0, 1, 2].map(|i| get(plane::LOG_SCALE + i).exp()));
            // Σ·ξ = R·S²·Rᵀ·ξ.
            let step = rotation * (scale * scale * (rotation.inverse() * Vec3::from(xi)));
            let step = step * (self.factor * share);
            if step.is_finite() {
                for (i, x) in step.to_array().into_iter().enumerate() {
                    params[(plane::MEAN + i) * WIDTH + lane] += x;
                }
            }
        }
    }
}
