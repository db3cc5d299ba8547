//! Gradients with respect to a camera's pose, on every backend: against central differences of the float64 renderer.

use densify::core::antialiasing::Antialiasing;
use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::core::image::Image8;
use densify::core::pose::{TWIST_VALUES, Twist};
use densify::render::{LearningRates, Shortcuts, StepInput, StepOutput};
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::reference::loss::loss;
use densify::selftest::reference::{Model, Rules, View, render};
use densify::selftest::{Setup, Subject, scenes};
use densify_policies::policy::PixelLoss;

use crate::subject::{BLUE, all, make_with, normalised, repeatable, step_input};

/// Step of the central difference, to either side.
const STEP: f64 = 1e-6;
/// The derivative with respect to focal lengths comes last.
const MOTIONS: usize = TWIST_VALUES - 1;

struct Scene {
    name: &'static str,
    model: Gaussians,
    camera: Camera,
    target: Image8,
    /// Number of values of a twist that are compared.
    values: usize,
}

/// Adds a row at a point in camera coordinates.
fn add(model: &mut Gaussians, camera: &Camera, local: [f64; 3], scale: [f32; 3]) {
    let mean = scenes::world(camera, local);
    scenes::push(model, mean, scale, [0.9, -0.3, 0.4, 0.2], 1.0, |k| 0.3 - 0.05 * k as f32);
}

impl Scene {
    fn new(name: &'static str, model: Gaussians, camera: Camera) -> Self {
        Self { name, model, target: scenes::target(&camera), camera, values: TWIST_VALUES }
    }

    /// Gaussians over the image whose colours depend on the direction in every band.
    fn ordinary() -> Self {
        let camera = scenes::camera(37, 29, 71);
        let model = normalised(scenes::cloud(24, 3, &camera, 72));
        // Where x/z is clamped, the derivative with respect to focal lengths holds its bounds fixed.
        let values = MOTIONS;
        Self { values, ..Self::new("ordinary", model, camera) }
    }

    /// Gaussians well inside the image.
    fn inside() -> Self {
        let camera = scenes::camera(41, 33, 73);
        let mut model = Gaussians { sh_degree: 1, ..Gaussians::default() };
        for (i, &(x, y, z)) in
            [(0.1, 0.0, 2.0), (-0.2, 0.15, 3.0), (0.3, -0.2, 2.5), (0.0, 0.2, 4.0)]
                .iter()
                .enumerate()
        {
            add(&mut model, &camera, [x, y, z], [0.2, 0.05 + 0.03 * i as f32, 0.1]);
        }
        Self::new("inside", normalised(model), camera)
    }

    /// The camera is inside a Gaussian, and another extends far out of the image, where x/z is clamped.
    fn close() -> Self {
        let camera = scenes::camera(37, 29, 74);
        let mut model = Gaussians { sh_degree: 1, ..Gaussians::default() };
        add(&mut model, &camera, [0.02, 0.01, 0.3], [0.5, 0.4, 0.6]);
        add(&mut model, &camera, [2.2, 0.1, 1.5], [0.8, 0.3, 0.2]);
        add(&mut model, &camera, [0.1, 0.2, 2.0], [0.2, 0.4, 0.1]);
        Self { values: MOTIONS, ..Self::new("close", normalised(model), camera) }
    }

    fn antialiased() -> Self {
        let camera = scenes::camera(37, 29, 75);
        let model = Gaussians {
            antialiasing: Antialiasing::Wide,
            ..normalised(scenes::cloud(24, 2, &camera, 76))
        };
        Self { values: MOTIONS, ..Self::new("antialiased", model, camera) }
    }

    /// The loss of the float64 renderer with the camera moved.
    fn loss_at(&self, model: &Model, twist: &Twist) -> f64 {
        let camera = self.camera.moved(twist);
        let view = View {
            camera: &camera,
            background: BLUE.map(f64::from),
            sh_degree: self.model.sh_degree,
        };
        let image = render(model, view, &Rules::SMOOTH);
        let truth: Vec<f64> = self.target.rgb.iter().map(|&v| f64::from(v) / 255.0).collect();
        let size = (camera.width as usize, camera.height as usize);
        loss(&image.rgb, &truth, size, PixelLoss::L1).minimised
    }

    fn differences(&self) -> Vec<f64> {
        let model = Model::from(&self.model);
        let moved = |i: usize, by: f64| {
            let mut values = [0.0; TWIST_VALUES];
            values[i] = by;
            self.loss_at(&model, &Twist::from_array(values))
        };
        let differences = |i| (moved(i, STEP) - moved(i, -STEP)) / (2.0 * STEP);
        (0..self.values).map(differences).collect()
    }
}

