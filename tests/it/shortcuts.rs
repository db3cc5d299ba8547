//! Shortcuts of the backends: with other limits of blending they are held to the reference with these
//! limits, forward and backward; with a coarser exponential they are off by no more than that; and
//! where only visible rows step, the others rest to the bit.

use densify::backend::cpu::CpuBackend;
use densify::backend::gpu::{GpuBackend, GpuOptions};
use densify::backend::{Backend, Exp2, LearningRates, Shortcuts, StepInput, Stepped};
use densify::camera::Camera;
use densify::gaussians::Gaussians;
use densify_policies::policy::Cadence;

use crate::gpu::subjects;
use crate::subject::{self, RATES, Resources};
use densify::verify::compare::{Limits, Table, class, compare_images, relative_error};
use densify::verify::reference::{CLASSES, Image, Model, Rules, View, blend, project};
use densify::verify::scenes;

const GREY: [f32; 3] = [0.3, 0.4, 0.6];
/// Gradients, as elsewhere, against the largest of their class.
const GRADIENT: f64 = 1e-4;

/// Translucent rows in front of each other, of which many pixels see enough to stop.
fn scene() -> (Gaussians, Camera) {
    let camera = scenes::camera(52, 41, 5);
    let mut model = scenes::cloud(160, 1, &camera, 8);
    for logit in &mut model.opacity_logits {
        *logit += 1.5;
    }
    (model, camera)
}

fn native(model: &Gaussians, shortcuts: Shortcuts) -> CpuBackend {
    let mut options = subject::options(model.len(), Resources::default());
    options.shortcuts = shortcuts;
    CpuBackend::new(model, &options).expect("a small model fits")
}

/// What the reference renders with these rules, and what it differentiates.
fn truth(
    model: &Gaussians,
    camera: &Camera,
    rules: &Rules,
) -> (Image, Model, densify::verify::reference::Upstream) {
    let view = View { camera, background: GREY.map(f64::from), sh_degree: 1 };
    let exact = Model::of(model);
    let splats = project::project(&exact, view, rules);
    let order = project::by_depth(&splats);
    let image = blend::render(&splats, &order, view, rules);
    let upstream = scenes::upstream(camera, 99).ignoring(&image.boundary);
    let screen = blend::backward(&splats, &order, view, rules, &upstream);
    (image, project::backward(&exact, view, &splats, &screen), upstream)
}

#[test]
fn other_limits_of_blending_are_those_of_forward_and_backward_pass() {
    let (model, camera) = scene();
    let mut table = Table::new("limits of blending");
    let standard = truth(&model, &camera, &Rules::STANDARD).0;
    for (alpha_min, transmittance_min) in
        [(1.0 / 255.0, 1e-4), (1.0 / 1024.0, 1e-5), (1.0 / 32.0, 1e-4), (1.0 / 255.0, 1e-2)]
    {
        let shortcuts = Shortcuts { alpha_min, transmittance_min, ..Shortcuts::default() };
        let rules = Rules {
            alpha_min: f64::from(alpha_min),
            transmittance_min: f64::from(transmittance_min),
            ..Rules::STANDARD
        };
        let (image, gradient, upstream) = truth(&model, &camera, &rules);
        let is_standard = shortcuts == Shortcuts::default();
        assert_eq!(image.rgb == standard.rgb, is_standard, "the limits do nothing here");
        let upstream = scenes::narrowed(&upstream);
        let mut found = vec![(
            "native".to_owned(),
            native(&model, shortcuts).differentiate(&camera, GREY, 1, &upstream),
        )];
        for device in subjects() {
            let options = GpuOptions { shortcuts, ..GpuOptions::new(model.len()) };
            let mut backend = GpuBackend::new(&model, &options, device).expect("it fits");
            let outcome = backend.differentiate(&camera, GREY, 1, &upstream);
            found.push((device.adapter().name.clone(), outcome));
        }
        for (name, outcome) in found {
            let (rendering, measured) = outcome.expect("a small image is rendered");
            let case = format!("{name}, {alpha_min:.4}, {transmittance_min:e}");
            // A decision that is taken otherwise may be worth the faintest splat.
            let step = 1.5 * f64::from(alpha_min.max(transmittance_min).max(1.0 / 255.0));
            let limits = Limits { step, ..Limits::CPU };
            let outcome = compare_images(&rendering.rgb, &image.rgb, &image.boundary, limits);
            table.image(&case, "rgb", outcome, limits);
            for name in CLASSES {
                let error = relative_error(class(&measured, name), gradient.class(name));
                table.check(&case, name, error, GRADIENT);
            }
        }
    }
    table.finish();
}

