//! Tests of depths and weights: three layers, for which both are known.

use glam::{DMat3, DVec3};

use super::*;
use crate::cpu::InstructionSet;
use crate::{AuxInput, Backend, Inspect, Setup};
use densify_core::gaussians::{Gaussians, logit};
use densify_core::image::Image8;
use densify_policies::policy::{AuxColumn, AuxRequest};

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

#[test]
fn weights_are_divided_at_the_surface() {
    let model = model();
    let target =
        Image8 { width: 37, height: 29, rgb: vec![0; 3 * 37 * 29], alpha: None, mask: None };
    let request = AuxRequest { columns: vec![AuxColumn::WeightSum], ..AuxRequest::default() };
    let mut first = None;
    for mut backend in backends(&model) {
        let observed = backend
            .observe(&AuxInput {
                step: 1,
                view: 0,
                seed: 0,
                camera: &camera(),
                target: &target,
                background: [0.0; 3],
                exposure: None,
                sh_degree: 0,
                request: &request,
            })
            .expect("weights");
        let mut weights = |depth: f32| {
            let surface = vec![depth; 37 * 29];
            backend.weights_in_front(&camera(), &surface).expect("weights")
        };
        let (none, some, all) = (weights(0.0), weights(3.5), weights(9.0));
        for (row, &whole) in observed.columns[0].1.iter().enumerate() {
            assert!(whole > 0.0);
            assert_eq!((none[row].whole, some[row].whole, all[row].whole), (whole, whole, whole));
            assert_eq!((none[row].in_front, all[row].in_front), (0.0, whole), "row {row}");
            assert_eq!(some[row].in_front, if row == 0 { 0.0 } else { whole }, "row {row}");
        }
        // Half of the image has its surface in front of the first layer.
        let left: Vec<f32> = (0..37 * 29).map(|at| if at % 37 < 18 { 0.0 } else { 2.5 }).collect();
        let divided = backend.weights_in_front(&camera(), &left).expect("weights");
        let share = divided[2].in_front / divided[2].whole;
        assert!((share - 19.0 / 37.0).abs() < 0.02, "{share}");
        // Bands, parts and vectors of any width: the same up to rounding.
        let close = |a: f32, b: f32| (a - b).abs() <= 1e-5 * a.abs().max(1e-3);
        let first = first.get_or_insert_with(|| divided.clone());
        for (a, b) in first.iter().zip(&divided) {
            assert!(close(a.in_front, b.in_front) && close(a.whole, b.whole), "{a:?}, {b:?}");
        }
    }
}
