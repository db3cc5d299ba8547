//! Candidates for new Gaussians: where each error mode finds them, where there must be none, and agreement of backends.

use densify::core::camera::Camera;
use densify::core::gaussians::{Gaussians, logit, rgb_to_dc};
use densify::core::image::Image8;
use densify::core::image::depth::DepthMap;
use densify::render::{AdapterKind, Backend, DepthTarget, DepthTerm, Rendering, StepInput};
use densify::selftest::compare::Table;
use densify::selftest::{Differentiable, Setup, Subject, scenes};
use densify_policies::policy::{Candidate, CandidateRequest, DepthMode, ErrorMode, Needs};
use glam::{DMat3, DVec2, DVec3};

use crate::subject::{devices, make_with, others, repeatable, step_input};

const SIDE: u32 = 96;
const GREY: [f32; 3] = [0.2; 3];
/// Left, top, right and bottom of the patch with a wrong colour [px].
const PATCH: [f64; 4] = [50.0, 50.0, 80.0, 80.0];
/// Left of this column, the model lacks fine structure [px].
const FINE: usize = 30;
/// Half the width of the SSIM window plus one pixel.
const WINDOW: f64 = 6.0;
const MODES: [ErrorMode; 3] = [ErrorMode::Gradient, ErrorMode::L1, ErrorMode::L1Dssim];

fn camera() -> Camera {
    let side = f64::from(SIDE);
    Camera {
        width: SIDE,
        height: SIDE,
        fx: side,
        fy: side,
        cx: 0.5 * side,
        cy: 0.5 * side,
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    }
}

/// Flat Gaussians with smoothly varying grey on the plane z = 2, where x < `until`.
fn plane(until: f64) -> Gaussians {
    let mut model = Gaussians::default();
    for i in 0..64 * 64 {
        let coordinate = |i: i32| -1.26 + 0.04 * f64::from(i);
        let (x, y) = (coordinate(i % 64), coordinate(i / 64));
        if x < until {
            let colour = 0.45 + 0.1 * ((3.0 * x).sin() * (4.0 * y).cos()) as f32;
            let quat = [1.0, 0.0, 0.0, 0.0];
            let position = scenes::world(&camera(), [x, y, 2.0]);
            let scale = [0.024, 0.024, 1e-3];
            scenes::push(&mut model, position, scale, quat, logit(0.9), |_| rgb_to_dc(colour));
        }
    }
    model
}

fn request(error: ErrorMode, min_alpha: f32) -> CandidateRequest {
    CandidateRequest {
        from: 0,
        until: 10,
        rows_per_candidate: 64,
        capacity: 1000,
        error,
        depth: DepthMode::MaxWeight,
        min_alpha,
        spaced: true,
    }
}

fn backend(
    subject: &Subject,
    model: &Gaussians,
    candidates: Option<CandidateRequest>,
) -> Box<dyn Differentiable> {
    let needs = Needs { candidates, ..Needs::default() };
    make_with(subject, model, Setup { needs, ..Setup::default() })
}

fn rendered(model: &Gaussians) -> Rendering {
    let mut native = backend(&Subject::NATIVE, model, None);
    native.render(&camera(), GREY, 0).expect("a small image is rendered")
}

/// Returns the candidates of one training step.
fn candidates(
    subject: &Subject,
    model: &Gaussians,
    target: &Image8,
    request: CandidateRequest,
) -> Vec<Candidate> {
    let mut backend = backend(subject, model, Some(request));
    let camera = camera();
    let input = StepInput { background: GREY, ..step_input(1, &camera, target, 0) };
    backend.train_step(&input).expect("a step");
    backend.candidates().to_vec()
}

