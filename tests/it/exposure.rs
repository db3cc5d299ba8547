//! Exposures of photographs on every backend: gradients against the float64 renderer and central differences, and no
//! effect or memory without exposures.

use densify::core::camera::Camera;
use densify::core::colour::ColourTransform;
use densify::core::gaussians::Gaussians;
use densify::core::image::Image8;
use densify::render::{AuxInput, Differentiable, StepInput, StepOutput};
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::reference::loss::loss;
use densify::selftest::reference::{Model, Rules, Upstream, View, differentiate, render};
use densify::selftest::{Setup, Subject, scenes};
use densify_policies::policy::{AuxColumn, AuxRequest, Candidate, CandidateRequest, DepthMode};
use densify_policies::policy::{ErrorMode, Needs, PixelLoss};

use crate::subject::{BLUE, all, make_with, normalised, repeatable, step_input};

/// Step of the central difference, to either side.
pub(super) const STEP: f64 = 1e-6;
pub(super) const EXPOSURE: ColourTransform = ColourTransform {
    matrix: [[1.2, 0.05, -0.1], [0.02, 0.7, 0.15], [-0.05, 0.1, 1.3]],
    offset: [0.03, -0.06, 0.11],
};

pub(super) struct Scene {
    pub(super) model: Gaussians,
    pub(super) camera: Camera,
    pub(super) target: Image8,
}

/// Gaussians that leave much of the background visible. The photograph may be partly transparent.
pub(super) fn scene(with_alpha: bool) -> Scene {
    let camera = scenes::camera(37, 29, 61);
    let model = normalised(scenes::cloud(14, 1, &camera, 62));
    let mut target = scenes::target(&camera);
    target.alpha = with_alpha.then(|| target.rgb.iter().step_by(3).map(|v| v / 2 + 100).collect());
    Scene { model, camera, target }
}

impl Scene {
    pub(super) fn size(&self) -> (usize, usize) {
        (self.camera.width as usize, self.camera.height as usize)
    }

    pub(super) fn view(&self) -> View<'_> {
        View { camera: &self.camera, background: [0.0; 3], sh_degree: 1 }
    }

    /// The photograph composited on the background.
    pub(super) fn truth(&self) -> Vec<f64> {
        let (width, height) = self.size();
        let at = |pixel: usize| self.target.composited(pixel % width, pixel / width, BLUE);
        (0..width * height).flat_map(at).map(f64::from).collect()
    }

    /// The image compared with the photograph: the exposed foreground on the background.
    pub(super) fn exposed(
        &self,
        foreground: &[f64],
        alpha: &[f64],
        exposure: &[f64; 12],
    ) -> Vec<f64> {
        let pixel = |(colour, alpha): (&[f64; 3], &f64)| -> [f64; 3] {
            std::array::from_fn(|i| {
                let row = &exposure[3 * i..3 * i + 3];
                let mixed: f64 = row.iter().zip(colour).map(|(m, c)| m * c).sum();
                mixed + alpha * exposure[9 + i] + (1.0 - alpha) * f64::from(BLUE[i])
            })
        };
        foreground.as_chunks::<3>().0.iter().zip(alpha).flat_map(pixel).collect()
    }
}

/// The matrix followed by the offset.
pub(super) fn numbers(transform: &ColourTransform) -> [f64; 12] {
    let all: Vec<f64> =
        transform.matrix.concat().into_iter().chain(transform.offset).map(f64::from).collect();
    all.try_into().expect("twelve numbers")
}

fn backend(subject: &Subject, scene: &Scene) -> Box<dyn Differentiable> {
    let setup = Setup { exposures: true, tile_cap: Some(60), ..Setup::default() };
    make_with(subject, &scene.model, setup)
}

fn step(
    backend: &mut dyn Differentiable,
    scene: &Scene,
    exposure: Option<&ColourTransform>,
) -> StepOutput {
    let input = StepInput { exposure, ..step_input(1, &scene.camera, &scene.target, 1) };
    backend.train_step(&input).expect("a small image is rendered")
}

/// The gradients of the geometry in the first step, recovered from the first moment, which is a tenth of them.
/// Shape: [rows, 11].
pub(super) fn gradients(backend: &dyn Differentiable) -> Vec<[f64; 11]> {
    let names = ["moments.first", "device.first rows"];
    let state = backend.state();
    let name = names.iter().find(|name| state.iter().any(|array| array.name == **name));
    let tensor = backend.save(name.expect("moments of the geometry")).expect("an array");
    let (shape, values) = (tensor.shape.clone(), tensor);
    let values = values.into_f32(&shape).expect("numbers");
    let row = |row: &[f32]| std::array::from_fn(|i| 10.0 * f64::from(row[i]));
    values.chunks(shape[1]).map(row).collect()
}

