//! Vignettes of photographs on every backend: gradients against the float64 renderer and central differences, alone and
//! after an exposure, and no effect or memory without vignettes.

use densify::core::colour::ColourTransform;
use densify::core::vignette::{PhotographPlace, Vignette};
use densify::render::{AuxInput, Differentiable, StepInput, StepOutput};
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::reference::loss::loss;
use densify::selftest::reference::{Model, Rules, Upstream, differentiate, render};
use densify::selftest::{Setup, Subject};
use densify_policies::policy::{
    AuxColumn, AuxRequest, Candidate, CandidateRequest, DepthMode, ErrorMode, Needs, PixelLoss,
};

use crate::exposure::{EXPOSURE, STEP, Scene, gradients, numbers, scene};
use crate::subject::{BLUE, all, make_with, repeatable, step_input};

/// A photograph of 37 x 29 px, cropped on the left and at the bottom; the corner keeps a quarter of its light.
const VIGNETTE: Vignette = Vignette {
    coefficients: [-1.1, 0.4, -0.6],
    place: PhotographPlace { middle: [11.0, 17.0], pixel: [0.024, 0.025] },
};

/// The factor v of each pixel, by definition, and its derivatives with respect to the coefficients.
fn factors(scene: &Scene, coefficients: [f64; 3]) -> Vec<(f64, [f64; 3])> {
    let (width, height) = scene.size();
    let place = VIGNETTE.place;
    let pixel = |at: usize| {
        let along = |axis: usize, number: usize| {
            (number as f64 + 0.5 - f64::from(place.middle[axis])) * f64::from(place.pixel[axis])
        };
        let (x, y) = (along(0, at % width), along(1, at / width));
        let r2 = x * x + y * y;
        let powers = [r2, r2.powi(2), r2.powi(3)];
        let light = 1.0 + powers.iter().zip(coefficients).map(|(p, a)| p * a).sum::<f64>();
        assert!((0.1..=1.0).contains(&light), "{light} is near a limit");
        let alpha = scene.target.alpha.as_ref().map_or(1.0, |a| f64::from(a[at]) / 255.0);
        let v = light.powf(1.0 / 2.4);
        let slope = alpha * v / (2.4 * light);
        (1.0 - alpha * (1.0 - v), powers.map(|power| slope * power))
    };
    (0..width * height).map(pixel).collect()
}

fn dimmed(exposed: &[f64], factors: &[(f64, [f64; 3])]) -> Vec<f64> {
    let pixels = exposed.as_chunks::<3>().0.iter().zip(factors);
    pixels.flat_map(|(c, (v, _))| c.map(|c| v * (c + 0.055) - 0.055)).collect()
}

fn backend(subject: &Subject, scene: &Scene) -> Box<dyn Differentiable> {
    let setup = Setup { exposures: true, vignettes: true, tile_cap: Some(60), ..Setup::default() };
    make_with(subject, &scene.model, setup)
}

fn step(
    backend: &mut dyn Differentiable,
    scene: &Scene,
    exposure: Option<&ColourTransform>,
    vignette: Option<&Vignette>,
) -> StepOutput {
    let input = StepInput { exposure, vignette, ..step_input(1, &scene.camera, &scene.target, 1) };
    backend.train_step(&input).expect("a small image is rendered")
}

