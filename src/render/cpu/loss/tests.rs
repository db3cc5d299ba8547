//! Tests of the pixel errors requested from the loss; the selftest compares values and gradients with the reference.

use std::ops::Range;

use super::super::tiles::Grid;
use super::*;

/// The scalars, dL/dpixel and each pixel's error for a rendering and a target with different patterns.
fn run(requests: ErrorRequests, mask: bool) -> (LossValue, Vec<f32>, Vec<f32>) {
    run_in(&mut LossBuffers::new(PixelLoss::Huber), [37, 50], requests, mask)
}

fn run_in(
    buffers: &mut LossBuffers,
    [width, height]: [u32; 2],
    requests: ErrorRequests,
    mask: bool,
) -> (LossValue, Vec<f32>, Vec<f32>) {
    let grid = Grid::new(width, height);
    let mut canvas = vec![TileCanvas::EMPTY; grid.tiles()];
    for (tile, canvas) in canvas.iter_mut().enumerate() {
        for (channel, plane) in canvas.planes.iter_mut().take(3).enumerate() {
            for (i, value) in plane.as_flattened_mut().iter_mut().enumerate() {
                *value = ((tile * 7 + channel * 3 + i * 5) % 19) as f32 / 19.0;
            }
        }
    }
    let pixels = (width * height) as usize;
    let target = Image8 {
        width,
        height,
        rgb: (0..3 * pixels).map(|i| (i * 11 % 251) as u8).collect(),
        alpha: None,
        mask: mask.then(|| (0..pixels).map(|i| (i * 37 % 256) as u8).collect()),
    };
    let mut gradient = vec![TileGradient { planes: [ZERO_PLANE; 5] }; grid.tiles()];
    let threads = Threads::new(Some(2)).expect("threads");
    let (arch, gradients) = (Arch::new(), &mut gradient);
    let value = buffers.run(&threads, arch, &grid, &canvas, &target, [0.0; 3], gradients, requests);
    let values = |planes: Range<usize>| -> Vec<f32> {
        let planes = gradient.iter().flat_map(|tile| &tile.planes[planes.clone()]);
        planes.flat_map(|plane| plane.as_flattened().iter().copied()).collect()
    };
    (value, values(0..3), values(4..5))
}

/// Also, requesting pixel errors changes neither the loss nor its gradient.
#[test]
fn the_mean_of_the_pixel_errors_is_the_loss() {
    for mask in [false, true] {
        let (expected, gradient, _) = run(ErrorRequests::default(), mask);
        assert!(gradient.iter().any(|g| *g != 0.0));
        for for_candidates in [None, Some([1.0, 1.0])] {
            let for_rows = Some(ErrorScore::default());
            let (value, unchanged, errors) = run(ErrorRequests { for_candidates, for_rows }, mask);
            assert_eq!((value, &unchanged), (expected, &gradient));
            let mean = errors.into_iter().map(f64::from).sum::<f64>() / (37.0 * 50.0);
            assert!((mean - expected.loss()).abs() < 1e-6, "{mean} {expected:?}");
        }
    }
}

/// Earlier images of other sizes, and earlier runs with other requested errors, have no effect.
#[test]
fn reused_buffers_give_the_same_results_as_new_ones() {
    let requests =
        ErrorRequests { for_candidates: Some([0.3, 0.7]), for_rows: Some(ErrorScore::default()) };
    let both = |buffers: &mut LossBuffers, size: [u32; 2]| {
        let [width, height] = size.map(|side| side as usize);
        let loss = run_in(buffers, size, requests, false);
        let at = |i| buffers.error_at(i % width, i / width);
        let errors: Vec<f32> = (0..width * height).map(at).collect();
        assert!(errors.iter().any(|error| *error > 0.0));
        (loss, errors)
    };
    let mut buffers = LossBuffers::new(PixelLoss::Huber);
    for size in [[37, 50], [60, 20], [37, 50], [100, 70]] {
        assert_eq!(
            both(&mut buffers, size),
            both(&mut LossBuffers::new(PixelLoss::Huber), size),
            "{size:?}"
        );
        run_in(&mut buffers, [50, 90], ErrorRequests::default(), true);
    }
}
