//! Tests of the optional parts of the loss; the selftest compares its values and gradients with the
//! reference.

use std::ops::Range;

use super::super::tiles::Grid;
use super::*;

/// The scalars, dL/dpixel and each pixel's part of the loss, of an image with structure against another.
fn run(terms: ImageTerms, mask: bool) -> (LossValue, Vec<f32>, Vec<f32>) {
    let grid = Grid::new(37, 50);
    let mut canvas = vec![TileCanvas::EMPTY; grid.tiles()];
    for (tile, canvas) in canvas.iter_mut().enumerate() {
        for (channel, plane) in canvas.planes.iter_mut().take(3).enumerate() {
            for (i, value) in plane.as_flattened_mut().iter_mut().enumerate() {
                *value = ((tile * 7 + channel * 3 + i * 5) % 19) as f32 / 19.0;
            }
        }
    }
    let pixels = 37 * 50;
    let target = Image8 {
        width: 37,
        height: 50,
        rgb: (0..3 * pixels).map(|i| (i * 11 % 251) as u8).collect(),
        alpha: None,
        mask: mask.then(|| (0..pixels).map(|i| (i * 37 % 256) as u8).collect()),
    };
    let mut gradient = vec![TileGradient { planes: [DARK; 5] }; grid.tiles()];
    let mut buffers = LossBuffers::new();
    let threads = Threads::new(Some(2)).expect("threads");
    let (arch, gradients) = (Arch::new(), &mut gradient);
    let value = buffers.run(&threads, arch, &grid, &canvas, &target, [0.0; 3], gradients, terms);
    let of = |planes: Range<usize>| -> Vec<f32> {
        let planes = gradient.iter().flat_map(|tile| &tile.planes[planes.clone()]);
        planes.flat_map(|plane| plane.as_flattened().iter().copied()).collect()
    };
    (value, of(0..3), of(4..5))
}

#[test]
fn ssim_is_left_out_or_weighs_more() {
    for mask in [false, true] {
        let of = |ssim| run(ImageTerms { ssim, ..ImageTerms::default() }, mask);
        let ((full, once, _), (alone, none, _), (_, thrice, _)) = (of(1.0), of(0.0), of(3.0));
        assert!(alone.ssim.is_nan() && (alone.l1 - full.l1).abs() < 1e-9, "{alone:?} {full:?}");
        assert!((alone.loss() - alone.l1).abs() < 1e-12);
        // With the error of each pixel asked for, the same comes from the other path.
        let with_error =
            run(ImageTerms { ssim: 0.0, error: Some([1.0, 1.0]), by_pixel: false }, mask);
        assert!(with_error.0.ssim.is_nan() && with_error.1 == none);
        // As where each pixel's part is asked for, which always has that of SSIM.
        for (ssim, gradient) in [(1.0, &once), (0.0, &none)] {
            let (value, by, parts) = run(ImageTerms { ssim, error: None, by_pixel: true }, mask);
            assert!((value.l1 - full.l1).abs() < 1e-9 && value.ssim.is_nan() == (ssim == 0.0));
            assert!(by == *gradient);
            let mean = parts.into_iter().map(f64::from).sum::<f64>() / (37.0 * 50.0);
            assert!((mean - full.loss()).abs() < 1e-6, "{mean} {full:?}");
        }
        let (mut most, mut ssim_part) = (0.0_f32, 0.0_f32);
        for ((none, once), thrice) in none.iter().zip(&once).zip(&thrice) {
            let part = once - none;
            ssim_part = ssim_part.max(part.abs());
            most = most.max((thrice - none - 3.0 * part).abs());
        }
        assert!(ssim_part > 1e-6 && most < 1e-3 * ssim_part, "{most} of {ssim_part}");
        assert!(none.iter().any(|g| *g != 0.0));
    }
}
