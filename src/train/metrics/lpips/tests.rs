//! Tests of LPIPS against values that ONNX Runtime 1.32.0 computed from the published description
//! (package `lpips` 0.1.4) with the same random weights and images.

use std::collections::HashMap;

use safetensors::tensor::{Dtype, TensorView};

use super::network::Network;
use super::*;

/// Random numbers in `[0, 1)` with 24 bits: SplitMix64 of a counter.
fn unit(seed: u64, count: usize) -> impl Iterator<Item = f64> {
    (0..count as u64).map(move |i| {
        let x = (i + (seed << 32)).wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 40) as f64 / f64::from(1 << 24)
    })
}

/// Shapes and bytes of arrays by name.
type Arrays = HashMap<String, (Vec<usize>, Vec<u8>)>;

/// Random weights with which features keep their magnitude from layer to layer.
fn random(network: Network) -> Arrays {
    let mut arrays = Arrays::new();
    let mut seed = 0;
    let mut add = |name: String, shape: Vec<usize>, range: [f64; 2]| {
        seed += 1;
        let values = unit(seed, shape.iter().product());
        let values = values.map(|x| (range[0] + (range[1] - range[0]) * x) as f32);
        arrays.insert(name, (shape, values.flat_map(f32::to_le_bytes).collect()));
    };
    for (stage, layers) in network.stages().into_iter().enumerate() {
        for &(number, [inputs, outputs], side, ..) in layers {
            let limit = (6.0 / (inputs * side * side) as f64).sqrt();
            let name = format!("net.slice{}.{number}", stage + 1);
            add(format!("{name}.weight"), vec![outputs, inputs, side, side], [-limit, limit]);
            add(format!("{name}.bias"), vec![outputs], [-0.1, 0.1]);
        }
        let channels = layers[layers.len() - 1].1[1];
        add(format!("lin{stage}.model.1.weight"), vec![1, channels, 1, 1], [0.0, 1.0]);
    }
    arrays
}

fn file(arrays: &Arrays) -> Vec<u8> {
    let views = arrays.iter().map(|(name, (shape, bytes))| {
        (name, TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap())
    });
    safetensors::serialize(views, None).unwrap()
}

fn bytes(seed: u64, width: u32, height: u32) -> Vec<u8> {
    unit(seed, 3 * (width * height) as usize).map(|x| (x * 256.0) as u8).collect()
}

/// A noise image, and a blend of three quarters of it with one quarter of other noise.
fn pair(width: u32, height: u32) -> (Vec<f32>, Image8) {
    let rgb = bytes(1000, width, height);
    let changed = rgb.iter().zip(bytes(1001, width, height));
    let changed = changed.map(|(&a, b)| ((u16::from(a) * 3 + u16::from(b)) / 4) as u8);
    let render = changed.map(|value| f32::from(value) / 255.0).collect();
    (render, Image8 { width, height, rgb, alpha: None, mask: None })
}

#[test]
fn values_agree_with_onnx_runtime() {
    // The largest images are processed in several strips of rows.
    let vgg = [
        (40, 37, 0.095_950_650_516_9),
        (16, 16, 0.104_173_281_230_0),
        (33, 150, 0.095_437_031_239_3),
    ];
    let alex = [
        (67, 71, 0.088_858_731_091_0),
        (40, 700, 0.081_339_153_926_8),
        (31, 31, 0.076_915_685_553_1),
    ];
    for (network, sizes) in [(Network::Vgg, vgg), (Network::Alex, alex)] {
        let lpips = Lpips::from_bytes(&file(&random(network))).unwrap();
        assert_eq!(lpips.network(), network);
        for (width, height, expected) in sizes {
            let (render, target) = pair(width, height);
            let distance = lpips.compare(&render, &target, [0.0; 3]).unwrap();
            assert!((distance - expected).abs() < 1e-6, "{network:?} {width}x{height}: {distance}");
        }
    }
}

#[test]
fn masked_pixels_do_not_count_and_equal_images_have_no_distance() {
    let lpips = Lpips::from_bytes(&file(&random(Network::Alex))).unwrap();
    let (mut render, mut target) = pair(40, 36);
    let whole = lpips.compare(&render, &target, [0.0; 3]).unwrap();
    let half = |i: usize| if i % 40 < 20 { 255 } else { 0 };
    target.mask = Some((0..40 * 36).map(half).collect());
    let masked = lpips.compare(&render, &target, [0.0; 3]).unwrap();
    assert!(masked > 0.0 && masked < whole, "{masked} of {whole}");
    // Masked pixels may have any value.
    for (i, pixel) in render.chunks_exact_mut(3).enumerate() {
        if half(i) == 0 {
            pixel.fill(f32::NAN);
        }
    }
    assert_eq!(lpips.compare(&render, &target, [0.0; 3]), Ok(masked));
    target.mask = None;
    assert!(lpips.compare(&render, &target, [0.0; 3]).unwrap().is_nan());
    target.mask = Some(vec![0; 40 * 36]);
    assert_eq!(lpips.compare(&render, &target, [0.0; 3]), Err(MetricError::NothingToCompare));
    // Transparent pixels show the background on both sides.
    target.mask = None;
    target.alpha = Some(vec![0; 40 * 36]);
    let flat: Vec<f32> = [0.25, 0.5, 0.75].repeat(40 * 36);
    let distance = lpips.compare(&flat, &target, [0.25, 0.5, 0.75]).unwrap();
    assert!(distance < 1e-10, "{distance}");
    let (render, small) = pair(30, 40);
    let refused = lpips.compare(&render, &small, [0.0; 3]).unwrap_err().to_string();
    assert!(refused.contains("30x40") && refused.contains("31"), "{refused}");
}

#[test]
fn unsuitable_files_are_refused_with_the_reason() {
    let good = random(Network::Alex);
    let refused = |change: &dyn Fn(&mut Arrays)| {
        let mut arrays = good.clone();
        change(&mut arrays);
        Lpips::from_bytes(&file(&arrays)).unwrap_err()
    };
    let missing = refused(&|arrays| drop(arrays.remove("lin3.model.1.weight")));
    assert_eq!(missing, "`lin3.model.1.weight` is missing");
    let other = refused(&|arrays| drop(arrays.remove("net.slice2.3.weight")));
    assert!(other.contains("neither VGG-16 nor AlexNet"), "{other}");
    let shape = refused(&|arrays| {
        arrays.get_mut("net.slice1.0.bias").unwrap().0 = vec![8, 8];
    });
    assert!(shape.contains("`net.slice1.0.bias` is F32 [8, 8] instead of F32 [64]"), "{shape}");
    let nan = refused(&|arrays| {
        arrays.get_mut("net.slice1.0.bias").unwrap().1[..4]
            .copy_from_slice(&f32::NAN.to_le_bytes());
    });
    assert!(nan.contains("non-finite"), "{nan}");
    let whole = file(&good);
    for length in [0, 7, 100, whole.len() / 2, whole.len() - 1] {
        let cut = Lpips::from_bytes(&whole[..length]).unwrap_err();
        assert!(cut.contains("safetensors"), "{length}: {cut}");
    }
    let path = std::path::Path::new("/nowhere/lpips.safetensors");
    let message = Lpips::open(path).unwrap_err().to_string();
    assert!(message.contains("/nowhere/lpips.safetensors"), "{message}");
}