#[test]
fn gradients_match_the_reference_and_central_differences() {
    let mut table = Table::new("vignettes against central differences");
    for (with_alpha, exposure) in
        [(false, None), (true, None), (false, Some(&EXPOSURE)), (true, Some(&EXPOSURE))]
    {
        let scene = scene(with_alpha);
        let (width, height) = scene.size();
        let model = Model::from(&scene.model);
        let image = render(&model, scene.view(), &Rules::STANDARD);
        let truth = scene.truth();
        let transform = numbers(exposure.unwrap_or(&ColourTransform::IDENTITY));
        let compared = |transform: &[f64; 12], coefficients: [f64; 3]| {
            let exposed = scene.exposed(&image.rgb, &image.alpha, transform);
            let shown = dimmed(&exposed, &factors(&scene, coefficients));
            loss(&shown, &truth, (width, height), PixelLoss::L1)
        };
        let at = VIGNETTE.coefficients.map(f64::from);
        let difference = |moved: &dyn Fn(f64) -> f64| (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
        let differences: Vec<f64> = (0..3)
            .map(|i| {
                difference(&|by| {
                    let mut to = at;
                    to[i] += by;
                    compared(&transform, to).minimised
                })
            })
            .collect();
        let by_exposure: Vec<f64> = (0..12)
            .map(|i| {
                difference(&|by| {
                    let mut to = transform;
                    to[i] += by;
                    compared(&to, at).minimised
                })
            })
            .collect();
        // Chain rule to the colours and alpha of the foreground.
        let pixel_gradient = compared(&transform, at).gradient;
        let pixels = pixel_gradient.as_chunks::<3>().0.iter().zip(factors(&scene, at));
        let pixels: Vec<[f64; 3]> = pixels.map(|(g, (v, _))| g.map(|g| v * g)).collect();
        let rgb = pixels.iter().flat_map(|g| -> [f64; 3] {
            std::array::from_fn(|j| (0..3).map(|i| transform[3 * i + j] * g[i]).sum())
        });
        let alpha = pixels.iter().map(|g| -> f64 {
            (0..3).map(|i| g[i] * (transform[9 + i] - f64::from(BLUE[i]))).sum()
        });
        let upstream = Upstream {
            rgb: rgb.collect(),
            alpha: alpha.collect(),
            depth: vec![0.0; width * height],
        };
        let (_, exact) = differentiate(&model, scene.view(), &Rules::STANDARD, &upstream);
        let exact = exact.model;
        for subject in all() {
            let mut backend = backend(&subject, &scene);
            let output = step(&mut *backend, &scene, exposure, Some(&VIGNETTE));
            let exposed = exposure.is_some();
            let case = format!("{}, alpha {with_alpha}, exposure {exposed}", subject.name());
            let error = (f64::from(output.loss) - compared(&transform, at).loss).abs();
            table.check(&case, "loss", error, 1e-5);
            let found = output.vignette.expect("a gradient");
            let tolerance = 10.0 * subject.gradient_tolerance();
            table.check(&case, "vignette", relative_error(&found, &differences), tolerance);
            assert_eq!(output.exposure.is_some(), exposed, "{case}");
            if let Some(found) = output.exposure {
                let found: Vec<f32> =
                    found.matrix.concat().into_iter().chain(found.offset).collect();
                table.check(&case, "exposure", relative_error(&found, &by_exposure), tolerance);
            }
            let rows = gradients(&*backend);
            let class = |first: usize, count: usize| -> Vec<f64> {
                rows.iter().flat_map(|row| row[first..first + count].to_vec()).collect()
            };
            for (name, found) in [
                ("means", class(0, 3)),
                ("log_scales", class(3, 3)),
                ("opacity_logits", class(10, 1)),
            ] {
                table.check(&case, name, relative_error(&found, exact.class(name)), tolerance);
            }
        }
    }
    table.finish();
}

/// Without a vignette, room for vignettes changes nothing, and a backend without this room needs less memory.
#[test]
fn no_vignette_changes_nothing() {
    let scene = scene(true);
    for subject in repeatable() {
        let run = |vignettes: bool, vignette: Option<&Vignette>| {
            let setup = Setup { vignettes, tile_cap: Some(60), ..Setup::default() };
            let mut backend = make_with(&subject, &scene.model, setup);
            let output = step(&mut *backend, &scene, None, vignette);
            (output, backend.download().expect("a model"), backend.ledger().total())
        };
        let (plain, model, bytes) = run(false, None);
        assert_eq!(plain.vignette, None, "{}", subject.name());
        let (output, same, more) = run(true, None);
        assert!(output == plain && same == model, "{}", subject.name());
        let is_native = matches!(subject, Subject::Native { .. });
        assert_eq!(more == bytes, is_native, "{}: {bytes}, {more}", subject.name());
        let none = Vignette { coefficients: [0.0; 3], ..VIGNETTE };
        let (output, _, _) = run(true, Some(&none));
        assert!((output.loss - plain.loss).abs() < 1e-6, "{}", subject.name());
    }
}

#[test]
fn vignettes_do_not_depend_on_the_number_of_threads() {
    let scene = scene(true);
    let run = |threads: usize| {
        let Subject::Native { instructions, .. } = Subject::NATIVE else { unreachable!() };
        let subject = Subject::Native { instructions, threads: Some(threads) };
        let mut backend = backend(&subject, &scene);
        let output = step(&mut *backend, &scene, Some(&EXPOSURE), Some(&VIGNETTE));
        (output, backend.download().expect("a model"))
    };
    let one = run(1);
    assert!((2..5).all(|threads| run(threads) == one));
}

/// Auxiliary views and candidates apply the vignette: the observed loss is that of the next step, and candidates have
/// the colour of the scene.
#[test]
fn auxiliary_views_and_candidates_apply_the_vignette() {
    let mut scene = scene(false);
    scene.target.rgb.fill(128);
    let candidates = CandidateRequest {
        from: 0,
        until: 10,
        rows_per_candidate: 1,
        capacity: 4,
        error: ErrorMode::L1,
        depth: DepthMode::MaxWeight,
        min_alpha: 0.1,
        spaced: false,
    };
    let request = AuxRequest { columns: vec![AuxColumn::MapSum], ..AuxRequest::default() };
    let needs =
        Needs { candidates: Some(candidates), aux: Some(request.clone()), ..Needs::default() };
    for subject in all() {
        let setup = Setup {
            vignettes: true,
            needs: needs.clone(),
            largest_image: (scene.camera.width, scene.camera.height),
            ..Setup::default()
        };
        let mut backend = make_with(&subject, &scene.model, setup);
        let observed = backend.observe(&AuxInput {
            step: 1,
            view: 0,
            seed: 3,
            camera: &scene.camera,
            target: &scene.target,
            background: BLUE,
            exposure: None,
            vignette: Some(&VIGNETTE),
            sh_degree: 1,
            depth: None,
            request: &request,
        });
        let observed = observed.expect("a small image is rendered");
        let output = step(&mut *backend, &scene, None, Some(&VIGNETTE));
        assert!((observed.loss - output.loss).abs() < 1e-6, "{}", subject.name());
        let list: &[Candidate] = backend.candidates();
        assert!(!list.is_empty(), "{}", subject.name());
        for Candidate { colour, position, .. } in list {
            let at = scene.camera.project(glam::Vec3::from(*position).as_dvec3()).0;
            let (x, y) = (at.x as usize, at.y as usize);
            let expected = VIGNETTE.undo(x, y, 1.0, [128.0 / 255.0; 3]);
            let is_near = colour.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4);
            assert!(is_near, "{}: {colour:?}, {expected:?}", subject.name());
        }
    }
}
