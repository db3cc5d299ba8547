//! Tests of depths and weights: three layers, for which both are known.

use glam::{DMat3, DVec3};

use super::*;
use crate::cpu::InstructionSet;
use crate::{Backend, Inspect, Setup};
use densify_core::gaussians::{Gaussians, logit};

const OPACITIES: [f32; 3] = [0.4, 0.5, 0.9];
const DEPTHS: [f32; 3] = [2.0, 3.0, 4.0];

/// Three wide, flat rows one behind the other, and small ones around the first. The rows come back to front.
fn model() -> Gaussians {
    let mut model = Gaussians::zeros(43, 0);
    model.quats.fill([1.0, 0.0, 0.0, 0.0]);
    for (row, (opacity, depth)) in OPACITIES.into_iter().zip(DEPTHS).enumerate() {
        model.means[2 - row] = [0.0, 0.0, depth];
        model.log_scales[2 - row] = [5.0, 5.0, -7.0];
        model.opacity_logits[2 - row] = logit(opacity);
    }
    for row in 3..43 {
        let at = row as f32;
        model.means[row] = [0.9 * (7.0 * at).sin(), 0.9 * (5.0 * at).cos(), 1.5 + 0.02 * at];
        model.log_scales[row] = [-3.0, -2.5, -4.0];
        model.opacity_logits[row] = logit(0.3);
    }
    model
}

fn camera() -> Camera {
    Camera::centred((37, 29), (30.0, 30.0), DMat3::IDENTITY, DVec3::ZERO)
}

fn backends(model: &Gaussians) -> impl Iterator<Item = CpuBackend> {
    // Small caps, so that images are rendered in bands, and bands replayed in parts.
    let caps = [(None, usize::MAX), (Some(60), 50)];
    let sets = InstructionSet::available().into_iter();
    let setups = sets.flat_map(move |instructions| {
        caps.map(|(tile_cap, record_cap)| Setup {
            instructions,
            tile_cap,
            record_cap,
            ..Setup::new(43)
        })
    });
    setups.map(|setup| CpuBackend::new(model, &setup).expect("a backend"))
}

#[test]
fn depths_of_three_layers_are_exact() {
    let mut layers = model();
    layers.opacity_logits[3..].fill(logit(1e-4)); // Invisible.
    // The weights o·T of the three layers, of which the second reduces the transmittance to 0.3.
    let weights = [0.4, 0.3, 0.27];
    let alpha: f32 = weights.iter().sum();
    let mean = |power: i32| {
        let terms = weights.iter().zip(DEPTHS).map(|(w, z)| w * z.powi(power));
        terms.sum::<f32>() / alpha
    };
    let spread = (mean(2) - mean(1) * mean(1)).sqrt();
    for mut backend in backends(&layers) {
        let depths = backend.render_depths(&camera()).expect("depths");
        let rendering = backend.render(&camera(), [0.0; 3], 0).expect("a rendering");
        assert_eq!(depths.alpha, rendering.alpha);
        for at in 0..37 * 29 {
            assert!((depths.alpha[at] - alpha).abs() < 1e-3, "{}", depths.alpha[at]);
            assert_eq!(depths.median[at], 3.0, "pixel {at}");
            let expected = rendering.depth[at] / rendering.alpha[at];
            assert_eq!(depths.expected[at], expected, "pixel {at}");
            assert!((expected - mean(1)).abs() < 2e-3, "{expected}");
            assert!((depths.spread[at] - spread).abs() < 2e-3, "{}", depths.spread[at]);
        }
        // Below an alpha of one half there is no median.
        let mut faint = layers.clone();
        faint.opacity_logits[..2].fill(logit(1e-4));
        backend = CpuBackend::new(&faint, &Setup::new(43)).expect("a backend");
        assert!(backend.render_depths(&camera()).expect("depths").median.iter().all(|&z| z == 0.0));
    }
}
