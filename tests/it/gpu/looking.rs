//! What policies look at beside signals: auxiliary views and candidates, against the native backend.

use densify::backend::cpu::{CpuBackend, CpuOptions};
use densify::backend::gpu::{GpuBackend, GpuOptions};
use densify::backend::{AuxInput, AuxOutput, Backend, StepInput};
use densify::camera::Camera;
use densify::dataset::images::Image8;
use densify::gaussians::Gaussians;
use densify_policies::policy::{
    AuxColumn, AuxRequest, Cadence, Candidate, CandidateRequest, DepthMode, ErrorMode, Needs,
    PixelMap,
};

use super::training::step;
use super::{backend_for, name, subjects, ways};
use crate::subject::RATES;
use densify::verify::compare::{Table, relative_error};
use densify::verify::scenes;

const BACKGROUND: [f32; 3] = [0.1, 0.3, 0.2];

fn scene() -> (Gaussians, Camera, Image8) {
    let camera = scenes::camera(53, 41, 91);
    let mut model = scenes::cloud(120, 2, &camera, 92);
    // Some of them end the light of their pixels.
    for logit in model.opacity_logits.iter_mut().skip(3).step_by(2) {
        *logit = 6.0;
    }
    model.means[..3].fill(scenes::world(&camera, [0.1, 0.2, -3.0]));
    let n = camera.width * camera.height;
    let target = Image8 {
        width: camera.width,
        height: camera.height,
        rgb: (0..3 * n).map(|i| (i * 29 % 256) as u8).collect(),
        alpha: None,
        mask: Some((0..n).map(|i| if i % 2 == 0 { 255 } else { (i % 3) as u8 * 64 }).collect()),
    };
    (model, camera, target)
}

/// Places and colours, flattened.
fn places(points: &[Candidate]) -> Vec<f32> {
    let of = |c: &Candidate| c.position.into_iter().chain(c.colour).chain([c.pixel_size, c.error]);
    points.iter().flat_map(of).collect()
}

/// Most of the points are the same; which pixels are taken may differ where two are nearly equal.
fn compare_points(table: &mut Table, what: &str, found: &[Candidate], expected: &[Candidate]) {
    if found.is_empty() || found.len().abs_diff(expected.len()) > 1 + expected.len() / 50 {
        table.fail(format!("{what}: {} points, not {}", found.len(), expected.len()));
        return;
    }
    let near = |a: &Candidate, b: &Candidate| {
        places(&[*a]).iter().zip(places(&[*b])).all(|(a, b)| (a - b).abs() < 2e-3 * (1.0 + b.abs()))
    };
    let missing = found.iter().filter(|a| !expected.iter().any(|b| near(a, b))).count();
    table.check(what, "points", missing as f64 / found.len() as f64, 0.04);
}

#[test]
fn auxiliary_views_show_what_they_show_natively() {
    let (model, camera, target) = scene();
    let request = AuxRequest {
        map: PixelMap { error: 0.7, edge: 0.4 },
        columns: AuxColumn::ALL.to_vec(),
        points: 80,
    };
    let needs = Needs { aux: Some(request.clone()), ..Needs::default() };
    let look = |backend: &mut dyn Backend| -> AuxOutput {
        let input = AuxInput {
            step: 3,
            view: 2,
            seed: 8,
            camera: &camera,
            target: &target,
            background: BACKGROUND,
            sh_degree: 2,
            request: &request,
        };
        backend.observe(&input).expect("a view is measured")
    };
    let options = CpuOptions { needs: needs.clone(), ..CpuOptions::new(model.len()) };
    let mut cpu = CpuBackend::new(&model, &options).expect("a small model fits");
    let expected = look(&mut cpu);
    for device in ways() {
        let mut table = Table::new(&format!("auxiliary views, {} against CPU", name(device)));
        for cap in [None, Some(1)] {
            let options =
                GpuOptions { needs: needs.clone(), tile_cap: cap, ..GpuOptions::new(model.len()) };
            let mut gpu = GpuBackend::new(&model, &options, device).expect("a small model fits");
            let found = look(&mut gpu);
            let name = format!("cap {cap:?}");
            table.check(&name, "loss", f64::from((found.loss - expected.loss).abs()), 1e-5);
            for ((column, found), (_, expected)) in found.columns.iter().zip(&expected.columns) {
                let wide: Vec<f64> = expected.iter().copied().map(f64::from).collect();
                let error = relative_error(found, &wide);
                table.check(&name, &format!("{column:?}"), error, 3e-3);
            }
            compare_points(&mut table, &name, &found.points, &expected.points);
        }
        table.finish();
    }
}

