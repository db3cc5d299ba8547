//! Compares auxiliary views with the reference: every column, the pixel map, the loss and surface points.

#![expect(clippy::float_cmp, reason = "colours must match bit for bit")]

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::core::image::Image8;
use densify::core::image::depth::DepthMap;
use densify::render::{AuxInput, AuxOutput, Backend, StepInput};
use densify_policies::policy::{AuxColumn, AuxRequest, Needs, PixelMap, Signal, SignalSet};
use glam::DVec3;

use densify::selftest::compare::{Table, relative_error};
use densify::selftest::reference::blend::each_blended;
use densify::selftest::reference::project::{by_depth, project};
use densify::selftest::reference::{Image, Model, Rules, View, render};
use densify::selftest::{Differentiable, Setup, Subject, scenes};

use crate::subject::{all, make_with, on_each, repeatable, step_input};

const BACKGROUND: [f32; 3] = [0.1, 0.3, 0.2];
/// The tolerance of pixel sums in `signals`: pixels near the alpha threshold may flip.
const TOLERANCE: f64 = 1e-3;

const MARGIN: f32 = 0.1;

struct Scene {
    camera: Camera,
    model: Gaussians,
    target: Image8,
    /// Given depth of some pixels.
    depth: Option<DepthMap>,
}

fn scene() -> Scene {
    let camera = scenes::camera(45, 37, 91);
    let mut model = scenes::cloud(40, 2, &camera, 92);
    // Some Gaussians saturate their pixels, so that blending stops early.
    for logit in model.opacity_logits.iter_mut().skip(3).step_by(2) {
        *logit = 6.0;
    }
    // These lie behind the camera.
    model.means[..3].fill(scenes::world(&camera, [0.1, 0.2, -3.0]));
    let (_, mut target) = scenes::noisy((camera.width, camera.height), 0.0, 93);
    // Half of the pixels have full weight; the others are weighted partly or not at all.
    let weight = |i: usize| if i.is_multiple_of(2) { 255 } else { (i % 3) as u8 * 64 };
    target.mask = Some((0..target.rgb.len() / 3).map(weight).collect());
    // In a third of the pixels the depth is given, from in front of all Gaussians to behind them.
    let pixels = target.rgb.len() / 3;
    let inverse: Vec<f32> = (0..pixels)
        .map(|i| if i % 3 == 0 { 1.0 / (1.0 + (i % 17) as f32 / 2.0) } else { 0.0 })
        .collect();
    let size = (camera.width, camera.height);
    let depth = DepthMap::quantised(size, &inverse, vec![255; pixels]);
    Scene { camera, model, target, depth }
}

fn request(map: PixelMap) -> AuxRequest {
    AuxRequest { map, columns: AuxColumn::ALL.to_vec(), margin: MARGIN, ..AuxRequest::default() }
}

/// Creates a backend. `cap` limits the entries of its tile lists; gradient records are limited to half of `cap`.
fn backend(
    subject: &Subject,
    scene: &Scene,
    request: &AuxRequest,
    cap: usize,
) -> Box<dyn Differentiable> {
    let needs = Needs {
        signals: SignalSet::from([Signal::ScreenGradient, Signal::WeightSum, Signal::WeightMax]),
        aux: Some(request.clone()),
        ..Needs::default()
    };
    let (tile_cap, record_cap) = (Some(cap), cap.div_ceil(2));
    let budget = scene.model.len() + 3;
    let setup = Setup { budget: budget.into(), tile_cap, record_cap, needs, ..Setup::default() };
    make_with(subject, &scene.model, setup)
}

fn observe(
    backend: &mut dyn Backend,
    scene: &Scene,
    request: &AuxRequest,
    view: usize,
) -> AuxOutput {
    let input = AuxInput {
        step: 7,
        view,
        seed: 3,
        camera: &scene.camera,
        target: &scene.target,
        background: BACKGROUND,
        exposure: None,
        vignette: None,
        sh_degree: 2,
        depth: scene.depth.as_ref(),
        request,
    };
    backend.observe(&input).expect("a small image is rendered")
}

/// Observes view 0 on a new backend.
fn observe_on(subject: &Subject, scene: &Scene, request: &AuxRequest, cap: usize) -> AuxOutput {
    observe(&mut *backend(subject, scene, request, cap), scene, request, 0)
}