fn step(subject: &Subject, scene: &Scene, pose: bool) -> (StepOutput, Gaussians, u64) {
    // So low that the image is continuous, as finite differences need it.
    let shortcuts = Shortcuts { alpha_min: 1e-7, transmittance_min: 1e-12 };
    let setup = Setup { poses: pose, shortcuts, tile_cap: Some(400), ..Setup::default() };
    let mut backend = make_with(subject, &scene.model, setup);
    let degree = scene.model.sh_degree;
    let input = StepInput { pose, ..step_input(1, &scene.camera, &scene.target, degree) };
    let output = backend.train_step(&input).expect("a small image is rendered");
    (output, backend.download().expect("a model"), backend.ledger().total())
}

#[test]
fn gradients_match_central_differences() {
    let mut table = Table::new("poses against central differences");
    for scene in [Scene::ordinary(), Scene::inside(), Scene::close(), Scene::antialiased()] {
        let expected = scene.differences();
        assert!(expected.iter().all(|x| x.abs() > 1e-6), "{}: {expected:?}", scene.name);
        for subject in all() {
            let found = step(&subject, &scene, true).0.pose.expect("a gradient").to_array();
            let found = found[..scene.values].iter().map(|&x| x as f32).collect::<Vec<_>>();
            let case = format!("{}, {}", subject.name(), scene.name);
            let tolerance = 10.0 * subject.gradient_tolerance();
            for (name, range) in [("v", 0..3), ("ω", 3..6), ("log f", 6..scene.values)] {
                if range.start < scene.values {
                    let error = relative_error(&found[range.clone()], &expected[range]);
                    table.check(&case, name, error, tolerance);
                }
            }
        }
    }
    table.finish();
}

/// The gradient is only measured: model and outputs are those of a step without it, to the last bit.
#[test]
fn differentiating_the_pose_changes_no_other_number() {
    let scene = Scene::ordinary();
    for subject in repeatable() {
        let (with, model, _) = step(&subject, &scene, true);
        let (without, same, _) = step(&subject, &scene, false);
        assert_eq!(without.pose, None, "{}", subject.name());
        assert_eq!(
            (StepOutput { pose: None, ..with }, model),
            (without, same),
            "{}",
            subject.name()
        );
    }
}

#[test]
fn gradients_do_not_depend_on_the_number_of_threads() {
    let camera = scenes::camera(61, 47, 77);
    let scene = Scene::new("many", normalised(scenes::cloud(700, 1, &camera, 78)), camera);
    let run = |threads: usize| {
        let Subject::Native { instructions, .. } = Subject::NATIVE else { unreachable!() };
        let subject = Subject::Native { instructions, threads: Some(threads) };
        let (output, model, _) = step(&subject, &scene, true);
        (output, model)
    };
    let one = run(1);
    assert!((2..5).all(|threads| run(threads) == one));
}

/// Steps along the gradient bring a camera back that was moved while the model stays fixed.
#[test]
fn a_moved_camera_returns_to_its_pose() {
    let mut scene = Scene::ordinary();
    for subject in repeatable().into_iter().take(1) {
        let setup = Setup { poses: true, ..Setup::default() };
        let mut backend = make_with(&subject, &scene.model, setup);
        let image = backend.render(&scene.camera, BLUE, 3).expect("a small image");
        scene.target = crate::subject::photograph(&image);
        let truth = scene.camera;
        let off = |camera: &Camera| {
            let turned = (camera.rotation * truth.rotation.transpose()).to_cols_array_2d();
            let skew = [turned[1][2], turned[2][0], turned[0][1]];
            (
                skew.iter().map(|x| x * x).sum::<f64>().sqrt(),
                camera.centre().distance(truth.centre()),
            )
        };
        let moved = [0.02, -0.015, 0.01, 0.004, -0.006, 0.003, 0.0];
        let mut camera = truth.moved(&Twist::from_array(moved));
        let before = off(&camera);
        let mut moments = [[0.0; 2]; MOTIONS];
        for number in 1..=300 {
            let rates = LearningRates::default();
            let input = step_input(number, &camera, &scene.target, 3);
            let input = StepInput { pose: true, rates, ..input };
            let gradient = backend.train_step(&input).expect("a step").pose.expect("a gradient");
            let rate = 2e-3 * 0.01_f64.powf(f64::from(number) / 300.0);
            let mut by = [0.0; TWIST_VALUES];
            for ((by, g), [m, v]) in by.iter_mut().zip(gradient.to_array()).zip(&mut moments) {
                *m = 0.8 * *m + 0.2 * g;
                *v = 0.95 * *v + 0.05 * g * g;
                *by = -rate * *m / (v.sqrt() + 1e-12);
            }
            camera = camera.moved(&Twist::from_array(by));
        }
        let after = off(&camera);
        assert!(after.0 < 0.1 * before.0 && after.1 < 0.1 * before.1, "{before:?} {after:?}");
    }
}