#[test]
fn a_coarser_exponential_is_off_by_its_error() {
    let (model, camera) = scene();
    let (image, gradient, upstream) = truth(&model, &camera, &Rules::STANDARD);
    let upstream = scenes::narrowed(&upstream);
    let errors = |exp2| {
        let mut backend = native(&model, Shortcuts { exp2, ..Shortcuts::default() });
        let (found, measured) =
            backend.differentiate(&camera, GREY, 1, &upstream).expect("it is rendered");
        let off = |i: usize| (f64::from(found.rgb[i]) - image.rgb[i]).abs();
        let sharp = (0..image.rgb.len()).filter(|i| !image.boundary[i / 3]);
        let rgb = sharp.map(off).fold(0.0, f64::max);
        let of = |name: &&str| relative_error(class(&measured, name), gradient.class(name));
        (rgb, CLASSES.iter().map(of).fold(0.0, f64::max))
    };
    let [two, four, six] = [Exp2::Degree2, Exp2::Degree4, Exp2::Degree6].map(errors);
    assert!(two.0 < 5e-3 && two.1 < 2e-2 && four.0 < 2e-5 && four.1 < GRADIENT, "{two:?} {four:?}");
    assert!(
        two.0 > 5.0 * four.0 && two.1 > 5.0 * four.1,
        "the degree does nothing: {two:?} {four:?}"
    );
    assert!(six.0 <= four.0 && six.1 < GRADIENT, "{four:?} {six:?}");
}

/// One step of a model towards an image.
fn step(backend: &mut dyn Backend, number: u32, camera: &Camera, rates: LearningRates) {
    let target = scenes::target(camera);
    let input = StepInput {
        step: number,
        view: 0,
        camera,
        target: &target,
        background: GREY,
        sh_degree: 1,
        rates,
        cadence: Cadence::default(),
        seed: 1,
        ssim_weight: 1.0,
    };
    backend.train_step(&input).expect("a small image is rendered");
}

#[test]
fn rows_out_of_sight_rest_where_only_visible_ones_step() {
    let (model, camera) = scene();
    // The same camera, turned aside by a part of its image.
    let aside = Camera { cx: camera.cx + 0.7 * f64::from(camera.width), ..camera };
    let models = [Stepped::All, Stepped::Visible].map(|stepped| {
        let mut backend = native(&model, Shortcuts { stepped, ..Shortcuts::default() });
        step(&mut backend, 1, &camera, RATES);
        let before = backend.download().expect("it is there");
        step(&mut backend, 2, &aside, RATES);
        let ages = backend.save("ages").expect("an array of the state");
        (before, backend.download().expect("it is there"), ages)
    });
    let [(dense_before, dense, dense_ages), (before, sparse, ages)] = models;
    // All rows are seen in the first step, or were never moved.
    assert!(dense_before == before, "a first step must not depend on it");
    let zeros = densify::backend::cpu::ImageGradient {
        rgb: vec![0.0; 3 * (aside.width * aside.height) as usize],
        alpha: vec![0.0; (aside.width * aside.height) as usize],
        depth: vec![0.0; (aside.width * aside.height) as usize],
    };
    let mut backend = native(&before, Shortcuts::default());
    let (_, looked) = backend.differentiate(&aside, GREY, 1, &zeros).expect("it is rendered");
    let bits = |model: &Gaussians, row: usize| model.means[row].map(f32::to_bits);
    let (mut seen, mut hidden, mut moved) = (0, 0, 0);
    for row in 0..model.len() {
        if looked.visible[row] {
            seen += 1;
            assert_eq!(bits(&sparse, row), bits(&dense, row), "row {row} is seen");
        } else {
            hidden += 1;
            assert_eq!(bits(&sparse, row), bits(&before, row), "row {row} is hidden");
            moved += usize::from(bits(&dense, row) != bits(&before, row));
        }
    }
    assert!(seen > 10 && hidden > 10 && moved > 10, "{seen} seen, {hidden} hidden, {moved} moved");
    assert!(dense_ages != ages, "rows at rest must not age");
}