fn weight(scene: &Scene, pixel: usize) -> f64 {
    scene.target.mask.as_ref().map_or(1.0, |mask| f64::from(mask[pixel]) / 255.0)
}

/// Scales values linearly to 0..1.
fn normalised(values: &[f64]) -> Vec<f64> {
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    values.iter().map(|v| (v - low) / (high - low)).collect()
}

fn pixel_map(scene: &Scene, image: &Image, weights: PixelMap) -> Vec<f64> {
    let (width, height) = (i64::from(scene.camera.width), i64::from(scene.camera.height));
    let rgb = |pixel: usize| [0, 1, 2].map(|c| f64::from(scene.target.rgb[3 * pixel + c]));
    let error: Vec<f64> = (0..(width * height) as usize)
        .map(|p| {
            let truth = rgb(p);
            let sum: f64 = (0..3).map(|c| (image.rgb[3 * p + c] - truth[c] / 255.0).abs()).sum();
            weight(scene, p) * sum / 3.0
        })
        .collect();
    let luma = |x: i64, y: i64| {
        let pixel = y.clamp(0, height - 1) * width + x.clamp(0, width - 1);
        let [r, g, b] = rgb(pixel as usize);
        (0.299 * r + 0.587 * g + 0.114 * b).round()
    };
    let edge: Vec<f64> = (0..width * height)
        .map(|p| {
            let (x, y) = (p % width, p / width);
            let around = |(dx, dy): (i64, i64)| luma(x + dx, y + dy);
            let neighbours = [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)];
            let sum: f64 = neighbours.into_iter().map(around).sum();
            weight(scene, p as usize) * (8.0 * luma(x, y) - sum).clamp(0.0, 255.0)
        })
        .collect();
    let mut error = normalised(&error);
    if weights.threshold > 0.0 {
        let counted = |e: f64| if e > f64::from(weights.threshold) { 1.0 } else { 0.0 };
        error = error.into_iter().map(counted).collect();
        assert!(error.contains(&0.0) && error.contains(&1.0));
    }
    let parts = error.into_iter().zip(normalised(&edge));
    parts.map(|(e, g)| f64::from(weights.error) * e + f64::from(weights.edge) * g).collect()
}

/// The depth of each pixel below which a row is in front of the surface. `blended` calls its argument with pixel, depth
/// and weight of each blended Gaussian, those of a pixel from front to back.
fn fronts(scene: &Scene, blended: impl FnOnce(&mut dyn FnMut(usize, f64, f64))) -> Vec<f64> {
    let depth = scene.depth.as_ref().expect("depth");
    let mut light = vec![1.0; depth.inverse.len()];
    let mut median = vec![0.0; light.len()];
    blended(&mut |pixel, depth, weight| {
        let before = light[pixel];
        light[pixel] -= weight;
        if before >= 0.5 && light[pixel] < 0.5 {
            median[pixel] = depth;
        }
    });
    let surface = |(pixel, median): (usize, f64)| match depth.inverse_depth(pixel) {
        [_, 0.0] => median,
        [inverse, _] => 1.0 / f64::from(inverse),
    };
    let surfaces = median.into_iter().enumerate().map(surface);
    surfaces.map(|surface| surface * (1.0 - f64::from(MARGIN))).collect()
}