#[test]
fn gradients_match_the_reference_and_central_differences() {
    let mut table = Table::new("exposures against central differences");
    for with_alpha in [false, true] {
        let scene = scene(with_alpha);
        let (width, height) = scene.size();
        let model = Model::from(&scene.model);
        let image = render(&model, scene.view(), &Rules::STANDARD);
        let (truth, at) = (scene.truth(), numbers(&EXPOSURE));
        let compared = |exposure: &[f64; 12]| {
            let exposed = scene.exposed(&image.rgb, &image.alpha, exposure);
            loss(&exposed, &truth, (width, height), PixelLoss::L1)
        };
        let differences: Vec<f64> = (0..12)
            .map(|i| {
                let moved = |by: f64| {
                    let mut to = at;
                    to[i] += by;
                    compared(&to).minimised
                };
                (moved(STEP) - moved(-STEP)) / (2.0 * STEP)
            })
            .collect();
        // Chain rule to the colours and alpha of the foreground.
        let pixel_gradient = compared(&at).gradient;
        let pixel_gradient = pixel_gradient.as_chunks::<3>().0;
        let rgb = pixel_gradient.iter().flat_map(|g| -> [f64; 3] {
            std::array::from_fn(|j| (0..3).map(|i| at[3 * i + j] * g[i]).sum())
        });
        let alpha = pixel_gradient
            .iter()
            .map(|g| -> f64 { (0..3).map(|i| g[i] * (at[9 + i] - f64::from(BLUE[i]))).sum() });
        let upstream = Upstream {
            rgb: rgb.collect(),
            alpha: alpha.collect(),
            depth: vec![0.0; width * height],
        };
        let (_, exact) = differentiate(&model, scene.view(), &Rules::STANDARD, &upstream);
        let exact = exact.model;
        for subject in all() {
            let mut backend = backend(&subject, &scene);
            let output = step(&mut *backend, &scene, Some(&EXPOSURE));
            let case = format!("{}, alpha {with_alpha}", subject.name());
            let error = (f64::from(output.loss) - compared(&at).loss).abs();
            table.check(&case, "loss", error, 1e-5);
            let found = output.exposure.expect("a gradient");
            let found: Vec<f32> = found.matrix.concat().into_iter().chain(found.offset).collect();
            let tolerance = 10.0 * subject.gradient_tolerance();
            table.check(&case, "exposure", relative_error(&found, &differences), tolerance);
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

/// The identity equals no exposure, and a backend without room for exposures needs less memory.
#[test]
fn the_identity_exposure_changes_nothing() {
    let scene = scene(true);
    for subject in repeatable() {
        let run = |exposures: bool, exposure: Option<&ColourTransform>| {
            let setup = Setup { exposures, tile_cap: Some(60), ..Setup::default() };
            let mut backend = make_with(&subject, &scene.model, setup);
            let output = step(&mut *backend, &scene, exposure);
            (output, backend.download().expect("a model"), backend.ledger().total())
        };
        let (plain, model, bytes) = run(false, None);
        assert_eq!(plain.exposure, None, "{}", subject.name());
        let (output, same, more) = run(true, None);
        assert!(output == plain && same == model, "{}", subject.name());
        let is_native = matches!(subject, Subject::Native { .. });
        assert_eq!(more == bytes, is_native, "{}: {bytes}, {more}", subject.name());
        let (output, _, _) = run(true, Some(&ColourTransform::IDENTITY));
        assert!((output.loss - plain.loss).abs() < 1e-6, "{}", subject.name());
    }
}

#[test]
fn exposures_do_not_depend_on_the_number_of_threads() {
    let scene = scene(false);
    let run = |threads: usize| {
        let Subject::Native { instructions, .. } = Subject::NATIVE else { unreachable!() };
        let subject = Subject::Native { instructions, threads: Some(threads) };
        let mut backend = backend(&subject, &scene);
        (step(&mut *backend, &scene, Some(&EXPOSURE)), backend.download().expect("a model"))
    };
    let one = run(1);
    assert!((2..5).all(|threads| run(threads) == one));
}

/// Auxiliary views and candidates apply the exposure: the observed loss is that of the next step, and candidates have
/// the colour of the scene.
#[test]
fn auxiliary_views_and_candidates_apply_the_exposure() {
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
            exposures: true,
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
            exposure: Some(&EXPOSURE),
            vignette: None,
            sh_degree: 1,
            depth: None,
            request: &request,
        });
        let observed = observed.expect("a small image is rendered");
        let output = step(&mut *backend, &scene, Some(&EXPOSURE));
        assert!((observed.loss - output.loss).abs() < 1e-6, "{}", subject.name());
        let grey = EXPOSURE.inverse().apply([128.0 / 255.0; 3]);
        let list: &[Candidate] = backend.candidates();
        assert!(!list.is_empty(), "{}", subject.name());
        for Candidate { colour, .. } in list {
            let is_near = colour.iter().zip(grey).all(|(a, b)| (a - b).abs() < 1e-5);
            assert!(is_near, "{}: {colour:?}, {grey:?}", subject.name());
        }
    }
}
