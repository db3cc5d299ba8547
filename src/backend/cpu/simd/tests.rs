//! Tests of the vector's functions, and of every stage with every instruction set that this machine
//! has: what is a matter of lanes shows only with the right number of them.

use pulp::{Arch, WithSimd};

use super::super::{CpuBackend, CpuOptions, ImageGradient, InstructionSet};
use super::*;
use crate::backend::Rendering;
use crate::verify::scenes;

struct Each<'a>(&'a [f32], fn(f32) -> f64, Function, f64);
#[derive(Clone, Copy)]
enum Function {
    Exp2,
    Exp,
    Log2,
}

impl WithSimd for Each<'_> {
    type Output = f64;
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> f64 {
        let Each(inputs, truth, function, floor) = self;
        let mut worst = 0.0_f64;
        for chunk in inputs.chunks_exact(WIDTH) {
            let mut out = [0.0_f32; WIDTH];
            for at in (0..WIDTH).step_by(S::F32_LANES) {
                let x = V::load(s, &chunk[at..]);
                let y = match function {
                    Function::Exp2 => x.exp2(),
                    Function::Exp => x.exp(),
                    Function::Log2 => x.log2_of_1_to_2(),
                };
                y.store(&mut out[at..]);
            }
            for (&x, &y) in chunk.iter().zip(&out) {
                let t = truth(x);
                worst = worst.max((f64::from(y) - t).abs() / t.abs().max(floor));
            }
        }
        worst
    }
}

fn grid(from: f32, to: f32) -> Vec<f32> {
    let n = 16 * 20_000;
    (0..n).map(|i| from + (to - from) * i as f32 / (n - 1) as f32).collect()
}

struct Sums;

impl WithSimd for Sums {
    type Output = [f32; 4];
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> [f32; 4] {
        let lanes: Vec<f32> = (0..4 * WIDTH).map(|i| (i * i) as f32).collect();
        sums_of_four(each!(k in 4 => V::load(s, &lanes[WIDTH * k..])))
    }
}

#[test]
fn four_vectors_are_summed_together() {
    let arch = Arch::new();
    let lanes = match arch.dispatch(Sums)[0] {
        // Σ i² for i < 16, 8 or 4, by the lanes this machine has.
        1240.0 => 16,
        140.0 => 8,
        _ => 4,
    };
    let sum = |k: usize| (WIDTH * k..WIDTH * k + lanes).map(|i| (i * i) as f32).sum::<f32>();
    assert_eq!(arch.dispatch(Sums), [0, 1, 2, 3].map(sum));
}

#[test]
fn elementary_functions_are_accurate() {
    let arch = Arch::new();
    let exp2 = Each(&grid(-30.0, 0.0), |x| f64::from(x).exp2(), Function::Exp2, 0.0);
    assert!(arch.dispatch(exp2) < 2e-7);
    let exp = Each(&grid(-80.0, 80.0), |x| f64::from(x).exp(), Function::Exp, 0.0);
    assert!(arch.dispatch(exp) < 2e-7);
    let log2 = Each(&grid(1.0, 2.0), |x| f64::from(x).log2(), Function::Log2, 1.0);
    assert!(arch.dispatch(log2) < 3e-7);
}

/// What a view gives: scalars of the loss, the image, dL/dpixel, and gradients of the model.
fn of_view(instructions: InstructionSet, (width, height): (u32, u32)) -> [Vec<f32>; 4] {
    let camera = scenes::camera(width, height, 3);
    let model = scenes::cloud(70, 3, &camera, 4);
    let mut options = CpuOptions::new(model.len());
    (options.instructions, options.threads) = (instructions, Some(1));
    let mut backend = CpuBackend::new(&model, &options).expect("a small model fits");
    let (grey, target) = ([0.3, 0.4, 0.6], scenes::target(&camera));
    let pixels = (width * height) as usize;
    let nothing = || vec![0.0; pixels];
    let differentiate = |backend: &mut CpuBackend, rgb| {
        let upstream = ImageGradient { rgb, alpha: nothing(), depth: nothing() };
        backend.differentiate(&camera, grey, 3, &upstream).expect("a small image is rendered")
    };
    let (rendering, _): (Rendering, _) = differentiate(&mut backend, vec![0.0; 3 * pixels]);
    let (scalars, gradient) = backend.loss(&rendering, &target, grey);
    let (_, g) = differentiate(&mut backend, gradient.clone());
    let geometry = [g.means.as_flattened(), g.log_scales.as_flattened(), g.quats.as_flattened()];
    let parameters = [&*geometry.concat(), &g.opacity_logits, &g.sh].concat();
    [vec![scalars.loss, scalars.l1, scalars.ssim], rendering.rgb, gradient, parameters]
}

#[test]
fn every_instruction_set_computes_the_same() {
    // Widths that leave every number of pixels for the last vector.
    let sizes = (33..49).map(|width| (width, 19)).chain([(1, 1), (5, 40), (16, 16)]);
    for size in sizes {
        let all = InstructionSet::available().into_iter();
        let views: Vec<_> = all.map(|set| (set, of_view(set, size))).collect();
        let (_, plain) = &views[0];
        for (name, other) in &views[1..] {
            let kinds = ["scalars", "image", "dL/dpixel", "gradients"].into_iter();
            for ((kind, a), b) in kinds.zip(plain).zip(other) {
                assert_eq!(a.len(), b.len(), "{kind}");
                let most = |values: &mut dyn Iterator<Item = f32>| values.fold(0.0, f32::max);
                let largest = most(&mut a.iter().map(|x| x.abs()));
                let apart = most(&mut a.iter().zip(b).map(|(a, b)| (a - b).abs()));
                // Rounding differs, and with it which splat is a pixel's last.
                let what = format!("{name}, {size:?}: {kind} {apart} of {largest}");
                assert!(apart <= 2e-3 * largest, "{what}");
            }
        }
    }
}