#[test]
fn every_column_matches_the_reference() {
    let scene = scene();
    let model = Model::from(&scene.model);
    let view = View { camera: &scene.camera, background: BACKGROUND.map(f64::from), sh_degree: 2 };
    let image = render(&model, view, &Rules::STANDARD);
    let splats = project(&model, view, &Rules::STANDARD);
    let order = by_depth(&splats);
    let maps = [(50.0, 50.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.3)];
    let maps = maps.map(|(error, edge, threshold)| PixelMap { error, edge, threshold });
    // The smallest cap forces several bands.
    for (weights, cap) in maps.into_iter().zip([10_000, 10_000, 1, 10_000]) {
        let pixels = pixel_map(&scene, &image, weights);
        let fronts = fronts(&scene, |each| {
            each_blended(&splats, &order, view, &Rules::STANDARD, |p, row, weight, _| {
                each(p, splats[row].depth, weight);
            });
        });
        let mut sums = vec![[0.0_f64; 6]; scene.model.len()];
        let mut largest = vec![(0.0, None); pixels.len()];
        each_blended(&splats, &order, view, &Rules::STANDARD, |p, row, weight, distance| {
            let in_front = if splats[row].depth < fronts[p] { weight } else { 0.0 };
            for (sum, x) in sums[row].iter_mut().zip([pixels[p], 1.0, weight, distance, in_front]) {
                *sum += x;
            }
            sums[row][5] = sums[row][5].max(weight);
            if weight > largest[p].0 {
                largest[p] = (weight, Some(row));
            }
        });
        // A Gaussian can be on screen without being blended in any pixel.
        let shown: Vec<usize> = (0..sums.len()).filter(|&row| sums[row][1] > 0.0).collect();
        assert!(shown.len() > 20 && shown[0] > 0, "{}", shown.len());
        let is_divided = |row: &usize| sums[*row][4] > 0.0 && sums[*row][4] < sums[*row][2];
        assert!(shown.iter().filter(|row| is_divided(row)).count() > 5);
        let expected = |column: AuxColumn, row: usize| match column {
            AuxColumn::MapSum => sums[row][0],
            AuxColumn::PixelCount => sums[row][1],
            AuxColumn::WeightSum => sums[row][2],
            AuxColumn::DistanceSum => sums[row][3],
            AuxColumn::WeightInFront => sums[row][4],
            AuxColumn::WeightMax => sums[row][5],
            AuxColumn::DominantPixels => {
                largest.iter().filter(|pixel| pixel.1 == Some(row)).count() as f64
            }
            AuxColumn::Depth => splats[row].depth,
            AuxColumn::Radius => {
                let [a, b, c] = splats[row].covariance;
                let mid = 0.5 * (a + c);
                (3.0 * (mid + (mid * mid - (a * c - b * b)).sqrt()).sqrt()).ceil()
            }
        };
        for subject in all() {
            let mut table = Table::new(&format!("auxiliary views, {}", subject.name()));
            let found = observe_on(&subject, &scene, &request(weights), cap);
            assert_eq!(found.columns.len(), AuxColumn::ALL.len());
            let case = format!("{weights:?}, cap {cap}");
            for (column, values) in &found.columns {
                let unseen = &values[..3];
                assert!(
                    unseen.iter().all(|x| x.to_bits() == 0),
                    "{column:?} of unseen Gaussians is not 0"
                );
                let measured: Vec<f32> = shown.iter().map(|&row| values[row]).collect();
                let expected: Vec<f64> = shown.iter().map(|&row| expected(*column, row)).collect();
                let error = relative_error(&measured, &expected);
                table.check(&case, &format!("{column:?}"), error, TOLERANCE);
            }
            table.finish();
        }
    }
}

#[test]
fn output_is_independent_of_threads_and_bands() {
    let scene = scene();
    let points =
        AuxRequest { points: 50, ..request(PixelMap { error: 1.0, edge: 1.0, threshold: 0.0 }) };
    for subject in repeatable() {
        let run = |cap| observe_on(&subject, &scene, &points, cap);
        let expected = run(10_000);
        assert!(run(1) == expected && run(60) == expected, "{}", subject.name());
        let Subject::Native { instructions, .. } = subject else { continue };
        for threads in [1, 3].map(Some) {
            let subject = Subject::Native { instructions, threads };
            assert!(observe_on(&subject, &scene, &points, 10_000) == expected, "{threads:?}");
        }
    }
}

