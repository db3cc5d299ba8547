//! Candidates of the backend on a plane: where they are found, by which error mode, and where never.

use densify::backend::cpu::{CpuBackend, CpuOptions};
use densify::backend::{Backend, LearningRates, Rendering, StepInput};
use densify::camera::Camera;
use densify::dataset::images::Image8;
use densify::gaussians::{Gaussians, logit, rgb_to_dc};
use densify_policies::policy::{
    Cadence, Candidate, CandidateRequest, DepthMode, ErrorMode, Needs, SceneInfo,
};
use densify_policies::registry::find;
use glam::{DMat3, DVec2, DVec3};

use densify::verify::scenes;

const SIDE: u32 = 96;
const GREY: [f32; 3] = [0.2; 3];
/// Left, top, right and bottom of the patch whose colour is off [px].
const PATCH: [f64; 4] = [50.0, 50.0, 80.0, 80.0];
/// Left of this column, fine structure is missing [px].
const FINE: usize = 30;
/// Half the width of SSIM's window, and a pixel.
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

/// Flat rows on the plane z = 2 for x < `until`, softly mottled.
fn plane(until: f64) -> Gaussians {
    let mut model = Gaussians::default();
    for i in 0..64 * 64 {
        let at = |i: i32| -1.26 + 0.04 * f64::from(i);
        let (x, y) = (at(i % 64), at(i / 64));
        if x < until {
            let colour = 0.45 + 0.1 * ((3.0 * x).sin() * (4.0 * y).cos()) as f32;
            let quat = [1.0, 0.0, 0.0, 0.0];
            let place = scenes::world(&camera(), [x, y, 2.0]);
            let scale = [0.024, 0.024, 1e-3];
            scenes::push(&mut model, place, scale, quat, logit(0.9), |_| rgb_to_dc(colour));
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

fn backend(model: &Gaussians, candidates: Option<CandidateRequest>) -> CpuBackend {
    let needs = Needs { candidates, ..Needs::default() };
    let options = CpuOptions { needs, ..CpuOptions::new(model.len()) };
    CpuBackend::new(model, &options).expect("a small model fits")
}

fn rendered(model: &Gaussians) -> Rendering {
    backend(model, None).render(&camera(), GREY, 0).expect("a small image is rendered")
}

/// The candidates of one step with this target.
fn candidates(model: &Gaussians, target: &Image8, request: CandidateRequest) -> Vec<Candidate> {
    let mut backend = backend(model, Some(request));
    let rates = LearningRates {
        mean: 0.0,
        log_scale: 0.0,
        quat: 0.0,
        opacity: 0.0,
        sh_dc: 0.0,
        sh_rest: 0.0,
    };
    let input = StepInput {
        step: 1,
        view: 0,
        camera: &camera(),
        target,
        background: GREY,
        sh_degree: 0,
        rates,
        cadence: Cadence::default(),
        seed: 0,
        ssim_weight: 1.0,
    };
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
fn a_constant_offset_is_an_error_but_no_structure() {
    // The picture is the model's own, but for a patch that is brighter by 0.25 throughout, and a
    // strip with a weave of ±0.03 that the model lacks.
    let model = plane(2.0);
    let own = rendered(&model);
    let side = SIDE as usize;
    let target = image(|i| {
        let (x, y) = (i / 3 % side, i / 3 / side);
        let [left, top, right, bottom] = PATCH;
        let (fx, fy) = (x as f64 + 0.5, y as f64 + 0.5);
        let in_patch = (left..right).contains(&fx) && (top..bottom).contains(&fy);
        let weave = if x >= FINE {
            0.0
        } else if (x / 2 + y / 2) % 2 == 0 {
            0.03
        } else {
            -0.03
        };
        own.rgb[i] + weave + if in_patch { 0.25 } else { 0.0 }
    });
    let share = |mode: ErrorMode| {
        let found = candidates(&model, &target, request(mode, 0.5));
        assert!(found.len() >= 20, "{mode:?}: {} candidates", found.len());
        let [left, top, right, bottom] = PATCH;
        // Well within: at the patch's border there is structure.
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
    let [gradient, l1, l1_dssim] = MODES.map(share);
    assert!(l1 > 0.25, "l1: {l1}");
    assert!(l1_dssim > 0.25, "l1-dssim: {l1_dssim}");
    assert!(gradient < 0.02, "grad: {gradient}");
}

#[test]
fn nothing_comes_from_where_nothing_was_hit() {
    // Right of the middle rows are a veil, before a picture that is white there: the worst is there.
    let mut model = plane(2.0);
    for (mean, value) in model.means.iter().zip(&mut model.opacity_logits) {
        if mean[0] > 0.1 {
            *value = logit(0.1);
        }
    }
    let own = rendered(&model);
    let side = SIDE as usize;
    let white = image(|i| if i / 3 % side > 52 { 1.0 } else { 0.6 });
    for mode in MODES {
        // How many there are, and how many of them where alpha is low.
        let taken = |min_alpha| {
            let request = CandidateRequest { spaced: false, ..request(mode, min_alpha) };
            let found = candidates(&model, &white, request);
            let alpha = |c: &Candidate| {
                let p = pixel(c);
                own.alpha[p.y as usize * SIDE as usize + p.x as usize]
            };
            (found.len(), found.iter().filter(|c| alpha(c) < 0.5).count())
        };
        let (all, faint) = taken(0.5);
        assert!(all > 0, "{mode:?}: no candidate");
        assert_eq!(faint, 0, "{mode:?}: {faint} of {all} where alpha is below 0.5");
        let (all, faint) = taken(0.0);
        assert!(mode == ErrorMode::Gradient || faint > all / 2, "{mode:?}: nothing to keep away");
    }
}

#[test]
fn diet_asks_for_that_guard() {
    let scene = SceneInfo {
        extent: 1.1,
        train_views: 24,
        budget: 1000,
        initial_rows: 300,
        iterations: 30_000,
        white_background: false,
    };
    let policy = find("diet").expect("diet").build(&toml::Table::new(), &scene).expect("defaults");
    let request = policy.needs(&scene).candidates.expect("it compensates");
    assert!(request.min_alpha >= 0.5 && request.error != ErrorMode::Gradient, "{request:?}");
}
