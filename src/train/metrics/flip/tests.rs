//! Tests of FLIP against the authors' program, and of masks and the division into blocks of rows.

use super::*;

fn target(width: u32, height: u32, value: impl Fn(f64, f64, f64) -> f64) -> Image8 {
    let rgb = (0..3 * width * height).map(|i| {
        let (x, y, c) = (i / 3 % width, i / 3 / width, i % 3);
        (255.0 * value(x.into(), y.into(), c.into())).round() as u8
    });
    Image8 { width, height, rgb: rgb.collect(), alpha: None, mask: None }
}

fn as_render(image: &Image8) -> Vec<f32> {
    image.rgb.iter().map(|&v| f32::from(v) / 255.0).collect()
}

fn waves(phase: f64) -> Image8 {
    target(37, 24, |x, y, c| {
        0.5 + 0.45 * (phase + 0.31 * x * (c + 1.0) + 0.17 * y * (3.0 - c)).sin()
    })
}

fn between(render: &Image8, truth: &Image8) -> f64 {
    flip(&as_render(render), truth, [0.0; 3]).unwrap()
}

/// The expected means were computed by the authors' program, version 1.7, at its default viewing distance.
#[test]
fn values_agree_with_the_authors_program() {
    let black = target(9, 9, |_, _, _| 0.0);
    let dot = target(9, 9, |x, y, _| if (x - 4.0).hypot(y - 4.0) < 0.5 { 1.0 } else { 0.0 });
    let cases = [
        ("waves", between(&waves(0.3), &waves(0.0)), 0.350_385_308),
        ("black and white", between(&target(9, 9, |_, _, _| 1.0), &black), 0.967_388_868),
        ("a dot", between(&dot, &black), 0.176_478_878),
    ];
    for (case, measured, expected) in cases {
        // The program works in float32.
        assert!((measured - expected).abs() < 2e-5, "{case}: {measured} for {expected}");
    }
}

#[test]
fn equal_images_do_not_differ_and_order_does_not_matter() {
    // Not exactly 0: the render is rounded to f32, and FLIP amplifies small distances.
    assert!(between(&waves(0.0), &waves(0.0)) < 1e-4);
    let (forward, reverse) = (between(&waves(0.3), &waves(0.0)), between(&waves(0.0), &waves(0.3)));
    assert!((forward - reverse).abs() < 1e-5, "{forward} and {reverse}");
}

#[test]
fn results_do_not_depend_on_blocks_of_rows() {
    // An image and its transpose have the same error.
    let tall = |phase: f64| target(1, 100, |_, y, c| 0.5 + 0.4 * (phase + 0.2 * y + c).sin());
    let wide = |phase: f64| target(100, 1, |x, _, c| 0.5 + 0.4 * (phase + 0.2 * x + c).sin());
    let (a, b) = (between(&tall(0.5), &tall(0.0)), between(&wide(0.5), &wide(0.0)));
    assert!((a - b).abs() < 1e-12 && a > 0.01, "{a} and {b}");
}

#[test]
fn masks_and_coverage_are_applied_and_nan_is_kept() {
    let mut half = waves(0.0);
    let right = |p: usize| p % 37 >= 18;
    half.mask = Some((0..37 * 24).map(|p| if right(p) { 0 } else { 255 }).collect());
    let mut render = as_render(&half);
    for (i, value) in render.iter_mut().enumerate() {
        if right(i / 3) {
            *value = f32::NAN;
        }
    }
    // Masked pixels neither count nor affect their neighbours.
    assert!(flip(&render, &half, [0.0; 3]).unwrap() < 1e-4);
    render[0] = f32::NAN;
    assert!(flip(&render, &half, [0.0; 3]).unwrap().is_nan());
    half.mask = Some(vec![0; 37 * 24]);
    assert_eq!(flip(&render, &half, [0.0; 3]), Err(MetricError::NothingToCompare));

    let mut covered = target(9, 9, |_, _, _| 1.0);
    covered.alpha = Some(vec![0; 81]);
    let grey = flip(&[0.5; 243], &covered, [0.5; 3]).unwrap();
    assert!(grey.abs() < 1e-12, "{grey}");
    assert!(flip(&[0.5; 11], &covered, [0.5; 3]).is_err());
}