#[test]
fn observing_does_not_affect_training() {
    let scene = scene();
    let request =
        AuxRequest { points: 9, ..request(PixelMap { error: 1.0, edge: 1.0, threshold: 0.0 }) };
    let run = |subject: &Subject, with_views: bool| {
        let mut backend = backend(subject, &scene, &request, 10_000);
        let mut observed = None;
        for step in 1..=4 {
            let input = StepInput {
                background: BACKGROUND,
                ..step_input(step, &scene.camera, &scene.target, 2)
            };
            let output = backend.train_step(&input).expect("a small image is rendered");
            // A step reports the loss before its update, so the loss observed after a step is that of the next one.
            assert!(observed.is_none_or(|loss: f32| (loss - output.loss).abs() < 1e-6));
            observed = with_views.then(|| observe(&mut *backend, &scene, &request, 0).loss);
        }
        let signals = SignalSet::from([Signal::ScreenGradient, Signal::WeightSum]);
        let signals = backend.take_signals(signals).expect("signals can be taken");
        let column = |signal| signals.get(signal).expect("a requested signal").to_vec();
        (
            backend.download().expect("a model"),
            column(Signal::ScreenGradient),
            column(Signal::WeightSum),
        )
    };
    for subject in repeatable() {
        assert!(run(&subject, false) == run(&subject, true), "{}", subject.name());
    }
}

/// One opaque Gaussian in the left part of the image.
fn opaque_on_the_left() -> Scene {
    let camera = scenes::camera(60, 40, 95);
    let local = [(15.0 - camera.cx) / camera.fx * 3.0, (20.0 - camera.cy) / camera.fy * 3.0, 3.0];
    let model = scenes::one_at(&camera, local, [0.2; 3]);
    let n = 3 * (camera.width * camera.height) as usize;
    let rgb = (0..n).map(|i| (i % 251) as u8).collect();
    let target = Image8 { width: 60, height: 40, rgb, alpha: None, mask: None };
    Scene { camera, model, target, depth: None }
}

fn points_lie_on_surfaces_and_follow_alpha_on(subject: &Subject) {
    let scene = opaque_on_the_left();
    let camera = scene.camera;
    let request = AuxRequest { points: 40, ..AuxRequest::default() };
    let mut backend = backend(subject, &scene, &request, 10_000);
    let mut observe_view = |request, view| observe(&mut *backend, &scene, request, view);
    let first = observe_view(&request, 0);
    assert!(first.columns.is_empty() && first.points.len() == 40, "{}", first.points.len());
    let centre = DVec3::from(scene.model.means[0].map(f64::from));
    let mut positions: Vec<[u32; 3]> = Vec::new();
    for point in &first.points {
        let world = DVec3::from(point.position.map(f64::from));
        let local = camera.rotation * world + camera.translation;
        // The depth of a spherical Gaussian is where the ray comes nearest to its centre, hence the right angle.
        let from_centre = world - centre;
        assert!(from_centre.length() < 0.2 * 3.5, "{point:?}");
        let along = (world - camera.centre()).normalize();
        assert!(from_centre.dot(along).abs() < 1e-3, "{point:?}");
        let focal = 0.5 * (camera.fx + camera.fy);
        assert!((f64::from(point.pixel_size) / (local.z / focal) - 1.0).abs() < 1e-4);
        // The point has the colour of its pixel.
        let x = (camera.fx * local.x / local.z + camera.cx).floor() as usize;
        let y = (camera.fy * local.y / local.z + camera.cy).floor() as usize;
        assert_eq!(point.colour, scene.target.composited(x, y, BACKGROUND));
        assert!(point.error > 1.0 / 256.0 && point.error < 1.0);
        positions.push(point.position.map(f32::to_bits));
    }
    positions.sort_unstable();
    positions.dedup();
    assert_eq!(positions.len(), 40, "a pixel was sampled twice");
    // Opaque pixels are sampled more often, so the sample has a higher mean alpha (`error`) than all blended pixels.
    let mean = first.points.iter().map(|p| p.error).sum::<f32>() / 40.0;
    let all = AuxRequest { points: u32::MAX, ..request.clone() };
    let all_points = observe_view(&all, 0).points;
    let mean_of_all = all_points.iter().map(|p| p.error).sum::<f32>() / all_points.len() as f32;
    assert!(
        all_points.len() > 80 && mean > 1.1 * mean_of_all,
        "{} {mean} {mean_of_all}",
        all_points.len()
    );
    // Each view has its own sample, which is reproducible.
    assert!(observe_view(&request, 1).points != first.points);
    assert!(observe_view(&request, 0) == first);
}

#[test]
fn points_lie_on_surfaces_and_follow_alpha() {
    on_each(all(), points_lie_on_surfaces_and_follow_alpha_on);
}