fn image(colour: impl Fn(usize) -> f32) -> Image8 {
    let values = 3 * (SIDE * SIDE) as usize;
    let rgb = (0..values).map(|i| (colour(i).clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    Image8 { width: SIDE, height: SIDE, rgb, alpha: None, mask: None }
}

fn pixel(candidate: &Candidate) -> DVec2 {
    camera().project(DVec3::from(candidate.position.map(f64::from))).0
}

#[test]
fn gradient_mode_ignores_a_constant_colour_offset() {
    // The target is the model's own rendering, except for a patch that is brighter by 0.25 and a strip with a
    // ±0.03 checkerboard that the model lacks.
    let model = plane(2.0);
    let rendering = rendered(&model);
    let side = SIDE as usize;
    let target = image(|i| {
        let (x, y) = (i / 3 % side, i / 3 / side);
        let [left, top, right, bottom] = PATCH;
        let (fx, fy) = (x as f64 + 0.5, y as f64 + 0.5);
        let in_patch = (left..right).contains(&fx) && (top..bottom).contains(&fy);
        let checkerboard = if x >= FINE {
            0.0
        } else if (x / 2 + y / 2) % 2 == 0 {
            0.03
        } else {
            -0.03
        };
        rendering.rgb[i] + checkerboard + if in_patch { 0.25 } else { 0.0 }
    });
    let share = |subject: &Subject, mode: ErrorMode| {
        let found = candidates(subject, &model, &target, request(mode, 0.5));
        assert!(found.len() >= 20, "{mode:?}: {} candidates", found.len());
        let [left, top, right, bottom] = PATCH;
        // Only the interior counts, because the patch's border is itself fine structure.
        let within = |c: &&Candidate| {
            let p = pixel(c);
            (left + WINDOW..right - WINDOW).contains(&p.x)
                && (top + WINDOW..bottom - WINDOW).contains(&p.y)
        };
        for candidate in &found {
            let [.., z] = candidate.position;
            assert!((z - 2.0).abs() < 0.01, "{mode:?}: a candidate at depth {z}");
        }
        found.iter().filter(within).count() as f64 / found.len() as f64
    };
    for subject in repeatable() {
        let [gradient, l1, l1_dssim] = MODES.map(|mode| share(&subject, mode));
        assert!(l1 > 0.25, "l1: {l1}");
        assert!(l1_dssim > 0.25, "l1-dssim: {l1_dssim}");
        assert!(gradient < 0.02, "grad: {gradient}");
    }
}

#[test]
fn candidates_require_the_minimum_alpha() {
    // The right half of the model is nearly transparent and the target there is white, so the largest errors are
    // where alpha is low.
    let mut model = plane(2.0);
    for (mean, value) in model.means.iter().zip(&mut model.opacity_logits) {
        if mean[0] > 0.1 {
            *value = logit(0.1);
        }
    }
    let rendering = rendered(&model);
    let side = SIDE as usize;
    let white = image(|i| if i / 3 % side > 52 { 1.0 } else { 0.6 });
    for (subject, mode) in repeatable().iter().flat_map(|s| MODES.map(|mode| (s, mode))) {
        // The number of candidates, and of those where alpha is low.
        let count = |min_alpha| {
            let request = CandidateRequest { spaced: false, ..request(mode, min_alpha) };
            let found = candidates(subject, &model, &white, request);
            let alpha = |c: &Candidate| {
                let p = pixel(c);
                rendering.alpha[p.y as usize * SIDE as usize + p.x as usize]
            };
            (found.len(), found.iter().filter(|c| alpha(c) < 0.5).count())
        };
        let (all, faint) = count(0.5);
        assert!(all > 0, "{mode:?}: no candidate");
        assert_eq!(faint, 0, "{mode:?}: {faint} of {all} where alpha is below 0.5");
        let (all, faint) = count(0.0);
        assert!(
            mode == ErrorMode::Gradient || faint > all / 2,
            "{mode:?}: the minimum alpha excludes nothing"
        );
    }
}

#[test]
fn candidates_lie_at_the_given_depth_where_it_is_known() {
    let model = plane(2.0);
    let camera = camera();
    let side = SIDE as usize;
    // The depth is known in the upper half, where the surface is farther away than in the model.
    let pixels = side * side;
    let inverse: Vec<f32> =
        (0..pixels).map(|i| if i < pixels / 2 { 1.0 / 3.0 } else { 0.0 }).collect();
    let map = DepthMap::quantised((SIDE, SIDE), &inverse, vec![255; pixels]).expect("depth");
    let image = image(|i| if i / 3 % side > 48 { 0.9 } else { 0.4 });
    for subject in repeatable() {
        let request = CandidateRequest { rows_per_candidate: 16, ..request(ErrorMode::L1, 0.5) };
        let needs = Needs { candidates: Some(request), ..Needs::default() };
        let mut backend =
            make_with(&subject, &model, Setup { needs, depth: true, ..Setup::default() });
        let depth = Some(DepthTarget { map: &map, weight: 0.1, term: DepthTerm::Expected });
        let input = StepInput { background: GREY, depth, ..step_input(1, &camera, &image, 0) };
        backend.train_step(&input).expect("a step");
        let found = backend.candidates();
        let is_above = |candidate: &&Candidate| pixel(candidate).y < f64::from(SIDE / 2);
        let above = found.iter().filter(is_above).count();
        assert!(above > 9 && above + 9 < found.len(), "{}: {above}", subject.name());
        for candidate in found {
            let (at, depth) = camera.project(DVec3::from(candidate.position.map(f64::from)));
            let expected = if is_above(&candidate) { 3.0 } else { 2.0 };
            assert!((depth - expected).abs() < 2e-2, "{}: {depth} at {at}", subject.name());
            // The point is on the ray of its pixel's centre.
            assert!((at - at.floor() - 0.5).abs().max_element() < 1e-3, "{at}");
            let size = f64::from(candidate.pixel_size) * f64::from(SIDE);
            assert!((size / depth - 1.0).abs() < 1e-3, "{size} at {depth}");
        }
    }
}

/// A cloud in which some Gaussians saturate their pixels, so that blending stops early.
fn cloud() -> (Gaussians, Camera) {
    let camera = scenes::camera(53, 41, 91);
    let mut model = scenes::cloud(120, 2, &camera, 92);
    for logit in model.opacity_logits.iter_mut().skip(3).step_by(2) {
        *logit = 6.0;
    }
    model.means[..3].fill(scenes::world(&camera, [0.1, 0.2, -3.0]));
    (model, camera)
}

/// Trains for a number of steps and returns the candidates of each.
fn train(backend: &mut dyn Backend, camera: &Camera, steps: u32) -> Vec<Vec<Candidate>> {
    let target = scenes::target(camera);
    let step = |number: u32| {
        let degree = (number / 2).min(2) as u8;
        backend.train_step(&step_input(number, camera, &target, degree)).expect("a small image");
        backend.candidates().to_vec()
    };
    (1..=steps).map(step).collect()
}

/// All numbers of the candidates, flattened.
fn numbers(points: &[Candidate]) -> Vec<f32> {
    let numbers =
        |c: &Candidate| c.position.into_iter().chain(c.colour).chain([c.pixel_size, c.error]);
    points.iter().flat_map(numbers).collect()
}

/// Checks that most points match. Where two pixels have nearly equal errors, either may be chosen.
fn compare_points(table: &mut Table, case: &str, found: &[Candidate], expected: &[Candidate]) {
    if found.is_empty() || found.len().abs_diff(expected.len()) > 1 + expected.len() / 50 {
        table.fail(format!("{case}: {} points, not {}", found.len(), expected.len()));
        return;
    }
    let near = |a: &Candidate, b: &Candidate| {
        numbers(&[*a])
            .iter()
            .zip(numbers(&[*b]))
            .all(|(a, b)| (a - b).abs() < 2e-3 * (1.0 + b.abs()))
    };
    let missing = found.iter().filter(|a| !expected.iter().any(|b| near(a, b))).count();
    table.check(case, "points", missing as f64 / found.len() as f64, 0.04);
}

#[test]
fn candidates_match_the_native_backend() {
    let (model, camera) = cloud();
    let cases = [
        (ErrorMode::Gradient, DepthMode::MaxWeight, false, 3),
        (ErrorMode::L1, DepthMode::Median, true, 3),
        (ErrorMode::L1Dssim, DepthMode::MaxWeight, true, 3),
        (ErrorMode::L1Dssim, DepthMode::Median, true, 50),
        // More candidates than the device list can hold.
        (ErrorMode::Gradient, DepthMode::Median, true, 1),
    ];
    for subject in others().iter().filter(|subject| subject.is_deterministic()) {
        let mut table = Table::new(&format!("candidates, {} against native", subject.name()));
        for (error, depth, spaced, rows_per_candidate) in cases {
            let capacity = 200;
            let request = CandidateRequest {
                rows_per_candidate,
                capacity,
                depth,
                spaced,
                ..request(error, 0.3)
            };
            let [expected, found] = [&Subject::NATIVE, subject]
                .map(|subject| train(&mut *backend(subject, &model, Some(request)), &camera, 2));
            for (step, (found, expected)) in found.iter().zip(&expected).enumerate() {
                let case = format!("{request:?}, {step}");
                compare_points(&mut table, &case, found, expected);
            }
        }
        table.finish();
    }
}

/// With the larger budget, the device has room to list candidate pixels; otherwise the host searches the whole error
/// map. The same pixels are selected.
#[test]
fn device_and_host_select_the_same_pixels() {
    let (model, camera) = cloud();
    for device in devices() {
        for error in MODES {
            let request =
                CandidateRequest { rows_per_candidate: 1, capacity: 500, ..request(error, 0.3) };
            let needs = Needs { candidates: Some(request), ..Needs::default() };
            let [by_host, by_device] = [1, 2].map(|factor| {
                let setup = Setup {
                    budget: (factor * model.len()).into(),
                    needs: needs.clone(),
                    ..Setup::default()
                };
                let mut backend = make_with(&Subject::Gpu(device.clone()), &model, setup);
                numbers(train(&mut *backend, &camera, 3).last().expect("three steps"))
            });
            assert!(by_host.len() > 8 * 30, "{error:?}: {} numbers", by_host.len());
            if device.adapter().kind == AdapterKind::Software {
                assert_eq!(by_device, by_host, "{error:?}");
            }
            // A GPU's square root may differ in its last bit.
            let is_close = |(a, b): (&f32, &f32)| (a - b).abs() <= 2e-7 * b.abs();
            assert_eq!(by_device.len(), by_host.len(), "{error:?}");
            assert!(by_device.iter().zip(&by_host).all(is_close), "{by_device:?} {by_host:?}");
        }
    }
}

/// One Gaussian covers the whole image, so that all pixels have the same error, more than the device can list.
#[test]
fn the_first_of_equal_pixels_is_selected() {
    let (width, height) = (24, 20);
    let camera = Camera {
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
        ..scenes::camera(width, height, 3)
    };
    let mut model = Gaussians::default();
    scenes::push(&mut model, [0.0, 0.0, 2.0], [1e6; 3], [1.0, 0.0, 0.0, 0.0], 0.0, |_| 0.3);
    let black = Image8 { rgb: vec![0; 3 * (width * height) as usize], ..scenes::target(&camera) };
    let request = CandidateRequest {
        rows_per_candidate: 1,
        capacity: 4,
        spaced: false,
        ..request(ErrorMode::L1, 0.3)
    };
    for subject in repeatable() {
        let mut backend = backend(&subject, &model, Some(request));
        let input = StepInput { background: [0.0; 3], ..step_input(1, &camera, &black, 0) };
        backend.train_step(&input).expect("a small image is rendered");
        let [first] = backend.candidates() else {
            panic!("{}: expected one candidate", subject.name())
        };
        let (pixel, _) = camera.project(DVec3::from(first.position.map(f64::from)));
        assert!((pixel - DVec2::splat(0.5)).length() < 1e-2, "{}: {pixel}", subject.name());
    }
}
