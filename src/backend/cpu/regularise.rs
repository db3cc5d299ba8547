//! Terms of the loss and noise that a policy adds for every row, visible or not; noise is added to
//! the means (*3D Gaussian Splatting as Markov Chain Monte Carlo*, Kheradmand et al. 2024).

use densify_policies::policy::{LossTerms, NoiseTerm};
use densify_policies::rng::{PolicyRng, Purpose};
use glam::{Quat, Vec3};
use pulp::Simd;

use super::blocks::plane;
use super::project::lanes;
use super::simd::{V, WIDTH};
use crate::backend::StepInput;
use crate::gaussians::sigmoid;

/// The derivatives of the loss terms, per row.
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

    /// Adds to the gradient of a block: d o/d(logit) = o·(1 − o), d s/d(log s) = s.
    #[inline(always)]
    pub(super) fn add<S: Simd>(&self, s: S, params: &[f32], gradient: &mut [f32]) {
        let one = V::splat(s, 1.0);
        for at in (0..WIDTH).step_by(S::F32_LANES) {
            let mut put = |p: usize, x: V<S>| {
                let to = &mut gradient[p * WIDTH + at..(p + 1) * WIDTH];
                (V::load(s, to) + x).store(to);
            };
            // e^x / (1 + e^x)² for x <= 0, and it is even: nothing cancels at either end.
            let e = (V::zero(s) - lanes(s, params, plane::OPACITY, at).abs()).exp();
            let sum = one + e;
            put(plane::OPACITY, e / (sum * sum) * self.opacity);
            for p in plane::LOG_SCALE..plane::QUAT {
                put(p, lanes(s, params, p, at).exp() * self.scale);
            }
        }
    }
}

/// Shares of the noise below this are left out: 2⁻²⁴. At the published strength (5e5 times a step
/// size of 1.6e-4) that is 5e-6 σ² per step, and after 30,000 steps a way of 1e-3 σ².
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
        Self { term, factor: term.strength * input.rates.mean, rng }
    }

    /// Moves the means of the first `rows` rows of a block, the first of which is `first_row`. Draws
    /// are keyed by row, so that it does not matter who makes them.
    pub(super) fn add(&self, params: &mut [f32], first_row: usize, rows: usize) {
        for lane in 0..rows {
            let get = |p: usize| params[p * WIDTH + lane];
            let share = self.term.share(sigmoid(get(plane::OPACITY)));
            if share < LEAST_SHARE {
                continue;
            }
            let xi = self.rng.normal3((first_row + lane) as u32, Purpose::Noise, 0);
            let [w, x, y, z] = [0, 1, 2, 3].map(|i| get(plane::QUAT + i));
            let turn = Quat::from_xyzw(x, y, z, w).normalize();
            let scale = Vec3::from([0, 1, 2].map(|i| get(plane::LOG_SCALE + i).exp()));
            // Σ·ξ = R·S²·Rᵀ·ξ.
            let step = turn * (scale * scale * (turn.inverse() * Vec3::from(xi)));
            let step = step * (self.factor * share);
            if step.is_finite() {
                for (i, x) in step.to_array().into_iter().enumerate() {
                    params[(plane::MEAN + i) * WIDTH + lane] += x;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use pulp::{Arch, WithSimd};

    use super::*;
    use crate::backend::ParameterStorage;
    use crate::backend::cpu::blocks::Scratch;
    use crate::backend::cpu::parameters::Parameters;
    use crate::gaussians::Gaussians;

    struct Add<'a>(Terms, &'a [f32], &'a mut [f32]);

    impl WithSimd for Add<'_> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) {
            self.0.add(s, self.1, self.2);
        }
    }

    /// Opacities and scales from one end of their range to the other.
    fn model() -> Gaussians {
        let rows = 16;
        let at = |row: usize, low: f32, high: f32| low + (high - low) * row as f32 / 15.0;
        Gaussians {
            sh_degree: 0,
            means: vec![[0.0; 3]; rows],
            log_scales: (0..rows)
                .map(|row| [0.0, 1.0, -1.0].map(|x| x + at(row, -7.0, 1.0)))
                .collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; rows],
            opacity_logits: (0..rows).map(|row| at(row, -9.0, 9.0)).collect(),
            sh: vec![0.0; 3 * rows],
        }
    }

    fn term(model: &Gaussians, terms: LossTerms) -> f64 {
        let opacity = |x: &f32| 1.0 / (1.0 + (-f64::from(*x)).exp());
        let opacities: f64 = model.opacity_logits.iter().map(opacity).sum();
        let scales: f64 = model.log_scales.as_flattened().iter().map(|x| f64::from(*x).exp()).sum();
        let n = model.len() as f64;
        f64::from(terms.opacity) * opacities / n + f64::from(terms.scale) * scales / (3.0 * n)
    }

    #[test]
    fn gradients_are_those_of_the_terms() {
        let terms = LossTerms { opacity: 0.7, scale: 1.3 };
        let model = model();
        let mut parameters = Parameters::zeros(16, 14, ParameterStorage::F32);
        parameters.pack(&model);
        let mut scratch = Scratch::ZERO;
        let mut gradient = vec![1.0; 14 * WIDTH];
        let per_row = Terms::new(terms, 16).unwrap();
        Arch::new().dispatch(Add(
            per_row,
            parameters.view(16).open(0, 14, &mut scratch),
            &mut gradient,
        ));
        let h = 1e-2_f32;
        let central = |change: &dyn Fn(&mut Gaussians, f32)| {
            let [mut low, mut high] = [model.clone(), model.clone()];
            change(&mut low, -h);
            change(&mut high, h);
            (term(&high, terms) - term(&low, terms)) / (2.0 * f64::from(h))
        };
        for row in 0..16 {
            let check = |plane: usize, expected: f64| {
                // It is added to what was there.
                let found = f64::from(gradient[plane * WIDTH + row] - 1.0);
                let error = (found - expected).abs();
                assert!(error < 1e-4 * expected + 2e-7, "{row} {plane}: {found} {expected}");
            };
            check(plane::OPACITY, central(&|m, h| m.opacity_logits[row] += h));
            for axis in 0..3 {
                check(plane::LOG_SCALE + axis, central(&|m, h| m.log_scales[row][axis] += h));
            }
            for rest in [plane::MEAN, plane::QUAT, plane::SH] {
                assert_eq!(gradient[rest * WIDTH + row].to_bits(), 1.0_f32.to_bits());
            }
        }
        assert!(Terms::new(LossTerms::default(), 16).is_none());
    }
}