#[test]
fn candidates_are_those_of_the_native_backend() {
    let (model, camera, _) = scene();
    for device in subjects() {
        let mut table = Table::new("candidates, GPU against CPU");
        for (error, depth, spaced, rows_per_candidate) in [
            (ErrorMode::Gradient, DepthMode::MaxWeight, false, 3),
            (ErrorMode::L1, DepthMode::Median, true, 3),
            (ErrorMode::L1Dssim, DepthMode::MaxWeight, true, 3),
            (ErrorMode::L1Dssim, DepthMode::Median, true, 50),
            // More than the device has room to list.
            (ErrorMode::Gradient, DepthMode::Median, true, 1),
        ] {
            let request = CandidateRequest {
                from: 0,
                until: 10,
                rows_per_candidate,
                capacity: 200,
                error,
                depth,
                min_alpha: 0.3,
                spaced,
            };
            let needs = Needs { candidates: Some(request), ..Needs::default() };
            let options = CpuOptions { needs: needs.clone(), ..CpuOptions::new(model.len()) };
            let mut cpu = CpuBackend::new(&model, &options).expect("a small model fits");
            let mut gpu = backend_for(&model, device, &needs);
            let both: [&mut dyn Backend; 2] = [&mut cpu, &mut gpu];
            let [expected, found] = both.map(|backend| {
                step(backend, &camera, 1, Cadence::default());
                let first = backend.candidates().to_vec();
                step(backend, &camera, 2, Cadence::default());
                (first, backend.candidates().to_vec())
            });
            let what =
                format!("{error:?}, {depth:?}, spaced {spaced}, of {rows_per_candidate} rows");
            compare_points(&mut table, &what, &found.0, &expected.0);
            compare_points(&mut table, &format!("{what}, two steps"), &found.1, &expected.1);
        }
        table.finish();
    }
}

/// What the device lists is what the host finds in all errors: with a larger budget there is room for
/// the list.
#[test]
fn the_device_finds_the_pixels_that_the_host_would() {
    let (model, camera, _) = scene();
    for device in subjects() {
        for error in [ErrorMode::Gradient, ErrorMode::L1, ErrorMode::L1Dssim] {
            let request = CandidateRequest {
                from: 0,
                until: 10,
                rows_per_candidate: 1,
                capacity: 500,
                error,
                depth: DepthMode::MaxWeight,
                min_alpha: 0.3,
                spaced: true,
            };
            let needs = Needs { candidates: Some(request), ..Needs::default() };
            let [by_host, by_device] = [1, 2].map(|times| {
                let options =
                    GpuOptions { needs: needs.clone(), ..GpuOptions::new(times * model.len()) };
                let mut gpu = GpuBackend::new(&model, &options, device).expect("it fits");
                for number in 1..4 {
                    step(&mut gpu, &camera, number, Cadence::default());
                }
                places(gpu.candidates())
            });
            assert!(by_host.len() > 8 * 30, "{error:?}: {} numbers", by_host.len());
            assert_eq!(by_device, by_host, "{error:?}");
        }
    }
}

/// One row before everything, so that all pixels are equally wrong: more than the device can list.
#[test]
fn where_all_pixels_are_equally_wrong_the_first_is_taken() {
    let camera = Camera {
        rotation: glam::DMat3::IDENTITY,
        translation: glam::DVec3::ZERO,
        ..scenes::camera(24, 20, 3)
    };
    let mut model = Gaussians::default();
    scenes::push(&mut model, [0.0, 0.0, 2.0], [1e6; 3], [1.0, 0.0, 0.0, 0.0], 0.0, |_| 0.3);
    let black = Image8 { rgb: vec![0; 3 * 24 * 20], ..scenes::target(&camera) };
    let request = CandidateRequest {
        from: 0,
        until: 10,
        rows_per_candidate: 1,
        capacity: 4,
        error: ErrorMode::L1,
        depth: DepthMode::MaxWeight,
        min_alpha: 0.3,
        spaced: false,
    };
    let needs = Needs { candidates: Some(request), ..Needs::default() };
    let options = CpuOptions { needs: needs.clone(), ..CpuOptions::new(1) };
    for device in subjects() {
        let mut cpu = CpuBackend::new(&model, &options).expect("a small model fits");
        let mut gpu = backend_for(&model, device, &needs);
        let both: [&mut dyn Backend; 2] = [&mut cpu, &mut gpu];
        let [expected, found] = both.map(|backend| {
            let input = StepInput {
                step: 1,
                view: 0,
                camera: &camera,
                target: &black,
                background: [0.0; 3],
                sh_degree: 0,
                rates: RATES,
                ssim_weight: 1.0,
                cadence: Cadence::default(),
                seed: 1,
            };
            backend.train_step(&input).expect("a small image is rendered");
            backend.candidates().to_vec()
        });
        let mut table = Table::new("a candidate among equals, GPU against CPU");
        compare_points(&mut table, "the first pixel", &found, &expected);
        table.finish();
    }
}
